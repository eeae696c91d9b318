"""The figures: what is drawn and written is what happened in the episodes."""

import dataclasses
import json

import numpy as np
import pytest
from arm_simulation import ARM
from bench_command import bench
from PIL import Image
from test_episode import StraightPlanner
from test_grid import TINY

from benchmarks import fig5 as fig5_module
from benchmarks.baselines.method import Method
from benchmarks.episode import run_episode
from benchmarks.fig5 import TOUCHED, Fig5, bench_fig5, watch_episode
from benchmarks.grid import concrete_scene
from benchmarks.offscreen import find_backend
from contact_reach_ros.errors import RenderingError
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.simulation.plant import TICK
from contact_reach_ros.world.scene_file import read_scene
from contact_reach_ros.world.spheres import rest_positions

pytestmark = pytest.mark.slow

SETUP = dataclasses.replace(TINY, timeout=3.5)
LATENCY = 0.05
METHODS = ("contact_reach", "reference_posture")


class Straight(StraightPlanner):
    """Stands for the planners, which would take long to compile."""

    def reseed(self, seed):
        pass


def straight(method, file, setup):
    return Method(Straight(concrete_scene(file, ARM, 0)), setup.controller)


@pytest.fixture(scope="module", autouse=True)
def planners():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.fig5.prepared", straight)
        yield


@pytest.fixture(scope="module")
def renderer():
    """The one that works here."""
    try:
        return find_backend()
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def fig5(planners, renderer, tmp_path_factory):
    """Report and files."""
    folder = tmp_path_factory.mktemp("fig5")
    picture, file = folder / "new" / "fig5.png", folder / "fig5.json"
    bench = Fig5(methods=METHODS, latency=LATENCY, output=picture)
    return bench_fig5(bench, file, SETUP), picture, file


def is_small_and_wide(picture):
    with Image.open(picture) as image:
        return picture.stat().st_size <= 300_000 and image.width >= 900


def test_a_watched_episode_is_the_same_and_aligned():
    scene, options = make_scene(read_scene("wall"), ARM, 0), SETUP.options("contact_reach", "hold", LATENCY)
    watched, alone = (
        run(scene, Method(Straight(scene), SETUP.controller), options) for run in (watch_episode, run_episode)
    )
    np.testing.assert_array_equal(watched.result.joints, alone.joints)
    ticks = len(alone.positions)
    assert watched.obstacles.shape == (ticks, len(rest_positions(scene)), 3)
    assert len(watched.contacts) == ticks
    for tick, contacts in enumerate(watched.contacts):
        sums = np.zeros((len(ARM.contact_links), 3))
        np.add.at(sums, contacts.links, contacts.forces)
        np.testing.assert_allclose(np.linalg.norm(sums, axis=1), alone.link_forces[tick], rtol=0, atol=1e-9)
    assert watched.peak_force == alone.contact_forces.max() > 0.5
    moved = np.linalg.norm(watched.obstacles[-1] - rest_positions(scene), axis=1)
    assert moved.max() > 0.01


def test_profiles_agree_with_the_episodes(fig5):
    report, _, _ = fig5
    for method in METHODS:
        profile = np.array(report["profiles_N"][method])
        episode = report["episodes"][method]
        assert profile.max() == pytest.approx(episode["max_contact_force"], abs=1e-4)
        assert profile.sum() * TICK == pytest.approx(episode["contact_impulse"], rel=1e-3)
        assert profile.max() > 0.2
        moments = {moment["name"]: round(moment["time_s"] / TICK) - 1 for moment in report["moments"][method]}
        assert len(moments) == 3
        first = moments["first contact"]
        assert profile[first] > TOUCHED >= profile[:first].max(initial=0.0)
        assert moments["end"] == len(profile) - 1
        if "largest force" in moments:
            assert moments["largest force"] == profile.argmax()
        else:
            half = moments["half of the largest force"]
            assert profile[half] >= 0.5 * profile.max() > profile[:half].max()


def test_files_of_fig5_hold_what_is_returned(fig5):
    report, picture, file = fig5
    assert json.loads(file.read_text()) == json.loads(json.dumps(report))
    assert is_small_and_wide(picture)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--methods", "rrt"], "--methods 'rrt' is unknown; expected one of contact_reach"),
        (["--methods", "cma_es", "cma_es"], "--methods cma_es cma_es: expected each of them once"),
        (["--output", "picture.jpg"], "--output picture.jpg: expected a file that ends in .png"),
        (["--seed", "-1"], "--seed -1: expected at least 0"),
        (["--latency", "0"], "--latency 0: expected 0.001 to 1 s"),
    ],
)
def test_what_cannot_be_drawn_is_refused(arguments, message, capsys):
    assert bench(fig5_module, *arguments) == 2
    assert message in capsys.readouterr().err


def test_a_picture_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RenderingError, match=r"fig5\.png: cannot be written"):
        bench_fig5(Fig5(methods=METHODS[:1], latency=LATENCY, output=tmp_path / "file" / "fig5.png"), None, SETUP)
