"""The report of a bag: one page that needs no network, its numbers, and reports of incomplete bags."""

import copy
import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from contact_reach_command import contact_reach
from plotly.offline import get_plotlyjs

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import EpisodeSignals, Series
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter
from contact_reach_ros.messages.safety_state import SafetyState
from contact_reach_ros.report import bag as report_bag
from contact_reach_ros.report.bag import CALLED, ReportBag, metrics
from contact_reach_ros.report.charts import BINS, envelope
from contact_reach_ros.report.page import page
from contact_reach_ros.resources import share_directory

SAMPLE = share_directory() / "bags" / "sample"
CHARTS = re.compile(r'<script id="charts" type="application/json">(.*?)</script>', re.DOTALL)


@pytest.fixture(scope="module")
def sample() -> ReportBag:
    return ReportBag(SAMPLE, "sample")


@pytest.fixture(scope="module")
def signals(sample: ReportBag) -> EpisodeSignals:
    return sample.signals


def run(*arguments: object) -> int:
    return contact_reach("report", *arguments)


def charts(text: str) -> list[dict]:
    match = CHARTS.search(text)
    assert match is not None
    return list(json.loads(match[1]))


def titles(text: str) -> list[str]:
    return [chart["layout"]["yaxis"]["title"]["text"] for chart in charts(text)]


def changed(sample: ReportBag, **attributes: object) -> ReportBag:
    """The sample with other attributes."""
    made = copy.copy(sample)
    vars(made).update(attributes)
    return made


def report_of(signals: EpisodeSignals, **limits: float) -> ReportBag:
    """What the sample bag would be with these signals."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_bag, "read_signals", lambda *_: signals)
        return ReportBag(SAMPLE, "sample", **limits)


def test_a_page_with_json(tmp_path: Path) -> None:
    assert run(SAMPLE, "-o", tmp_path / "r.html", "--json", tmp_path / "r.json") == 0
    text = (tmp_path / "r.html").read_text()
    # The library names addresses that the page never requests.
    library = get_plotlyjs()
    assert text.count(library) == 1
    assert not re.search(r"https?://", text.replace(library, ""))
    found = titles(text)
    assert len(found) == 7 and all("[" in title for title in found)
    assert f"contact-reach view {SAMPLE}" in text
    (bag,) = json.loads((tmp_path / "r.json").read_text())["bags"]
    assert bag["verdict"] == "goal reached" and bag["good"] and bag["notes"] == []
    assert bag["settings"]["planner"]["planning.population"] == 200


def test_a_recording_without_a_goal_has_the_numbers_that_need_none(signals: EpisodeSignals) -> None:
    goals = dataclasses.replace(signals.goals, time=np.zeros(0), values=np.zeros((0, 3)))
    without = report_of(dataclasses.replace(signals, goals=goals))
    assert without.verdict == "no goal in the bag" and not without.good
    found, expected = metrics(without), metrics(report_of(signals))
    of_goal = ["time to the goal", "distance at the end"]
    assert np.isnan([found[name][0] for name in of_goal]).all()
    assert found["largest contact force"] == expected["largest contact force"]
    assert found["largest contact force"][0] > 0.0 and found["round trip p50"] == expected["round trip p50"]


@pytest.mark.parametrize(("timeout", "verdict"), [(30.0, "goal reached"), (0.5, "goal not reached")])
def test_an_episode_ends_where_it_is_decided_however_long_the_recording(
    signals: EpisodeSignals, timeout: float, verdict: str
) -> None:
    found = report_of(signals, timeout=timeout, settle=0.2)
    assert found.verdict == verdict
    assert found.end == pytest.approx(found.reached + 0.2 if found.good else found.zero + timeout)


def test_an_arm_that_was_at_the_goal_and_has_not_settled_did_not_reach_it(signals: EpisodeSignals) -> None:
    found = report_of(dataclasses.replace(signals, settled=np.zeros(0)))
    assert found.verdict == "goal not reached"
    assert found.distance.values.min() < 0.01 and np.isnan(metrics(found)["time to the goal"][0])


def test_without_the_planners_word_nobody_knows_whether_a_goal_was_reached(
    signals: EpisodeSignals, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(*arguments: Any, **options: Any) -> BagReader:
        reader = BagReader(*arguments, **options)
        reader.topics = {name: topic for name, topic in reader.topics.items() if name != "/goal/state"}
        return reader

    monkeypatch.setattr(report_bag, "BagReader", opened)
    found = report_of(dataclasses.replace(signals, settled=np.zeros(0)))
    assert found.verdict == "unknown: the bag lacks goal/state" and not found.good
    assert "topic goal/state is missing: no verdict: whether the arm has settled at the goal" in found.notes


def test_a_stop_is_the_verdict(signals: EpisodeSignals) -> None:
    stop = SafetyState(signals.goals.time[0] + 0.5, 2, "observer", "too much torque")
    found = report_of(dataclasses.replace(signals, safety_states=(stop,)))
    assert found.verdict == "stopped by the observer: too much torque" and not found.good


def test_a_stop_before_the_goal_that_was_released_is_not(signals: EpisodeSignals) -> None:
    begin = signals.goals.time[0]
    stop = SafetyState(begin - 0.5, 2, "controller", CALLED)
    held = SafetyState(begin - 0.3, 0, "controller", "holding")
    found = report_of(dataclasses.replace(signals, safety_states=(stop, held)))
    assert found.good and len(found.distance.time) > 100
    assert not report_of(dataclasses.replace(signals, safety_states=(stop,))).good


def test_odd_stamps_and_infinite_values_have_a_page(signals: EpisodeSignals) -> None:
    position, torque = signals.position, signals.external_torque
    time, values = position.time.copy(), torque.values.copy()
    time[-1], values[100, 3] = 1.7e9, np.inf
    odd = dataclasses.replace(
        signals,
        position=Series(time, position.names, position.values),
        external_torque=Series(torque.time, torque.names, values),
    )
    found = changed(report_of(odd), settings={"driver": {"state_rate": 0}})
    assert found.good and "external torque [Nm]" in titles(page([found]))
    assert metrics(found)["largest external torque"][0] < 100.0


def test_bags_whose_names_have_dots_have_pages_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("v0.1", "v0.2"):
        shutil.copytree(SAMPLE, tmp_path / name)
    monkeypatch.chdir(tmp_path / "v0.1")
    assert run(".") == run(tmp_path / "v0.2") == 0
    assert {path.name for path in tmp_path.glob("*.html")} == {"v0.1.html", "v0.2.html"}


def test_two_bags_side_by_side(sample: ReportBag) -> None:
    text = page([sample, changed(sample, label="second")])
    assert titles(text).count("joint angle [rad]") == 2
    assert '<th class="number">difference</th>' in text


def test_texts_of_a_bag_are_shown_as_they_are(sample: ReportBag) -> None:
    """A message with markup, which could end an element of the page."""
    markup = "</script><b>bold</b>"
    event = sample.signals.safety[0]._replace(message=markup)
    text = page([changed(sample, signals=dataclasses.replace(sample.signals, safety_states=(event,)))])
    assert markup not in text and "&lt;/script&gt;&lt;b&gt;bold&lt;/b&gt;" in text
    assert any(f"{event.name}: {markup}" in trace.get("text", ()) for trace in charts(text)[0]["data"])


def test_a_bag_with_little_in_it_is_reported_all_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beside a file that is no bag, which is left out."""
    reader = BagReader(SAMPLE)
    kept = ("/external_torque", "/safety_state")
    with BagWriter(tmp_path / "poor", [RecordedTopic(name, reader.topics[name].type) for name in kept]) as writer:
        for raw in reader.raw_messages(kept):
            # A message that is none of its type, now and then.
            data = raw.data[:40] if raw.sequence % 500 == 0 else raw.data
            writer.write(raw.topic, data, raw.log_time_ns, raw.publish_time_ns)
    BagWriter(tmp_path / "empty").close()
    (tmp_path / "text.mcap").write_text("this is no bag")
    assert run(tmp_path / "poor", tmp_path / "empty", tmp_path / "text.mcap", "-o", tmp_path / "r.html") == 0
    printed = capsys.readouterr().out
    assert "topic joint_states is missing: no joint positions, distance, tick jitter" in printed
    assert re.search(r"external_torque: \d+ messages cannot be read and are left out", printed)
    assert "the bag has no messages" in printed and "left out: " in printed
    found = titles((tmp_path / "r.html").read_text())
    assert "external torque [Nm]" in found and "joint angle [rad]" not in found


def test_what_is_no_bag_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.mcap").write_text("this is no bag")
    assert run(tmp_path / "text.mcap") == 2
    error = capsys.readouterr().err
    assert "is no mcap file" in error and "Traceback" not in error and error.count("\n") == 1


def test_thinned_curves_keep_their_peaks_and_gaps() -> None:
    time = np.arange(100_000) * 1e-3
    values = np.sin(time)
    values[54_321], values[54_322] = 7.0, -9.0
    values[70_000:80_000] = np.nan
    thinned_time, thinned = envelope(time, values)
    assert len(thinned) <= 2 * BINS and (np.diff(thinned_time) >= 0.0).all()
    for index, extreme in ((54_321, np.nanargmax(thinned)), (54_322, np.nanargmin(thinned))):
        assert thinned[extreme] == values[index]
        assert 0.0 <= time[index] - thinned_time[extreme] <= 1e-3 * len(time) / BINS
    assert np.isnan(thinned[(thinned_time > 70.1) & (thinned_time < 79.9)]).all()
