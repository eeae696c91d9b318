"""A stop takes energy out of the arm, lets go of what the arm presses, and holds what a start accepts."""

from collections import deque

import numpy as np
import pinocchio as pin
import pytest
from arm_simulation import ARM, FAR, HOME, IDEAL, NO_FRICTION, TICK_NS, TOOL, ClosedLoop, ideal_plant

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.tool import Tool
from contact_reach_ros.arms import load_arm
from contact_reach_ros.control.constants import make_constants
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.kernels import Constant, yielded
from contact_reach_ros.control.passive_stop import BRAKING_TIME, PassiveStop
from contact_reach_ros.control.settings import ControllerSettings, LimitSettings, SupervisionSettings
from contact_reach_ros.simulation.plant import Actuation, Plant
from contact_reach_ros.world.scene import Scene

PATIENT = ControllerSettings(supervision=SupervisionSettings(require_observer=False, drive_brakes=False, **FAR))
"""To see the stop alone, however long it takes."""
CENTER = np.array([0.02, 0.0, 0.1])
"""Of an unknown load, in the frame of the last link, m."""
STEP = 5e-4
"""Of the simulated arm, s."""


class StoppedArm:
    """A frictionless arm in a stop whose torques act late; what it carries is not what its model says.

    A load, kg, that the model lacks, or has too much of where it is negative, is as large as a hand-over accepts.
    """

    def __init__(self, arm, random, period, delay, load, torque_rate):
        self.hold = np.array(arm.default("handover_thresholds"))
        self.true, tool = RobotModel(arm).pinocchio, Tool()
        self.q = random.uniform(arm.lower + 0.2, arm.upper - 0.2)
        self.data = self.true.createData()
        lacking = abs(load) * self.weight_per_kg(arm.n)
        load /= max(1.0, float((np.abs(lacking) / self.hold).max()))
        if load < 0.0:
            inertia = (*[-0.002 * load] * 3, 0.0, 0.0, 0.0)
            tool = Tool(mass=-load, center=tuple(CENTER - arm.tip_offset), inertia=inertia)
        else:
            body = pin.Inertia(load, CENTER, 0.002 * load * np.eye(3))
            self.true.inertias[arm.n] = self.true.inertias[arm.n] + body
        self.model = RobotModel(arm.with_tool(tool))
        constants = make_constants(arm, limits=LimitSettings(torque_rate=torque_rate), period=period)
        self.stop = PassiveStop(arm.with_tool(tool), constants)
        self.v = random.uniform(-0.4, 0.4, arm.n) * np.array(arm.velocity_limits)
        self.model.update(self.q, self.v)
        # Slower than every arm is by the shipped settings.
        self.v *= min(1.0, 0.3 / float(np.linalg.norm(self.model.twist[:3])))
        self.sent = pin.computeGeneralizedGravity(self.true, self.data, self.q).copy()
        self.random, self.period, self.time = random, period, 0.0
        self.late = deque([self.sent] * (round(delay / STEP) + 1))

    def weight_per_kg(self, link):
        """Torques (n,), N m, that carry a mass of 1 kg at `CENTER` of the last link."""
        placed = pin.computeJointJacobian(self.true, self.data, self.q, link)
        lever = self.data.oMi[link].rotation @ CENTER
        world = (
            self.data.oMi[link].rotation @ placed[:3] - np.cross(lever, (self.data.oMi[link].rotation @ placed[3:]).T).T
        )
        return 9.81 * world[2]

    def advance(self, link=0, force=None):
        """One period, in which a force (3,), N, pushes a link; returns work, J, and the tip's speed, m/s."""
        noise = self.random.standard_normal((2, len(self.q)))
        q, v = self.q + 1e-5 * noise[0], self.v + 1e-3 * noise[1]
        self.model.update(q, v)
        self.sent = self.stop.torque(self.model, q, v, self.sent, self.period)
        work = 0.0
        for _ in range(round(self.period / STEP)):
            self.late.append(self.sent)
            torque = self.late.popleft()
            work += STEP * float((torque - self.model.gravity) @ self.v)
            if force is not None:
                jacobian = pin.computeJointJacobian(self.true, self.data, self.q, link)[:3]
                torque = torque + jacobian.T @ (self.data.oMi[link].rotation.T @ force)
            self.v = self.v + STEP * pin.aba(self.true, self.data, self.q, self.v, torque)
            self.q = self.q + STEP * self.v
        self.time += self.period
        self.model.update(self.q, self.v)
        return work, float(np.linalg.norm(self.model.twist[:3]))

    @property
    def storable(self):
        """The most that the hold can store, J."""
        return 0.5 * self.hold @ np.linalg.solve(self.stop._stiffness, self.hold)


@pytest.mark.parametrize("load", [-1.0, 0.0, 3.0])
@pytest.mark.parametrize("name", ["iiwa14", "panda", "ur10", "xarm7"])
def test_damping_and_hold_do_no_more_work_than_the_hold_stores(name, load):
    random = np.random.default_rng([ord(name[0]), round(10 * load + 20)])
    for rate, torque_rate in ((1000.0, 4000.0), (500.0, 1000.0), (200.0, 4000.0)):
        stopped = StoppedArm(load_arm(name), random, 1.0 / rate, 0.01, load, torque_rate)
        done, most, link, force = 0.0, 0.0, 0, None
        while stopped.time < 1.2:
            if round(rate * stopped.time) % round(0.1 * rate) == 0:
                link, force = int(random.integers(stopped.model.arm.n - 3, stopped.model.arm.n + 1)), None
                if random.random() < 0.6:
                    force = random.uniform(-15.0, 15.0, 3)
            work, speed = stopped.advance(link, force if stopped.time > BRAKING_TIME else None)
            if stopped.time > BRAKING_TIME:
                done += work
                most = max(most, done)
                assert speed <= 0.3
        assert most <= stopped.storable


def test_no_torque_of_the_stop_depends_on_how_fast_joints_turn_each_other():
    """Without a Coriolis term: gravity, and what is proportional to the mass matrix."""
    model, v = RobotModel(ARM), np.full(ARM.n, 0.002)
    constants = make_constants(ARM)
    model.update(HOME, v)
    torque = PassiveStop(ARM, constants).torque(model, HOME, v, model.gravity.copy(), 0.001)
    expected = model.gravity - constants[Constant.STOP_RATE, 0] * model.mass_matrix @ v
    np.testing.assert_allclose(torque, expected, atol=1e-9)


def test_a_hold_that_yields_stores_no_more_than_before():
    random = np.random.default_rng(1)
    for _ in range(50):
        root = random.standard_normal((7, 7))
        stiffness, most = root @ root.T + 0.1 * np.eye(7), random.uniform(0.5, 5.0, 7)
        tension = random.uniform(-10.0, 10.0, 7)
        found = yielded(tension, most, np.linalg.inv(stiffness))
        assert (np.abs(found) <= most).all()
        stored = [torque @ np.linalg.solve(stiffness, torque) for torque in (tension, found)]
        assert stored[1] <= stored[0] + 1e-9
    np.testing.assert_array_equal(yielded(0.3 * most, most, np.linalg.inv(stiffness)), 0.3 * most)


class Body:
    """A body of some stiffness, N/m, that is clamped between a wall and the origin of a link."""

    def __init__(self, loop, link, stiffness, normal):
        self.plant, self.link, self.stiffness = loop.plant, link, stiffness
        self.normal = normal / np.linalg.norm(normal)
        self.index = self.plant.model.body(link).id
        self.surface = self.plant.data.xpos[self.index].copy()
        self.force, self._depth = 0.0, 0.0

    def press(self):
        depth = float((self.surface - self.plant.data.xpos[self.index]) @ self.normal)
        rate, self._depth = (depth - self._depth) / 0.001, depth
        self.force = max(self.stiffness * depth + 20.0 * rate, 0.0) if depth > 0.0 else 0.0
        self.plant.set_pushes([(self.link, self.force * self.normal, np.zeros(3))])


@pytest.mark.parametrize(("stiffness", "most"), [(75e3, 2.0), (25e3, 2.0), (10e3, 3.5)])
def test_what_the_arm_presses_is_let_go_within_a_second(stiffness, most):
    random = np.random.default_rng(round(stiffness))
    for link in ("lbr_link_7", "lbr_link_5"):
        loop = ClosedLoop(ideal_plant(start=HOME + random.uniform(-0.3, 0.3, ARM.n)), PATIENT)
        loop.finish(0.6)
        body = Body(loop, link, stiffness, random.standard_normal(3))
        while body.force < 20.0:
            body.surface += 2e-5 * body.normal
            for _ in loop.run(0.001, body.press):
                pass
        loop.controller.stop("test")
        forces = []
        for _ in loop.run(2.0, body.press):
            forces.append(body.force)
        assert max(forces) < 1.1 * 20.0
        assert max(forces[1000:]) <= most


@pytest.mark.parametrize("seed", range(4))
def test_an_arm_that_was_handed_over_pressed_stays_when_it_is_released(seed):
    random = np.random.default_rng(seed)
    loop = ClosedLoop(ideal_plant(start=HOME + random.uniform(-0.5, 0.5, ARM.n)), PATIENT)
    force = random.standard_normal(3)
    loop.plant.set_pushes([("lbr_link_7", 15.0 * force / np.linalg.norm(force), np.zeros(3))])
    loop.finish(1.5)
    stopped_at = loop.plant.tip_position
    loop.controller.stop("test")
    for tick, _ in enumerate(loop.run(2.0)):
        if tick == 1000:
            loop.plant.set_pushes([])
        assert np.linalg.norm(loop.plant.tip_position - stopped_at) <= 0.015


@pytest.mark.parametrize("mass", [0.3, 1.2])
def test_a_tool_that_the_drive_carries_and_the_model_lacks_stays_where_it_is(mass):
    """Nothing that anybody estimates is sent: the drive carries the arm, and damping and hold ask for no motion."""
    held = SupervisionSettings(require_observer=False, drive_brakes=False, gravity_compensation=False, **FAR)
    controller = Controller(ARM, ControllerSettings(supervision=held))
    true = ARM.with_tool(Tool(mass=mass, center=(0.0, 0.0, 0.06), inertia=(0.002, 0.002, 0.001, 0.0, 0.0, 0.0)))
    plant = Plant(Scene("gripper", true, 0, HOME, np.zeros(3), mismatch=IDEAL), NO_FRICTION)
    plant.set_actuation(Actuation.COMMANDED)
    drive = RobotModel(true)
    controller.start(HOME, np.zeros(ARM.n), 0)
    stopped_at = None
    for tick in range(1, 11_000):
        plant.step(controller.update(plant.read(), tick * TICK_NS) + drive.gravity_at(plant.joint_positions))
        if tick == 1000:
            controller.stop("test")
            stopped_at = plant.tip_position
        assert stopped_at is None or np.linalg.norm(plant.tip_position - stopped_at) <= 0.005


def test_a_push_above_the_hold_moves_the_arm_and_a_release_leaves_it_there():
    loop = ClosedLoop(ideal_plant(), PATIENT)
    loop.finish(0.3)
    loop.controller.stop("test")
    loop.finish(0.6)
    start = loop.plant.tip_position
    loop.plant.set_pushes([("lbr_link_7", np.array([0.0, 40.0, 0.0]), np.zeros(3))])
    loop.finish(1.0)
    pushed = loop.plant.tip_position
    assert pushed[1] - start[1] > 0.03
    loop.plant.set_pushes([])
    loop.finish(1.0)
    assert np.linalg.norm(loop.plant.tip_position - pushed) < 0.02
    assert np.abs(loop.v).max() < 0.01


def test_gains_do_not_count_on_the_tool():
    with_tool = PassiveStop(ARM.with_tool(TOOL), make_constants(ARM))
    bare, model, v = RobotModel(ARM), RobotModel(ARM.with_tool(TOOL)), np.full(ARM.n, 0.002)
    for each in (bare, model):
        each.update(HOME, v)
    torque = with_tool.torque(model, HOME, v, model.gravity.copy(), 0.001)
    damping = make_constants(ARM)[Constant.STOP_RATE, 0] * bare.mass_matrix @ v
    np.testing.assert_allclose(torque, model.gravity - damping, atol=1e-9)
