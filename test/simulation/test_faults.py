"""What each fault does to messages, robot and surroundings."""

import numpy as np
import pytest
from arm_simulation import ARM, NO_FRICTION
from arm_simulation import TICK_NS as MS

from benchmarks.faulty_robot import (
    Fault,
    Faults,
    FaultyPlant,
    Friction,
    Late,
    Lost,
    NotFinite,
    Payload,
    Push,
    RivalCommands,
    StuckEncoder,
    TorqueSensor,
    UnknownObstacle,
    WrongClock,
)
from contact_reach_ros.arm import JointState
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.simulation.plant import FRICTION, Actuation, Plant
from contact_reach_ros.world.scene import MismatchSettings, Scene

START = np.array([0.1, 0.6, -0.2, -1.3, 0.3, 0.8, -0.4])
OBSTACLE = UnknownObstacle((0.6, 0.0, 0.3))
STATE = JointState(0, np.linspace(0.1, 0.7, 7), np.linspace(-0.3, 0.3, 7), np.linspace(1.0, 7.0, 7))


def make_plant(
    payload: float = 0.0, unknown: UnknownObstacle | None = None, friction: tuple[float, float] = NO_FRICTION
) -> FaultyPlant:
    mismatch = MismatchSettings("nominal", payload, friction_scale=1.0, noise_scale=0.0, foam_variation=0.0)
    scene = Scene("test", ARM, 0, START, np.zeros(3), mismatch=mismatch)
    return FaultyPlant(scene, friction, unknown=unknown)


def playing(*faults: Fault, plant: FaultyPlant | None = None, seed: int = 0) -> Faults:
    played = Faults(faults, seed, plant or make_plant())
    played.start(0)
    return played


class TestChecks:
    @pytest.mark.parametrize(
        ("make", "said"),
        [
            (lambda: Lost("command"), "expected commands or states or efforts or obstacles"),
            (lambda: NotFinite("commands", "velocity"), "expected effort, or position or velocity of joint states"),
            (lambda: Lost("commands", at=-1.0), "expected at >= 0 s"),
            (lambda: playing(StuckEncoder("A2")), "joint 'A2' is unknown; the arm's joints are lbr_A1"),
            (lambda: playing(Push("link_4", (0.0, 50.0, 0.0))), "expected one of the links lbr_link_1"),
            (lambda: playing(OBSTACLE, OBSTACLE), "one unknown obstacle at most"),
        ],
    )
    def test_what_is_wrong_is_named(self, make, said):
        with pytest.raises(SettingsError, match=said):
            make()


def sent_commands(faults: Faults, ticks: int = 1000) -> list[list[float]]:
    """What arrives in each of so many ticks when command k holds k everywhere."""
    arrived = []
    for tick in range(ticks):
        faults.send_command(np.full(ARM.n, float(tick)), tick * MS)
        arrived.append([command[0] for command in faults.commands(tick * MS)])
    return arrived


class TestMessages:
    def test_nothing_happens_outside_the_time(self):
        arrived = sent_commands(playing(Lost("commands", at=0.1, duration=0.2)))
        assert [tick for tick, commands in enumerate(arrived) if not commands] == list(range(100, 300))
        assert all(commands == [float(tick)] for tick, commands in enumerate(arrived) if commands)

    def test_delay_keeps_the_order(self):
        arrived = sent_commands(playing(Late("commands", 0.01, at=0.1, duration=0.1)))
        assert arrived[105] == [] and arrived[110] == [100.0] and arrived[199] == [189.0]
        # When the delay ends, what is under way still comes first.
        assert arrived[200:208] == [[190.0 + tick] for tick in range(8)]
        assert arrived[209] == [199.0, 200.0, 201.0, 202.0, 203.0, 204.0, 205.0, 206.0, 207.0, 208.0, 209.0]
        assert arrived[210] == [210.0]

    @pytest.mark.parametrize(("field", "name"), [("position", "q"), ("effort", "torque")])
    def test_nan_states(self, field, name):
        faults = playing(NotFinite("states", field))
        (state,) = faults.joint_states(STATE)
        assert np.isnan(getattr(state, name)).all()
        assert np.isfinite(state.v).all()
        assert np.isfinite(STATE.q).all()

    @pytest.mark.parametrize(("step", "expected"), [(-0.5, [99, -400, -301, 200]), (0.0, [99, 100, 100, 200])])
    def test_a_clock_jumps_or_is_frozen(self, step, expected):
        faults = playing(WrongClock(step=step, at=0.1, duration=0.1))
        stamps = []
        for tick in (99, 100, 199, 200):
            stamps += [state.stamp_ns // MS for state in faults.joint_states(STATE._replace(stamp_ns=tick * MS))]
        assert stamps == expected

    def test_a_second_publisher_of_commands_has_the_last_word(self):
        faults = playing(RivalCommands(3.0), Late("commands", 0.001, at=0.01))
        faults.send_command(np.ones(7), 0)
        assert [command[0] for command in faults.commands(0)] == [1.0, 3.0]


class TestSensors:
    def test_stuck_encoder(self):
        moving = [STATE._replace(q=STATE.q + tick, stamp_ns=tick * MS) for tick in range(3)]
        faults = playing(StuckEncoder("lbr_A2", at=0.001))
        stuck = [state for one in moving for state in faults.joint_states(one)]
        assert [state.q[1] for state in stuck] == [STATE.q[1] + at for at in (0, 1, 1)]
        assert [state.v[1] for state in stuck] == [STATE.v[1], 0.0, 0.0]
        np.testing.assert_array_equal(stuck[2].q[2:], moving[2].q[2:])
        (honest,) = playing(StuckEncoder("lbr_A2", own_velocity=True)).joint_states(STATE)
        assert honest.v[1] == STATE.v[1]

    def test_torque_sensor(self):
        (wrong,) = playing(TorqueSensor("lbr_A4", gain=-1.0, bias=2.0)).joint_states(STATE)
        assert wrong.torque[3] == -STATE.torque[3] + 2.0
        np.testing.assert_array_equal(np.delete(wrong.torque, 3), np.delete(STATE.torque, 3))


def accelerations(plant: Plant, torque: np.ndarray, steps: int = 20) -> np.ndarray:
    """Joint velocities after a few steps, rad/s."""
    plant.set_actuation(Actuation.COMMANDED)
    for _ in range(steps):
        plant.step(torque)
    return plant.data.qvel[: ARM.n].copy()


class TestRobot:
    def test_payload_acts_like_one_that_was_there_from_the_start(self):
        torque = RobotModel(ARM).gravity_at(START)
        picked = make_plant()
        faults = playing(Payload(2.0, duration=0.5), plant=picked)
        faults.act(0)
        expected = accelerations(make_plant(payload=2.0), torque)
        np.testing.assert_allclose(accelerations(picked, torque), expected, rtol=1e-6, atol=1e-9)
        assert np.abs(expected).max() > 0.05
        faults.act(600 * MS)
        assert picked.model.body_mass.sum() == pytest.approx(make_plant().model.body_mass.sum())

    def test_push_is_the_wrench_at_its_point(self):
        plant, model = make_plant(), RobotModel(ARM)
        point, force = np.array([0.0, 0.0, 0.045]), np.array([10.0, -20.0, 5.0])
        plant.set_pushes([("lbr_link_7", force, point)])
        plant.set_actuation(Actuation.COMMANDED)
        plant.step(model.gravity_at(START))
        # The flange is 45 mm before link 7.
        torque = model.jacobian_at(START)[:3].T @ force
        model.update(START, np.zeros(ARM.n))
        np.testing.assert_allclose(model.mass_matrix @ plant.data.qvel[: ARM.n] / 0.001, torque, atol=0.1)
        plant.set_pushes([])
        assert not plant.data.xfrc_applied.any()

    def test_friction(self):
        plant = make_plant(friction=FRICTION)
        plant.set_actuation(Actuation.COMMANDED)
        faults = playing(Friction(10.0, at=0.1, duration=0.1), Friction(2.0, at=0.15), plant=plant)
        seen = []
        for tick in (0, 100, 150, 200):
            faults.act(tick * MS)
            seen.append((plant.model.dof_damping[0], plant.model.dof_frictionloss[0]))
        np.testing.assert_allclose(seen, [(0.3, 0.2), (3.0, 2.0), (6.0, 4.0), (0.6, 0.4)])
