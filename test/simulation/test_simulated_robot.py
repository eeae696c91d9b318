"""The robot's own watchdog."""

import math

import numpy as np
import pytest
from arm_simulation import ARM, HOME, REST, TICK_NS, VELOCITY_LIMITS, ideal_plant

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import InputError
from contact_reach_ros.simulation.plant import FRICTION, Actuation
from contact_reach_ros.simulation.robot import SimulatedRobot
from contact_reach_ros.simulation.settings import WatchdogSettings

GRAVITY = RobotModel(ARM).gravity_at(HOME)


class Bench:
    """A robot that is stepped at 1 kHz."""

    def __init__(self, open_after: float = 0.0, **watchdog: bool) -> None:
        # Brakes that open at once, except where that is what is tested.
        plant = ideal_plant(friction=FRICTION)
        self.robot = SimulatedRobot(plant.scene, WatchdogSettings(**watchdog), plant=plant, open_after=open_after)
        self.clock_ns = 5_000_000_000

    def command(self, torque: np.ndarray = GRAVITY) -> None:
        self.robot.command(torque, self.clock_ns)

    def tick(self, count: int = 1) -> list[Actuation]:
        """What moved the joints in each tick."""
        seen = []
        for _ in range(count):
            self.robot.step(self.clock_ns)
            seen.append(self.robot.plant.actuation)
            self.clock_ns += TICK_NS
        return seen

    @property
    def displacement(self) -> float:
        return float(np.abs(self.robot.plant.data.qpos - HOME).max())


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_arm_stays_where_it_is_until_the_first_command(bench):
    assert set(bench.tick(500)) == {Actuation.BRAKED}
    assert bench.displacement < 1e-9
    assert not bench.robot.stop_reason
    bench.command()
    assert bench.tick() == [Actuation.COMMANDED]


def test_brakes_open_only_after_steady_commands():
    bench = Bench(open_after=0.1)
    for _ in range(3):
        # A controller that is starting up: some commands, then a pause.
        for _ in range(60):
            bench.command()
            assert bench.tick() == [Actuation.BRAKED]
        assert set(bench.tick(150)) == {Actuation.BRAKED}
    assert not bench.robot.stop_reason
    seen = []
    for _ in range(120):
        bench.command()
        seen += bench.tick()
    assert seen == [Actuation.BRAKED] * 100 + [Actuation.COMMANDED] * 20
    assert set(bench.tick(150)) == {Actuation.COMMANDED, Actuation.DAMPED_HOLD, Actuation.BRAKED}
    assert "no command" in bench.robot.stop_reason


def test_silence_brings_first_the_damped_hold_and_then_the_brakes(bench):
    # The last command does not hold the arm.
    bench.command(REST)
    bench.tick(60)
    bench.command(REST)
    assert bench.tick() == [Actuation.COMMANDED]
    seen = bench.tick(400)
    assert seen[:20] == [Actuation.COMMANDED] * 20
    assert seen[20:100] == [Actuation.DAMPED_HOLD] * 80
    assert set(seen[100:]) == {Actuation.BRAKED}
    assert np.abs(bench.robot.plant.data.qvel).max() < 1e-3 and bench.displacement < 0.1
    assert bench.robot.stop_reason == "no command for 101 ms"


def test_after_a_reset_the_brakes_open_with_the_next_command(bench):
    bench.command()
    bench.tick(150)
    bench.command()
    bench.robot.reset()
    assert bench.robot.stop_reason == ""
    assert set(bench.tick(200)) == {Actuation.BRAKED}
    bench.command()
    assert bench.tick() == [Actuation.COMMANDED]


def test_without_a_watchdog_the_last_torque_is_held_for_ever_but_brakes_close_on_demand():
    bench = Bench(enabled=False)
    bench.command()
    assert set(bench.tick(2000)) == {Actuation.COMMANDED}
    bench.robot.stop("button")
    assert bench.tick() == [Actuation.BRAKED]


@pytest.mark.parametrize("command", [np.zeros(6), np.array([0, 0, math.nan, 0, 0, 0, 0])])
def test_bad_commands_are_refused_and_do_not_feed_the_watchdog(bench, command):
    bench.command(GRAVITY)
    for refused in range(150):
        with pytest.raises(InputError, match=r"^effort_controller/commands: "):
            bench.command(command)
        bench.tick()
        if refused == 5:
            np.testing.assert_array_equal(bench.robot.plant.read().torque, GRAVITY)
    assert bench.robot.stop_reason


@pytest.mark.parametrize(("speed", "stops"), [(1.09, False), (1.11, True)])
def test_a_joint_that_is_too_fast_closes_the_brakes(bench, speed, stops):
    bench.command()
    bench.tick()
    bench.robot.plant.data.qvel[4] = -speed * VELOCITY_LIMITS[4]
    bench.command()
    bench.tick()
    assert bool(bench.robot.stop_reason) == stops
    if stops:
        assert bench.robot.stop_reason.startswith("lbr_A5 moves with 2.5")
        bench.tick(200)
        assert np.abs(bench.robot.plant.data.qvel).max() < 1e-3
