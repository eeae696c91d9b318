"""The page in a real browser: play a bag; against a running lockstep stack look, send a goal, stop."""

import ctypes
import os

import pytest
from arm_simulation import ARM
from browser import chromium, find_chromium
from stack_helpers import SAMPLE, SMALL_PLANNER, environment, module, parameter_file, ready, running, wait_for

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.signals import read_signals

_PR_CAPBSET_DROP, _CAP_SYS_NICE = 24, 23

DISTANCE = (
    "(() => { const plots = Object.values((window.__viserTestpoints || {}).uplots || {}); "
    "const plot = plots.find(p => p.chart.root.querySelector('.u-title').textContent.startsWith('Distance to the')); "
    "const d = plot ? plot.chart.data[1] : []; return d.length ? d[d.length - 1] : null; })()"
)
"""The last value of the plot of the distance to the goal, mm."""

pytestmark = pytest.mark.skipif(
    find_chromium() is None, reason="there is no Chromium: install it as root with 'apt-get install chromium'"
)


def humbly():
    """In the child: leave the processor to the browser, which draws without a graphics card. Lockstep waits."""
    ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_NICE, 0, 0, 0)
    os.nice(15)


def address_in(log):
    """The page, drawn coarsely."""
    return f"http{log.read_text().split('open http')[1].split(';')[0]}/?fixedDpr=0.3"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A browser that shows the live page of a stack."""
    folder = tmp_path_factory.mktemp("viewer")
    parameters = parameter_file(folder / "stack.yaml", planner=SMALL_PLANNER, viewer={"port": 0})
    command = [*module("bringup.bringup"), "--ros-args", "-p", f"parameters:={parameters}"]
    command += ["-p", "lockstep:=true", "-p", "view:=true", "-p", "scene:=ball"]
    log = folder / "stack.log"
    with running(command, environment(), log, humbly) as stack:
        ready(stack, log)
        with chromium(folder) as browser:
            browser.open(address_in(log))
            browser.wait_for_text("holding", 120)
            browser.close_notes()
            yield browser
            assert browser.errors == []


@pytest.mark.slow
def test_a_goal_is_sent_on_click_only_and_followed(page):
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
    first = page.wait_for(f"{DISTANCE} > 0 && {DISTANCE}", "the distance is plotted")
    page.wait_for(f"{DISTANCE} !== null && {DISTANCE} < {0.7 * first}", "the arm comes nearer to it", 120)


@pytest.mark.slow
def test_stop_is_latched_until_reset(page):
    page.click("Stop")
    page.wait_for_text("STOPPED")
    page.wait_for_text("controller: stop service called")

    def released():
        # Refused, with the reason on the page, until the arm is at rest.
        page.click("Reset")
        return "STOPPED" not in page.text()

    wait_for(released, 60, "the stop is released")


BANNER = "document.getElementById('safety')"
NOTE = "document.querySelector('.mantine-Notification-root')"
APART = f"{BANNER}.getBoundingClientRect().bottom <= {NOTE}.getBoundingClientRect().top"


def test_a_bag_is_shown_from_its_goal_on_and_scrubbed_and_the_banner_is_not_covered(tmp_path):
    parameters = parameter_file(tmp_path / "viewer.yaml", viewer={"port": 0})
    command = [*module("cli"), "view", str(SAMPLE), "--parameters", str(parameters)]
    log = tmp_path / "viewer.log"
    with running(command, environment(), log) as viewer, chromium(tmp_path) as page:
        ready(viewer, log, "open http")
        page.open(address_in(log))
        page.wait_for_text("bag sample, ")
        goal = next(line for line in page.text().splitlines() if "s: goal [" in line).split(" s:")[0]
        sent = read_signals(BagReader(SAMPLE), ARM).goals.time[0]
        assert float(goal) == pytest.approx(sent, abs=0.01)
        assert float(page.value("Time (s)")) == pytest.approx(sent, abs=0.01)
        # There is no graphics card, which the page remarks on.
        page.wait_for(f"!!{NOTE} && {APART}", "the note is not on the banner")
        page.close_notes()
        assert "Stop" not in page.text().splitlines()
        page.fill("Time (s)", "0.7")
        page.wait_for_text("bag sample, 0.700 s")
        page.click("+ 1 tick")
        page.wait_for_text("bag sample, 0.701 s")
        page.click("Play")
        page.wait_for("!/bag sample, 0.70/.test(document.body.innerText)", "time goes on")
        assert page.errors == []
