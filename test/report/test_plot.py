import warnings
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from contact_reach_ros.arms import load_arm
from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import Series, read_signals
from contact_reach_ros.errors import BagError
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.report.plot import Marker, episode_figure
from contact_reach_ros.report.summary import Episode
from contact_reach_ros.resources import share_directory

TITLE = "ball, seed 3: reached in 3.2 s"
THRESHOLDS = (25.0, 25.0, 22.0, 20.0, 19.0, 17.0, 14.0)
JOINTS = tuple(f"lbr_A{joint + 1}" for joint in range(7))


def curves(start: float = 10.0) -> tuple[Series, Series, Series]:
    time = start + np.linspace(-0.5, 4.0, 900)
    force = 4.0 * np.exp(-((time - start - 2.0) ** 2))
    distance = 0.4 * np.exp(-np.maximum(time - start, 0.0))
    torque = np.outer(force, np.arange(7) - 3.0)
    return (
        Series(time[::10], ("distance",), distance[::10, None]),
        Series(time, ("max", "sum"), np.stack([force, 1.5 * force], axis=1)),
        Series(time, JOINTS, torque),
    )


def sample_episode() -> Episode:
    arm = load_arm()
    signals = read_signals(BagReader(share_directory() / "bags" / "sample"), arm.joint_names)
    return Episode(signals, arm)


def draw(*markers: Marker, force: float = 10.0, thresholds: tuple[float, ...] = ()) -> Figure:
    return episode_figure(*curves(), markers, TITLE, force, thresholds)


def empty(names: tuple[str, ...]) -> Series:
    return Series(np.empty(0), names, np.empty((0, len(names))))


def only(**given: list[list[float]]) -> tuple[Series, Series, Series]:
    """Episodes of which only one quantity was recorded."""
    names = {"distance": ("distance",), "contact": ("max", "sum"), "torque": JOINTS}
    series = {name: empty(columns) for name, columns in names.items()}
    for name, values in given.items():
        series[name] = Series(np.arange(len(values)) * 1.0, names[name], np.array(values))
    return series["distance"], series["contact"], series["torque"]


def test_png_is_written(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sample_episode().plot(tmp_path / "episode.png", TITLE, load_budget().resolve(load_arm()))
    image = imread(tmp_path / "episode.png")
    assert image.shape[0] > 500
    assert image.shape[1] > 800
    assert image[..., :3].std() > 0.01


def test_every_axis_has_its_unit() -> None:
    figure = draw(Marker(10.0, "goal sent", "goal"), thresholds=THRESHOLDS)
    assert [panel.get_ylabel().split()[-1] for panel in figure.axes] == ["[m]", "[N]", "[Nm]"]
    assert figure.axes[-1].get_xlabel() == "time since the goal was sent [s]"
    assert figure.get_suptitle() == TITLE


def test_limits_are_drawn_and_named() -> None:
    figure = draw(force=7.5, thresholds=THRESHOLDS)
    legends = [" ".join(text.get_text() for text in panel.get_legend().get_texts()) for panel in figure.axes]
    assert "0.01 m" in legends[0]
    assert "7.5 N" in legends[1]
    assert "thresholds" in legends[2]
    assert [
        sum(bool(len(line.get_ydata())) and np.allclose(line.get_ydata(), level) for line in panel.lines)
        for panel, level in zip(figure.axes, (0.01, 7.5, 14.0), strict=True)
    ] == [1, 1, 1]


def test_time_zero_is_the_goal() -> None:
    figure = draw(Marker(10.0, "goal sent", "goal"))
    assert figure.axes[0].get_xlim() == pytest.approx((-0.5, 4.0))
    without_goal = draw()
    assert without_goal.axes[0].get_xlim() == pytest.approx((0.0, 4.5))
    assert without_goal.axes[-1].get_xlabel() == "time [s]"


def test_a_long_wait_before_the_goal_is_cut_off_but_nothing_that_happened_in_it() -> None:
    goal = Marker(13.5, "goal sent", "goal")
    figure = draw(goal)
    assert figure.axes[0].get_xlim() == pytest.approx((-2.0, 0.5))
    figure = draw(Marker(12.5, "stop", "safety"), goal)
    assert figure.axes[0].get_xlim() == pytest.approx((-3.0, 0.5))


def test_legends_cover_no_data() -> None:
    figure = draw(thresholds=THRESHOLDS)
    figure.canvas.draw()
    for panel in figure.axes:
        assert panel.get_legend().get_window_extent().x0 >= panel.get_window_extent().x1


def test_curves_and_limits_stay_in_view() -> None:
    """Thresholds far above must not flatten the curves, and what exceeds a limit must be seen."""
    figure = draw(force=2.0, thresholds=THRESHOLDS)
    _, force, torque = figure.axes
    assert force.get_ylim()[1] > 6.0
    assert 14.0 < torque.get_ylim()[1] < 20.0
    flat = draw(force=2.0)
    assert 12.0 < flat.axes[2].get_ylim()[1] < 14.0


def test_moments_are_lines_in_all_panels_and_the_legend_names_the_first() -> None:
    markers = tuple(Marker(12.0 + 0.01 * number, f"event {number}", "safety") for number in range(30))
    figure = draw(Marker(10.0, "goal sent", "goal"), *markers)
    named = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert {"goal sent, 0.00 s", "event 0, 2.00 s"} <= set(named) and len(named) < 12
    assert (
        sum(line.get_xdata()[0] == line.get_xdata()[-1] for line in figure.axes[1].lines if len(line.get_xdata())) == 31
    )


@pytest.mark.parametrize(
    "given",
    [
        {"distance": [[0.3], [0.0], [0.1]]},
        {"contact": [[0.0, 0.0]] * 3},
        {"torque": [[np.nan] * 7] * 3},
        {"torque": [[0.0] * 7]},
    ],
)
def test_panels_without_data_say_so(tmp_path: Path, given: dict[str, list[list[float]]]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = episode_figure(*only(**given), [], TITLE, 10.0)
        figure.savefig(tmp_path / "plot.png")
    missing = [any(text.get_text() == "not recorded" for text in panel.texts) for panel in figure.axes]
    assert missing.count(True) == 2


def test_nothing_to_plot() -> None:
    with pytest.raises(BagError, match="nothing to plot"):
        episode_figure(*only(), [], TITLE, 10.0)


def test_unwritable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"gone/plot\.png' cannot be written: No such file"):
        sample_episode().plot(tmp_path / "gone" / "plot.png", TITLE, load_budget().resolve(load_arm()))
