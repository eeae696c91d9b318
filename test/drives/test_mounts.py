"""Arms on a ceiling and on a slope, behind the adapter's parts: carried, moved, stopped with a wrong model."""

import dataclasses
import math

import numpy as np
import pytest
from arm_simulation import ARM
from kuka import LATER, Adapted, Guarded, KukaRobot
from test_fri import BehindAdapter, LineCore

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import mounted
from contact_reach_ros.doctor.arm import JointRecord, gravity
from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.drives.command_guard import CommandGuard, Phase
from contact_reach_ros.drives.settings import AdapterSettings
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.scenes.generate import load_scene
from contact_reach_ros.simulation.plant import Actuation
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.simulation.settings import WatchdogSettings
from contact_reach_ros.stack import Stack
from contact_reach_ros.world.goal import Goal

MOUNTS = {"ceiling": (math.pi, 0.0, 0.0), "slope": (math.radians(5.0), 0.0, 0.0)}
WORDS = {"ceiling": "gravity (0, 0, 9.81) m/s² in lbr_link_0, whose z axis is 180.0° from up", "slope": "5.0° from up"}
STEPS = [0.05, 0.05, -0.05], [-0.05, -0.2, 0.1]
"""From where the tip is at home to the goals, m in the base frame."""


def arm_on(mount):
    return dataclasses.replace(ARM, gravity=mounted(MOUNTS[mount]))


class Carried(Guarded):
    """A robot for `Stack`: an arm that holds the last torque for ever, behind the guard that carries it."""

    def __init__(self, arm, assumed):
        self.robot = SimulatedRobot(load_scene("free", arm), WatchdogSettings(enabled=False))
        hold = ContactBudget().resolve(assumed).handover_thresholds
        self.guard = CommandGuard(assumed, AdapterSettings(), 0.001, hold)
        self.robot.step(0)

    def command(self, torque, clock_ns):
        self._send(self.guard.command(torque, clock_ns), clock_ns)

    def step(self, clock_ns):
        self._send(self.guard.watch(clock_ns), clock_ns)
        self.robot.step(clock_ns)

    def read(self):
        (state,) = self.robot.read()
        self.guard.see(state, self.robot.now_ns)
        return [state]

    def _send(self, torque, clock_ns):
        if torque is not None:
            self.robot.command(torque, clock_ns)


def two_goals(stack):
    home = stack.robot.robot.plant.tip_position
    for step in STEPS:
        result = stack.run(Goal((home + step).tolist()), until_settled=True)
        assert result.settled and result.distance < 0.001, result
    assert stack.observer.monitor.contacts == 0


@pytest.mark.parametrize("mount", ["ceiling", pytest.param("slope", marks=pytest.mark.slow)])
def test_kukas_arm_reaches_two_goals_wherever_it_is_mounted(mount):
    stack = BehindAdapter(Adapted(KukaRobot(load_scene("free", arm_on(mount)), 0.002, LATER)))
    stack.settle(2.0)
    assert not stack.robot.problem
    two_goals(stack)


@pytest.mark.parametrize("mount", ["ceiling", pytest.param("slope", marks=pytest.mark.slow)])
def test_an_arm_that_the_adapter_carries_reaches_two_goals_and_is_held_when_commands_cease_in_motion(mount):
    arm = arm_on(mount)
    stack = Stack(load_scene("free", arm), planner=LineCore(), robot=Carried(arm, arm))
    two_goals(stack)
    robot, plant = stack.robot, stack.robot.robot.plant
    stack.command(Goal(plant.tip_position + STEPS[0]))
    while np.abs(robot.read()[0].v).max() < 0.15:
        stack.step()
    for _ in range(1000):
        robot.step(robot.robot.now_ns)
        (state,) = robot.read()
    assert robot.guard.stop_reason.startswith("no command for") and np.abs(state.v).max() < 0.01


def test_a_model_that_stands_is_stopped_on_a_ceiling_as_soon_as_the_brakes_open():
    robot = SimulatedRobot(load_scene("free", arm_on("ceiling")))
    start = robot.plant.tip_position
    stack = Stack(load_scene("free"), planner=LineCore(), robot=robot)
    stack.settle(1.0)
    stop = stack.observer.monitor.stop_reason
    assert stop.startswith("at hand-over external torque on lbr_A2")
    assert stop.endswith("it assumes gravity 9.81 m/s² along -z of lbr_link_0")
    # Its weight acts twice, until the brakes close again.
    assert robot.plant.actuation is Actuation.BRAKED and np.linalg.norm(robot.plant.tip_position - start) < 0.06


def test_a_model_that_stands_is_refused_on_a_ceiling_before_torques_where_the_driver_holds_the_arm():
    robot = Adapted(KukaRobot(load_scene("free", arm_on("ceiling")), 0.002, LATER))
    stack = BehindAdapter(robot, load_scene("free"))
    stack.settle(2.0)
    stop = stack.observer.monitor.stop_reason
    assert stop.startswith("at hand-over") and stop.endswith("it assumes gravity 9.81 m/s² along -z of lbr_link_0")
    assert robot.guard.phase is Phase.WAITING and robot.moved < 0.001


@pytest.mark.parametrize(("mount", "verdict"), [("ceiling", Verdict.FAIL), ("slope", Verdict.WARN)])
def test_the_doctor_doubts_a_model_that_stands_and_passes_the_right_one(mount, verdict):
    arm = arm_on(mount)
    stack = Stack(load_scene("free", arm), planner=LineCore(), robot=Carried(arm, arm))
    stack.settle(1.0)
    states = [stack.step().state for _ in range(500)]
    stamps = np.array([state.stamp_ns for state in states])
    record = JointRecord((arm.joint_names,), stamps, stamps, *np.array([state[1:4] for state in states]).swapaxes(0, 1))
    budget = ContactBudget().resolve(arm)
    right, wrong = (gravity(record, RobotModel(each), budget) for each in (arm, ARM))
    assert right.verdict is Verdict.PASS and right.found.endswith(WORDS[mount])
    assert wrong.verdict is verdict and wrong.found.endswith("along -z of lbr_link_0")
