import warnings
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Annotation

from contact_reach_ros.errors import BagError
from contact_reach_ros.recording.plot import EpisodeCurves, Marker, episode_figure, episode_plot

TITLE = "ball, seed 3: reached in 3.2 s"
THRESHOLDS = (25.0, 25.0, 22.0, 20.0, 19.0, 17.0, 14.0)
NOTHING = np.empty(0)


def curves(markers: tuple[Marker, ...] = (), start: float = 10.0) -> EpisodeCurves:
    time = start + np.linspace(-0.5, 4.0, 900)
    force = 4.0 * np.exp(-((time - start - 2.0) ** 2))
    distance = 0.4 * np.exp(-np.maximum(time - start, 0.0))
    torque = np.outer(force, np.arange(7) - 3.0)
    return EpisodeCurves(time[::10], distance[::10], time, force, 1.5 * force, time, torque, markers)


def empty(**given: np.ndarray) -> EpisodeCurves:
    fields = ("distance_time", "distance", "contact_time", "contact_maximum", "contact_sum", "torque_time")
    arrays = {name: given.get(name, NOTHING) for name in fields}
    return EpisodeCurves(**arrays, external_torque=given.get("external_torque", np.empty((0, 7))))


def labels(figure: Figure) -> list[Annotation]:
    return [text for text in figure.axes[0].texts if isinstance(text, Annotation)]


def test_png_is_written(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = episode_plot(curves(), tmp_path / "episode.png", title=TITLE, permitted_force=10.0)
    image = imread(path)
    assert image.shape[0] > 500
    assert image.shape[1] > 800
    assert image[..., :3].std() > 0.01


def test_every_axis_has_its_unit() -> None:
    figure = episode_figure(curves((Marker(10.0, "goal sent", "goal"),)), TITLE, 10.0, THRESHOLDS)
    assert [panel.get_ylabel().split()[-1] for panel in figure.axes] == ["[m]", "[N]", "[Nm]"]
    assert figure.axes[-1].get_xlabel() == "time since the goal was sent [s]"
    assert figure.get_suptitle() == TITLE


def test_limits_are_drawn_and_named() -> None:
    figure = episode_figure(curves(), TITLE, 7.5, THRESHOLDS, 0.02)
    legends = [" ".join(text.get_text() for text in panel.get_legend().get_texts()) for panel in figure.axes]
    assert "0.02 m" in legends[0]
    assert "7.5 N" in legends[1]
    assert "thresholds" in legends[2]
    assert [
        sum(bool(len(line.get_ydata())) and np.allclose(line.get_ydata(), level) for line in panel.lines)
        for panel, level in zip(figure.axes, (0.02, 7.5, 14.0), strict=True)
    ] == [1, 1, 1]


def test_time_zero_is_the_goal() -> None:
    figure = episode_figure(curves((Marker(10.0, "goal sent", "goal"),)), TITLE, 10.0)
    assert figure.axes[0].get_xlim() == pytest.approx((-0.5, 4.0))
    without_goal = episode_figure(curves(), TITLE, 10.0)
    assert without_goal.axes[0].get_xlim() == pytest.approx((0.0, 4.5))
    assert without_goal.axes[-1].get_xlabel() == "time [s]"


def test_a_long_wait_before_the_goal_is_cut_off_but_nothing_that_happened_in_it() -> None:
    goal = Marker(13.5, "goal sent", "goal")
    figure = episode_figure(curves((goal,)), TITLE, 10.0)
    assert figure.axes[0].get_xlim() == pytest.approx((-2.0, 0.5))
    figure = episode_figure(curves((Marker(12.5, "stop", "safety"), goal)), TITLE, 10.0)
    assert figure.axes[0].get_xlim() == pytest.approx((-3.0, 0.5))


def test_legends_cover_no_data() -> None:
    figure = episode_figure(curves(), TITLE, 10.0, THRESHOLDS)
    figure.canvas.draw()
    for panel in figure.axes:
        assert panel.get_legend().get_window_extent().x0 >= panel.get_window_extent().x1


def test_curves_and_limits_stay_in_view() -> None:
    """Thresholds far above must not flatten the curves, and what exceeds a limit must be seen."""
    figure = episode_figure(curves(), TITLE, 2.0, THRESHOLDS)
    _, force, torque = figure.axes
    assert force.get_ylim()[1] > 6.0
    assert 14.0 < torque.get_ylim()[1] < 20.0
    flat = episode_figure(curves(), TITLE, 2.0)
    assert 12.0 < flat.axes[2].get_ylim()[1] < 14.0


def test_labels_of_close_moments_stay_apart() -> None:
    markers = (
        Marker(10.0, "goal sent", "goal"),
        Marker(11.9, "observer: joint A2 above its threshold", "safety"),
        Marker(12.0, "controller: compliant stop", "safety"),
        Marker(12.1, "reached", "reached"),
        Marker(13.0, "controller: reset", "safety"),
    )
    figure = episode_figure(curves(markers), TITLE, 10.0)
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [label.get_window_extent(renderer) for label in labels(figure)]
    assert len(boxes) == len(markers)
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    title = figure.texts[0].get_window_extent(renderer)
    assert not any(title.overlaps(box) for box in boxes)


def test_many_moments_at_once_leave_the_panels_room() -> None:
    markers = tuple(Marker(12.0 + 0.01 * number, f"safety event number {number}", "safety") for number in range(30))
    figure = episode_figure(curves(markers), TITLE, 10.0)
    assert 0 < len(labels(figure)) < 10
    assert figure.axes[0].get_window_extent().height > 100.0
    assert sum(line.get_xdata()[0] == line.get_xdata()[-1] for line in figure.axes[1].lines) == 30


@pytest.mark.parametrize(
    "given",
    [
        {"distance_time": np.arange(3.0), "distance": np.array([0.3, 0.0, 0.1])},
        {"contact_time": np.arange(3.0), "contact_maximum": np.zeros(3), "contact_sum": np.zeros(3)},
        {"torque_time": np.arange(3.0), "external_torque": np.full((3, 7), np.nan)},
        {"torque_time": np.zeros(1), "external_torque": np.zeros((1, 7))},
    ],
)
def test_panels_without_data_say_so(tmp_path: Path, given: dict[str, np.ndarray]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = episode_figure(empty(**given), TITLE, 10.0)
        figure.savefig(tmp_path / "plot.png")
    said = [any(text.get_text() == "not recorded" for text in panel.texts) for panel in figure.axes]
    assert said.count(True) == 2


def test_nothing_to_plot(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="nothing to plot"):
        episode_plot(empty(), tmp_path / "plot.png", title=TITLE, permitted_force=10.0)
    assert not (tmp_path / "plot.png").exists()


def test_unwritable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match=r"gone/plot\.png' cannot be written: No such file"):
        episode_plot(curves(), tmp_path / "gone" / "plot.png", title=TITLE, permitted_force=10.0)
