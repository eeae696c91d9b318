"""Observer, planner and controller around one robot, as a library has them."""

import dataclasses
import itertools
import math
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from arm_simulation import ARM, HOME, TICK_NS
from plans import StayingCore

from benchmarks.episode import EpisodeRobot, Silent
from benchmarks.faulty_robot import FaultyRobot, NotFinite
from contact_reach_ros.arm import JointState
from contact_reach_ros.arm.mjcf import build_mjcf
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.control.settings import ControllerSettings, SupervisionSettings
from contact_reach_ros.errors import InputError, PlanningError, SettingsError, StopCode, UnreachableError
from contact_reach_ros.planning.plan import PlanningCore
from contact_reach_ros.planning.receding_horizon import RecedingHorizonPlanner
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.stack import Stack, Tick
from contact_reach_ros.world.goal import FREE, Goal
from contact_reach_ros.world.spheres import Spheres

SMALL = PlanningSettings(population=32, max_steps=3, deadline=0.0)
BALL_SCENE = load_scene("ball")
AWAY = [dataclasses.replace(ball, rest=ball.rest + np.array([0.0, 3.0, 0.0])) for ball in BALL_SCENE.obstacles]
EMPTY_SCENE = load_scene("free")
FREE_SCENE = dataclasses.replace(BALL_SCENE, obstacles=tuple(AWAY))
"""With a ball out of reach: its programs are those of most other tests."""
GOAL = Goal(FREE_SCENE.target)
BEYOND = Goal([5.0, 0.0, 0.0])
BAD = np.where(np.arange(ARM.n) == 3, math.nan, 0.0)


class PlainRobot:
    """MuJoCo's arm in a loop: no obstacles, sensors without noise, commands that act at once."""

    stop_reason = ""

    def __init__(self, start: np.ndarray = HOME, steps: int = 1) -> None:
        """`steps`: number of milliseconds from one joint state to the next."""
        self.model = mujoco.MjModel.from_xml_string(build_mjcf(ARM))
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = start
        self.steps = steps
        self.commands: list[np.ndarray] = []
        self._acting = np.full(ARM.n, math.nan)

    def command(self, torque: np.ndarray, clock_ns: int) -> None:
        self.commands.append(torque)
        self._acting = torque

    def step(self, clock_ns: int) -> None:
        self.data.ctrl[:] = self._acting
        for _ in range(self.steps):
            mujoco.mj_step(self.model, self.data)

    def read(self) -> list[JointState]:
        stamp_ns = round(1e9 * self.data.time)
        return [JointState(stamp_ns, self.data.qpos.copy(), self.data.qvel.copy(), self._acting)]

    def obstacles(self) -> Spheres | None:
        return None

    def reset(self) -> None:
        pass

    def contact_forces(self) -> np.ndarray | None:
        return None


class OddRobot(PlainRobot):
    """One whose states are changed on their way, by the number of the state."""

    def __init__(self, change) -> None:
        super().__init__()
        self._change, self._reads = change, 0

    def read(self) -> list[JointState]:
        self._reads += 1
        return self._change(self._reads - 1, super().read())


def watched(stack: Stack, timeout: float = 6.0, each_tick: Callable[[], object] = lambda: None) -> tuple:
    """The result of a run, and torques, joint angles and stamps of all of it."""
    ticks: list[Tick] = []

    def look(tick: Tick) -> None:
        each_tick()
        ticks.append(tick)

    result = stack.run(GOAL, timeout, look)
    torques = np.array([tick.torque for tick in ticks])
    return result, torques, np.array([tick.state.q for tick in ticks]), [tick.state.stamp_ns for tick in ticks]


def distance_from_target(q: np.ndarray) -> float:
    return float(np.linalg.norm(RobotModel(ARM).tip_pose(q)[0] - FREE_SCENE.target))


def assert_identical(first: tuple, second: tuple) -> None:
    assert first[0] == second[0] and first[3] == second[3]
    np.testing.assert_array_equal(first[1], second[1])
    np.testing.assert_array_equal(first[2], second[2])


@pytest.fixture(scope="module")
def first_stack() -> Stack:
    """One that has made its own parts."""
    return Stack(FREE_SCENE, planning=SMALL, seed=1)


@pytest.fixture(scope="module")
def free_run(first_stack) -> tuple:
    return watched(first_stack)


@pytest.fixture(scope="module")
def core(first_stack, free_run) -> PlanningCore:
    """Of stacks that need not compile one of their own; each resets it."""
    return first_stack.planner.core


def staying(**others) -> Stack:
    return Stack(FREE_SCENE, planner=StayingCore(), **others)


class TestRun:
    def test_it_reaches_a_goal(self, free_run):
        result, torques, angles, stamps = free_run
        assert result.reached and not result.stop_reason
        assert result.distance <= GOAL.tolerance
        assert 1.0 < result.duration < 6.0
        assert result.max_contact_force == 0.0
        # One each 30 ms, and the first at once.
        assert result.plans == 1 + round(1000 * result.duration - 1) // 30
        assert np.isfinite(torques).all() and (np.abs(torques) <= ARM.torque_limits).all()
        assert distance_from_target(angles[-1]) == pytest.approx(result.distance, abs=1e-9)
        assert set(np.diff(stamps)) == {TICK_NS}

    def test_same_seed_same_result_whatever_is_planned_beside_it_and_other_seeds_other_ones(self, core, free_run):
        stack, beside = Stack(FREE_SCENE, planner=core, seed=1), Goal([0.4, -0.3, 0.5], FREE)
        stack.plan(beside)
        ticks = itertools.count()
        assert_identical(free_run, watched(stack, each_tick=lambda: next(ticks) % 400 == 7 and stack.plan(beside)))
        assert next(ticks) > 1000
        other = watched(Stack(FREE_SCENE, planner=core, seed=2), timeout=0.1)
        assert not np.array_equal(other[1], free_run[1][: len(other[1])])

    def test_it_waits_until_the_tip_has_settled_if_asked_to(self):
        stack, seen = staying(), []
        goal = Goal(stack.tip_position, tolerance=0.05)
        assert not stack.run(goal, 1.0).settled
        assert stack.run(goal, 1.0, seen.append, until_settled=True).settled
        assert 200 <= len(seen) <= 210
        assert not stack.run(dataclasses.replace(goal, rest_speed=1e-6), 0.5, until_settled=True).settled

    @pytest.mark.parametrize("act", [Stack.run, Stack.plan, Stack.command])
    def test_a_goal_that_cannot_be_reached_is_refused_before_anything_moves(self, act):
        stack = staying()
        with pytest.raises(InputError, match=r"goal: position is .*the arm reaches"):
            act(stack, BEYOND)
            stack.step()
        assert stack.planner.goal is None

    @pytest.mark.parametrize(("error", "gives_up"), [(PlanningError, False), (UnreachableError, True)])
    def test_a_run_ends_when_the_planner_gives_up_and_says_why_there_is_no_plan(self, error, gives_up):
        stack, seen = Stack(FREE_SCENE, planner=StayingCore(3, error)), []
        result = stack.run(GOAL, 1.0, seen.append)
        assert (result.reached, result.stop_reason, result.plans) == (False, "there is no way to the goal", 3)
        assert stack.planner.has_goal != gives_up == (len(seen) < 200)
        assert not stack.stop_reason


class TestStop:
    def test_it_withdraws_the_goal_until_there_is_another_one(self):
        stack = staying()
        stack.settle()
        stack.command(GOAL)
        stack.step()
        assert stack.planner.goal is not None
        stack.stop("enough")
        ticks = [stack.step() for _ in range(200)]
        assert stack.stop_reason == "enough" and stack.stop_reason.code is StopCode.REQUEST
        assert stack.planner.goal is None
        assert all(tick.plan is None for tick in ticks)
        stack.reset()
        assert not stack.stop_reason
        assert all(stack.step().plan is None for _ in range(100))
        stack.command(GOAL)
        assert stack.step().plan is not None

    def test_a_push_beyond_the_budget_stops_the_arm(self):
        robot = SimulatedRobot(FREE_SCENE, noise_seed=0)
        stack = Stack(FREE_SCENE, planner=StayingCore(), robot=robot)

        def push(tick: Tick) -> None:
            body = robot.plant.model.body(ARM.link_names[4]).id
            robot.plant.data.xfrc_applied[body, :3] = 0.0, 0.0, -80.0

        result = stack.run(GOAL, 1.0, push)
        assert "torque on lbr_A" in result.stop_reason
        with pytest.raises(InputError):
            stack.reset()
        assert stack.stop_reason == result.stop_reason


class TestOwnRobot:
    def test_a_plain_simulation_that_reports_at_200_hz_reaches_the_goal(self, core):
        robot = PlainRobot(EMPTY_SCENE.start, steps=5)
        stack = Stack(EMPTY_SCENE, planner=core, robot=robot, period=0.005)
        result, torques, _, stamps = watched(stack)
        assert result.reached and math.isnan(result.max_contact_force)
        assert set(np.diff(stamps)) == {5 * TICK_NS} and np.isfinite(torques).all()
        assert stack.observer.monitor.contacts == 0 and stack.observer.momentum.gaps == 0
        assert distance_from_target(robot.data.qpos.copy()) == pytest.approx(result.distance, abs=1e-9)

    def test_one_that_does_not_report_obstacles_where_there_are_some_gets_no_plan(self):
        stack = Stack(load_scene("ball"), planner=StayingCore(), robot=PlainRobot())
        for ask in (stack.plan, stack.run):
            with pytest.raises(InputError, match=r"^obstacles: none received yet; .*require_obstacles"):
                ask(Goal([0.5, 0.1, 0.3]))

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda state: [state._replace(q=BAD)], "joint_states: position = .*nan.*; expected finite values"),
            (lambda state: [state._replace(v=BAD)], "joint_states: velocity = .*nan.*; expected finite values"),
            (lambda state: [state, state._replace()], "joint state of 50000000 ns came again or late"),
        ],
    )
    def test_a_state_that_is_not_finite_or_comes_again_is_refused_and_named(self, change, message):
        stack = staying(robot=OddRobot(lambda count, states: change(states[0]) if count == 50 else states))
        with pytest.raises(InputError, match=message):
            stack.settle(0.1)

    def test_states_that_arrive_together_are_all_answered(self):
        waiting: list[JointState] = []

        def change(count: int, states: list[JointState]) -> list[JointState]:
            waiting.extend(states)
            if count % 2 and count > 10:
                return []
            arrived = waiting.copy()
            waiting.clear()
            return arrived

        stack = staying(robot=OddRobot(change))
        for _ in range(100):
            stack.step()
        assert not stack.stop_reason
        assert len(stack.robot.commands) == 98
        assert stack.observer.updates == 99

    def test_one_without_a_state_to_begin_with_is_refused(self):
        with pytest.raises(InputError, match=r"robot: read\(\) returned no joint state"):
            staying(robot=OddRobot(lambda count, states: []))


class TestFaults:
    """A robot with faults sends on purpose what others must not; it is refused and counted."""

    def test_joint_states(self):
        robot = FaultyRobot(FREE_SCENE, [NotFinite("states", "position", share=0.3)], noise_seed=0)
        stack = Stack(FREE_SCENE, planner=StayingCore(), robot=robot)
        stack.settle()
        robot.start_faults()
        assert not stack.run(GOAL, 0.5).stop_reason
        assert stack.refused["joint states"] == stack.refused["observed joint states"] > 50

    def test_the_goal_is_withdrawn_when_the_robot_pauses_for_long(self):
        for pause, is_left in ((0.06, True), (0.5, False)):
            faults = [Silent("driver", duration=pause)]
            robot = EpisodeRobot(FREE_SCENE, faults=faults, noise_seed=0, period=0.005)
            stack = Stack(FREE_SCENE, planner=StayingCore(), robot=robot, period=0.005)
            stack.settle()
            stack.command(GOAL)
            robot.start_faults()
            stack.settle(0.9 + pause)
            assert (stack.planner.goal is not None) == is_left


def test_the_planner_knows_when_the_controller_drops_its_plans():
    controller = ControllerSettings(supervision=SupervisionSettings(max_position_error=0.2))
    stack = Stack(FREE_SCENE, planning=SMALL, controller=controller)
    assert stack.planner.core.basis["supervision.max_position_error"] == 0.2
    core = RecedingHorizonPlanner(ARM, SMALL, ControllerSettings(), 10.0, 0)
    with pytest.raises(SettingsError, match=r"max_position_error = [\d.]+ in the planner, 0.2 in the controller"):
        Stack(FREE_SCENE, planner=core, controller=controller)
