"""The picture of an episode, of the bag that comes with the package."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure

from contact_reach_ros.errors import BagError
from contact_reach_ros.report.bag import ReportBag
from contact_reach_ros.report.plot import draw_episode
from contact_reach_ros.resources import share_directory


def test_curves_and_moments_count_from_the_goal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = ReportBag(share_directory() / "bags" / "sample", "sample")
    drawn, save = [], Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **kw: (drawn.append(figure), save(figure, *args, **kw))
    )
    draw_episode(bag, "scene ball: goal reached", tmp_path / "episode.png")
    assert (tmp_path / "episode.png").read_bytes().startswith(b"\x89PNG")
    distance, force, torque = drawn[0].axes
    lines = {line.get_label().partition(",")[0]: line for line in distance.lines}
    settled = lines["settled"].get_xdata()[0]
    times, values = lines["distance"].get_data()
    assert (values[(times > settled - 0.2) & (times < settled)] <= 0.01).all()
    assert lines["goal sent"].get_xdata()[0] == 0.0 < settled < distance.get_xlim()[1]
    assert force.lines[1].get_ydata().max() > 0.5
    assert {line.get_label() for line in torque.lines} >= set(bag.arm.joint_names)
    with pytest.raises(BagError, match="cannot be written"):
        draw_episode(bag, "", tmp_path / "absent" / "episode.png")
