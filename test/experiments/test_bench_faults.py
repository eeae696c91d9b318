"""Random faults: whatever goes wrong, torques and contact forces stay within their bounds."""

import dataclasses
import json

import numpy as np
import pytest

from contact_reach_ros.control.settings import LimitSettings
from contact_reach_ros.experiments import bench_faults, fault_checks
from contact_reach_ros.experiments.bench_faults import DRAWS, random_schedule
from contact_reach_ros.experiments.episode import EpisodeResult
from contact_reach_ros.experiments.fault_checks import End, end_of, force_violations, speed_share, torque_violations
from contact_reach_ros.plant.fault_kinds import KINDS
from contact_reach_ros.robot import iiwa14
from contact_reach_ros.scenes.files import read_scene
from contact_reach_ros.scenes.generate import make_scene


def result(ticks: int = 1000, **changes) -> EpisodeResult:
    values = {
        "duration": 1.0,
        "start_position": np.zeros(3),
        "positions": np.zeros((ticks, 3)),
        "joints": np.zeros((ticks, 7)),
        "link_forces": np.zeros((ticks, 6)),
        "external_torques": np.zeros((ticks, 7)),
        "torques": np.zeros((ticks, 7)),
        "distances": np.zeros(ticks),
        "stop_reason": "",
        "failure": "",
        "plans": [],
        "end_speed": 0.0,
    }
    return EpisodeResult(**{**values, **changes})


class TestChecks:
    def test_ends(self):
        assert end_of(result(end_speed=1.0)) is End.REACHED
        nowhere = result(duration=float("nan"))
        assert end_of(nowhere) is End.HELD
        assert end_of(dataclasses.replace(nowhere, stop_reason="why")) is End.STOPPED
        assert end_of(dataclasses.replace(nowhere, stop_reason="why", end_speed=0.06)) is End.MOVING
        assert end_of(dataclasses.replace(nowhere, end_speed=float("nan"))) is End.MOVING

    def test_torques(self):
        cap = 0.9 * np.array(iiwa14.TORQUE_LIMITS)
        torques = np.tile(-cap, (1000, 1))
        torques[:5] = np.nan
        assert not torque_violations(result(torques=torques), LimitSettings())
        torques[500, 3] = 1.01 * cap[3]
        assert torque_violations(result(torques=torques), LimitSettings()) == [
            "the torque on lbr_A4 is 1.01 times its cap"
        ]
        torques[500, 3] = np.nan
        assert torque_violations(result(torques=torques), LimitSettings()) == ["a commanded torque is not finite"]

    @pytest.mark.parametrize(
        ("force", "ticks", "is_wrong"),
        [(139.0, 1000, False), (270.0, 400, False), (141.0, 600, True), (281.0, 1, True)],
    )
    def test_forces(self, force, ticks, is_wrong):
        forces = np.zeros((1000, 6))
        forces[100 : 100 + ticks, 2] = force
        assert bool(force_violations(result(link_forces=forces))) is is_wrong

    def test_a_simulation_that_is_not_finite_is_wrong(self):
        assert force_violations(result(joints=np.full((1000, 7), np.nan)))

    def test_speed(self):
        joints = np.zeros((1000, 7))
        joints[:, 5] = 0.001 * iiwa14.VELOCITY_LIMITS[5] * np.arange(1000) / 2
        assert speed_share(result(joints=joints)) == pytest.approx(0.5)


class TestSchedules:
    def test_every_kind_is_drawn(self):
        scene = make_scene(read_scene("free"), 0)
        assert set(DRAWS) == set(KINDS)
        drawn = [random_schedule(scene, seed) for seed in range(200)]
        assert {fault.KIND for schedule in drawn for fault in schedule} == set(KINDS)
        assert {len(schedule) for schedule in drawn} == {1, 2, 3}
        assert random_schedule(scene, 5) == drawn[5]


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    file = tmp_path_factory.mktemp("faults") / "faults.json"
    returned = bench_faults.bench_faults(10, 0, file)
    assert json.loads(file.read_text())["ends"] == returned["ends"]
    return returned


def test_torques_and_forces_stay_within_their_bounds(report):
    assert report["violations"] == []
    assert report["largest_force"] <= fault_checks.TRANSIENT_FORCE


def test_report_counts_every_episode(report):
    assert sum(report["ends"].values()) == len(report["records"]) == 10
    assert [record["seed"] for record in report["records"]] == list(range(10))
