"""The picture of an episode, of the bag that comes with the package."""

from pathlib import Path

import pytest

from contact_reach_ros.arms import load_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import read_signals
from contact_reach_ros.errors import BagError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.report.plot import draw_episode
from contact_reach_ros.report.summary import Episode
from contact_reach_ros.resources import share_directory

ARM = load_arm()


@pytest.fixture(scope="module")
def episode() -> Episode:
    return Episode(read_signals(BagReader(share_directory() / "bags" / "sample"), ARM), ARM)


def test_it_is_a_png(episode: Episode, tmp_path: Path) -> None:
    file = tmp_path / "episode.png"
    draw_episode(episode, "scene ball: goal reached", load_budget().resolve(ARM), file)
    assert file.read_bytes().startswith(b"\x89PNG")


def test_curves_and_moments_count_from_the_goal(episode: Episode) -> None:
    distance, force, torque = episode.curves()
    moments = episode.moments()
    assert moments["goal sent"] == 0.0 < moments["reached"]
    at_goal = distance.column("distance")[distance.time.searchsorted(moments["reached"])]
    assert at_goal == pytest.approx(0.01, abs=0.002)
    assert force.column("max").max() > 0.5
    assert torque.names == ARM.joint_names and -2.1 < torque.time[0] < 0.0


def test_a_place_that_cannot_be_written_is_named(episode: Episode, tmp_path: Path) -> None:
    with pytest.raises(BagError, match="cannot be written"):
        draw_episode(episode, "", load_budget().resolve(ARM), tmp_path / "absent" / "episode.png")
