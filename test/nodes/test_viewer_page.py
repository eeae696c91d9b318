"""The page in a real browser, against a running lockstep stack: look, send a goal, stop, play a bag.

`pytest test/nodes/test_viewer_page.py --write-pictures` writes docs/viewer.png as well.
"""

import ctypes
import json
import os
import shutil
from pathlib import Path

import pytest
from arm_simulation import ARM
from browser import chromium, find_chromium
from stack_helpers import SMALL_PLANNER, environment, module, parameter_file, running, wait_for

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import read_signals
from contact_reach_ros.scenes.generate import make_scene
from contact_reach_ros.world.scene_file import read_scene

PROJECT = Path(__file__).parents[2]
PICTURE, SAMPLE = PROJECT / "docs" / "viewer.png", PROJECT / "bags" / "sample"

_PR_CAPBSET_DROP, _CAP_SYS_NICE = 24, 23

NEWEST = (
    "(() => {{ const plots = Object.values((window.__viserTestpoints || {{}}).uplots || {{}}); "
    "const plot = plots.find(p => p.chart.root.querySelector('.u-title').textContent.startsWith('{0}')); "
    "const d = plot ? plot.chart.data[1] : []; return d.length ? d[d.length - 1] : null; }})()"
)
"""The last value of the first curve of a plot; by its title: the browser keeps plots in the order of their making."""
DISTANCE, FORCE = NEWEST.format("Distance to the goal"), NEWEST.format("Largest contact force")
"""To the goal, mm, and largest of a contact, N."""

SEED = "3"
TUNED = "supervision.observer_timeout"

pytestmark = pytest.mark.skipif(
    find_chromium() is None, reason="there is no Chromium: install it as root with 'apt-get install chromium'"
)


def humbly():
    """In the child: leave the processor to the browser, which draws without a graphics card. Lockstep waits."""
    ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
    os.nice(15)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A browser that shows the live page of a stack in scene `ball`."""
    folder = tmp_path_factory.mktemp("viewer")
    shutil.copytree(SAMPLE, folder / SAMPLE.name)
    viewer = {"port": 0, "rate": 5.0, "bags": str(folder)}
    parameters = parameter_file(folder / "stack.yaml", planner=SMALL_PLANNER, viewer=viewer)
    command = [*module("bringup.bringup"), "--ros-args", "-p", f"parameters:={parameters}"]
    command += ["-p", "lockstep:=true", "-p", "view:=true", "-p", "scene:=ball", "-p", f"bag:={folder / 'run'}"]
    log = folder / "stack.log"
    with running(command, environment(), log, humbly) as stack:

        def up():
            assert stack.poll() is None, log.read_text()
            return "all nodes are active" in log.read_text()

        wait_for(up, 300, "the stack is up")
        (address,) = (
            line.split("open ")[1].split(";")[0] for line in log.read_text().splitlines() if "open http" in line
        )
        with chromium(folder) as browser:
            browser.open(f"{address}/?fixedDpr=0.3", 800, 600)
            browser.wait_for_text("holding", 120)
            browser.close_notes()
            yield browser
            assert browser.errors == []


def test_a_goal_is_sent_on_click_only_and_reached(page):
    page.wait_for_text("✔ reachable")
    page.fill("Goal (m)", "2")
    page.wait_for_text("✘ will be refused")
    page.fill("Goal (m)", "0.5")
    page.wait_for_text("✔ reachable")
    assert "tracking" not in page.text()
    page.click("Send goal")
    page.wait_for_text("is sent")
    page.wait_for_text("tracking")
    page.click("Plots", "[role=tab]")
    page.wait_for(f"{DISTANCE} > 0", "the distance is plotted")
    page.wait_for(f"{DISTANCE} !== null && {DISTANCE} <= 10", "the goal is reached", 120)
    # The distance that was shown before it was sent is that of the arm then.
    page.click("Goal", "[role=tab]")
    page.wait_for(r"/reachable, 0\.0[01] m away/.test(document.body.innerText)", "the arm is at the goal")


def test_stop_is_latched_until_reset(page):
    page.click("Stop")
    page.wait_for_text("STOPPED")
    page.wait_for_text("controller: stop service called")

    def released():
        # Refused, with the reason on the page, until the arm is at rest.
        page.click("Reset")
        return "STOPPED" not in page.text()

    wait_for(released, 60, "the stop is released")


def open_bag(page, name: str):
    """On the page's tab of bags, from its list."""
    page.choose("Bag", name)
    page.wait_for(f"[...document.querySelectorAll('input')].some(e => e.value === '{name}')", "the bag is chosen")
    page.click("Open")
    page.wait_for_text(f"bag {name}, ")


def test_a_bag_is_opened_and_scrubbed(page):
    page.click("Bag", "[role=tab]")
    page.click("Look for bags again")
    page.wait_for_text("bags found: 2")
    open_bag(page, SAMPLE.name)
    page.fill("Time (s)", "0.7")
    page.wait_for_text("bag sample, 0.700 s")
    page.click("+ 1 tick")
    page.wait_for_text("bag sample, 0.701 s")
    page.click("Play")
    page.wait_for("!/bag sample, 0.70/.test(document.body.innerText)", "time goes on")
    page.click("Back to live")
    page.wait_for_text("live")


@pytest.mark.slow
def test_the_page_survives_a_restart_with_another_scene(page):
    page.click("Scene", "[role=tab]")
    page.fill("Seed", SEED)
    page.click("Restart episode")
    page.wait_for_text("no joint_states for")
    page.wait_for_text("holding", 300)
    # The bag of the first run is closed and complete: it holds the stop that came last.
    page.click("Bag", "[role=tab]")
    page.click("Look for bags again")
    page.wait_for_text("bags found: 3")
    open_bag(page, "run")
    page.wait_for_text("controller: stop service called")
    page.click("Back to live")


@pytest.mark.slow
def test_a_changed_parameter_is_what_the_restarted_node_has(page):
    page.click("Tune", "[role=tab]")
    page.choose("Node", "controller")
    page.click("Show parameters")
    page.fill(TUNED, "0.08")
    assert "no joint_states for" not in page.text(), "nothing is applied before it is confirmed"
    page.click("Apply and restart")
    page.wait_for_text("no joint_states for")
    page.wait_for_text("holding", 300)
    # The page asks the node itself again.
    page.choose("Node", "observer")
    page.click("Show parameters")
    page.wait_for(f"!document.body.innerText.includes({json.dumps(TUNED)})", "the parameters of the observer")
    page.choose("Node", "controller")
    page.click("Show parameters")
    assert page.value(TUNED) == "0.08"


def test_a_picture_is_taken_of_an_arm_between_walls(page, request, tmp_path):
    """The one that is written is of the size of a laptop's window, which takes minutes to draw on a busy processor."""
    wanted = request.config.getoption("--write-pictures")
    if wanted:
        page.click("Scene", "[role=tab]")
        page.choose("Scene", "wall")
        page.click("Restart episode")
        page.wait_for_text("no joint_states for")
        page.wait_for_text("holding", 300)
        page.click("Goal", "[role=tab]")
        for number, coordinate in enumerate(make_scene(read_scene("wall"), ARM, int(SEED)).target):
            page.fill("Goal (m)", f"{coordinate:.3f}", number)
        page.click("Send goal")
        page.wait_for_text("tracking")
        page.click("Plots", "[role=tab]")
        page.wait_for(f"{FORCE} > 0.5", "the arm touches a wall", 300)
        page.open(page.address.replace("fixedDpr=0.3", "fixedDpr=1"), 1280, 800)
    page.click("Plots", "[role=tab]")
    page.wait_for(f"{DISTANCE} !== null", "the distance is plotted")
    page.close_notes()
    file = page.screenshot(PICTURE if wanted else tmp_path / "viewer.png")
    assert file.read_bytes().startswith(b"\x89PNG") and file.stat().st_size > 20_000


BANNER = "document.getElementById('safety')"
NOTE = "document.querySelector('.mantine-Notification-root')"
APART = f"{BANNER}.getBoundingClientRect().bottom <= {NOTE}.getBoundingClientRect().top"


def test_a_bag_is_shown_on_its_tab_from_its_goal_on_and_the_banner_is_not_covered(page, tmp_path):
    """The viewer of one bag: what it shows before anything is clicked."""
    parameters = parameter_file(tmp_path / "viewer.yaml", viewer={"port": 0, "rate": 5.0})
    log = tmp_path / "viewer.log"
    with running([*module("cli"), "view", str(SAMPLE), "--parameters", str(parameters)], environment(), log) as viewer:
        wait_for(lambda: viewer.poll() is not None or "open http" in log.read_text(), 60, "the viewer is up")
        address = log.read_text().split("open ")[1].split(";")[0]
        page.open(f"{address}/?fixedDpr=0.3", 800, 600)
        page.wait_for_text("bag sample, ")
        assert page.value("Bag") == SAMPLE.name
        goal = next(line for line in page.text().splitlines() if "s: goal [" in line).split(" s:")[0]
        sent = read_signals(BagReader(SAMPLE), ARM.joint_names).goals.time[0]
        assert float(goal) == pytest.approx(sent, abs=0.01)
        assert float(page.value("Time (s)")) == pytest.approx(sent, abs=0.01)
        # There is no graphics card, which the page remarks on.
        page.wait_for(f"!!{NOTE} && {APART}", "the note is not on the banner")
        page.open("about:blank", 800, 600)
