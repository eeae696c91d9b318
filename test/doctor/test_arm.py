"""Joint states of arms that are as they should be, and of others."""

import numpy as np
import pytest
from arm_simulation import ARM

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.doctor.arm import JointRecord, clock_skew, driver_rate, gravity, joint_names
from contact_reach_ros.doctor.findings import Verdict
from contact_reach_ros.observer.budget import ContactBudget

BUDGET = ContactBudget().resolve(ARM)
HOME = np.array(ARM.home)
START_NS = 1_700_000_000_000_000_000
TICK_NS = 1_000_000


@pytest.fixture(scope="module")
def model():
    return RobotModel(ARM)


def record(count=1000, **changes):
    """One second of an arm at rest whose torques are not known."""
    stamps = START_NS + TICK_NS * np.arange(count)
    values = {
        "names": (ARM.joint_names,),
        "stamps_ns": stamps,
        "received_ns": stamps + 300_000,
        "position": np.tile(HOME, (count, 1)),
        "velocity": np.zeros((count, ARM.n)),
        "effort": np.full((count, ARM.n), np.nan),
    }
    return JointRecord(**{**values, **changes})


def test_other_names_beside_the_right_ones_pass_and_missing_ones_are_named():
    finding = joint_names(record(names=((*ARM.joint_names, "gripper"),)), ARM)
    assert finding.verdict is Verdict.PASS and "gripper" in finding.found
    names = (*(f"iiwa_A{number}" for number in range(1, 7)), "lbr_A7")
    finding = joint_names(record(names=(names,)), ARM)
    assert finding.verdict is Verdict.FAIL
    assert "lbr_A1" in finding.found and "lbr_A7" not in finding.found.partition(";")[0] and "prefix" in finding.fix


def test_states_with_which_nothing_starts_fail():
    unknown = np.full((1000, ARM.n), 0.0)
    unknown[:, 2] = np.nan
    for field in ("position", "velocity"):
        finding = joint_names(record(**{field: unknown}), ARM)
        assert finding.verdict is Verdict.FAIL and f"no {field} of lbr_A3" in finding.found
    assert joint_names(record(0, names=()), ARM).verdict is Verdict.FAIL


SWAPPED = ("lbr_A1", "lbr_A2", "lbr_A4", "lbr_A3", "lbr_A5", "lbr_A6", "lbr_A7")


def test_another_order_fails_unless_the_commands_are_known_to_be_in_order():
    swapped = record(names=(SWAPPED,))
    assert joint_names(swapped, ARM).verdict is Verdict.FAIL
    assert joint_names(swapped, ARM, ARM.joint_names).verdict is Verdict.PASS
    finding = joint_names(record(), ARM, SWAPPED)
    assert finding.verdict is Verdict.FAIL and ", ".join(SWAPPED) in finding.found


def at_rate(rate):
    stamps = START_NS + np.arange(int(rate)) * int(1e9 / rate)
    return record(int(rate), stamps_ns=stamps, received_ns=stamps + 200_000)


@pytest.mark.parametrize(
    ("rate", "nominal", "verdict"),
    [(1000, 1000.0, "pass"), (960, 1000.0, "warn"), (500, 1000.0, "fail"), (500, 500.0, "pass")],
)
def test_rate(rate, nominal, verdict):
    finding = driver_rate(at_rate(rate), nominal)
    assert finding.verdict.value == verdict and finding.found.startswith(f"{rate} Hz, stamps vary by 0 us")
    assert ("the nodes count on" in finding.found) == (verdict == "fail")


def test_a_long_gap_is_a_warning_and_stamps_that_go_back_fail():
    stamps = START_NS + TICK_NS * np.arange(10_000)
    stamps[5000:] += 30 * TICK_NS
    finding = driver_rate(record(10_000, stamps_ns=stamps, received_ns=stamps), 1000.0)
    assert finding.verdict is Verdict.WARN and "longest gap 31.0 ms" in finding.found
    stamps = record().stamps_ns
    stamps[500] = stamps[400]
    assert driver_rate(record(stamps_ns=stamps), 1000.0).verdict is Verdict.FAIL


@pytest.mark.parametrize("checked", [lambda empty: driver_rate(empty, 1000.0), clock_skew])
def test_silence_fails(checked):
    assert checked(record(0, names=())).verdict is Verdict.FAIL


@pytest.mark.parametrize(
    ("offset_ms", "verdict", "word"),
    [(0, "pass", "before"), (30, "warn", "before"), (-30, "warn", "after"), (3_600_000, "fail", "before")],
)
def test_clock_skew(offset_ms, verdict, word):
    stamps = record().stamps_ns - int(offset_ms * 1e6)
    finding = clock_skew(record(stamps_ns=stamps))
    assert finding.verdict.value == verdict and word in finding.found


def with_torque(model, extra):
    return record(effort=np.tile(model.gravity_at(HOME) + np.array(extra), (1000, 1)))


@pytest.mark.parametrize(
    ("extra", "verdict", "joint"),
    [
        ([0.3, -0.5, 0.2, 0.1, 0.0, 0.0, 0.0], "pass", "lbr_A2"),
        ([0.0, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0], "warn", "lbr_A2"),
        ([0.0, 16.0, 0.0, -9.0, 0.0, 0.0, 0.0], "fail", "lbr_A2"),
    ],
)
def test_what_gravity_leaves_over(model, extra, verdict, joint):
    finding = gravity(with_torque(model, extra), model, BUDGET)
    assert finding.verdict.value == verdict and f"largest at {joint}" in finding.found
    assert finding.found.endswith("; assumed: gravity 9.81 m/s² along -z of lbr_link_0")
    assert ", ".join(f"{value:+.2f}" for value in extra) in finding.found.replace("-0.00", "+0.00")


def test_torques_without_gravity_are_recognised(model):
    finding = gravity(record(effort=np.full((1000, 7), 0.05)), model, BUDGET)
    assert finding.verdict is Verdict.FAIL and "takes gravity out" in finding.found


def test_closed_brakes_and_motion_are_not_compared(model):
    assert "closed brakes" in gravity(record(), model, BUDGET).found
    moving = record(effort=np.zeros((1000, 7)), velocity=np.full((1000, 7), 0.2))
    finding = gravity(moving, model, BUDGET)
    assert finding.verdict is Verdict.WARN and "moves" in finding.found
