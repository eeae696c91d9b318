"""Whatever ends the stack, the adapter holds an arm whose drive would keep the last torque, until it is let go."""

import os
import signal
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rclpy
from stack_helpers import (
    PATIENT_PLANNER,
    command_lines,
    environment,
    module,
    parameter_file,
    prefix,
    processes_of_domain,
    ready,
    ros,
    running,
    wait_for,
)

from contact_reach_ros.messages import topics
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.ros.inbox import qos_profile

AWAY = "goto 0.45 -0.45 0.35"
MOVES, RESTS = 0.2, 0.05
"""Speed of a joint that moves, and of one at rest, sensor noise included, rad/s."""
REST_AFTER = 0.5
"""s after the end of the victim."""
CREEP = 0.01
"""By how much a joint may move afterwards, rad."""
ATTEMPTS = 3
"""On a machine that stands still for a while the arm is rightly stopped before it has moved: that shows nothing."""
HOLDS, LETS_GO = "asked to end, but the drive would keep the last torque", "lets go of the arm: "
LAUNCH = str(Path(__file__).with_name("launching.py"))


@contextmanager
def watching(domain):
    """Yields a growing list of the joint states in a domain: stamp, s, positions and velocities."""
    seen, ended = [], threading.Event()

    def take(state):
        seen.append((nanoseconds(state.header.stamp) / 1e9, np.array(state.position), np.array(state.velocity)))

    def spin():
        while not ended.is_set():
            rclpy.spin_once(look, timeout_sec=0.1)

    with ros(domain=domain):
        look = rclpy.create_node("look")
        topic = topics.JOINT_STATES
        look.create_subscription(topic.type, topic.name, take, qos_profile(topics.NEWEST))
        thread = threading.Thread(target=spin)
        thread.start()
        try:
            yield seen
        finally:
            ended.set()
            thread.join()


class Bench:
    """A stack on the stand-in of an effort controller, which holds the last torque and has no brakes."""

    def __init__(self, env, folder, start):
        self.domain = env["ROS_DOMAIN_ID"]
        self.output, self.driver = folder / "stack.txt", folder / "driver.txt"
        self.command, more, self.marker = start(
            parameter_file(folder / "parameters.yaml", planner=PATIENT_PLANNER), folder
        )
        self.env = {**env, **more}
        self.adapter = 0
        """Process of the adapter."""

    @contextmanager
    def moving(self):
        """The arm on its way to a goal; yields the process that started the stack, and the joint states; or None."""
        driver = [sys.executable, str(Path(__file__).with_name("standins.py")), "effort", "--ros-args"]
        driver += ["-p", "scene:=free", "-p", "state_rate:=500.0"]
        with running(driver, self.env, self.driver) as process:
            ready(process, self.driver, "active")
            with running(self.command, self.env, self.output) as process:
                ready(process, self.output, self.marker)
                self.adapter = processes_of_domain(self.domain)["adapter"]
                try:
                    with watching(self.domain) as seen:
                        yield (process, seen) if self.go(seen) else None
                finally:
                    if alive(self.adapter):
                        os.kill(self.adapter, signal.SIGKILL)

    def go(self, seen):
        """Send the goal; whether the arm moves."""
        ((code, _),) = command_lines(self.env, AWAY)
        deadline = time.monotonic() + 20.0
        while not (seen and np.abs(seen[-1][2]).max() > MOVES) and time.monotonic() < deadline:
            time.sleep(0.01)
        return code == 0 and np.abs(seen[-1][2]).max() > MOVES


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def assert_rests(seen, since, seconds):
    """The arm comes to rest after the stamp `since`, s, and stays there."""
    end = since + seconds
    wait_for(lambda: seen[-1][0] > end, seconds + 20, "joint states go on")
    stamps, positions, velocities = (np.array(column) for column in zip(*seen, strict=True))
    speeds = np.abs(velocities).max(axis=1)
    last = stamps[(stamps > since) & (speeds > RESTS)].max(initial=since) - since
    after = positions[(stamps > since + REST_AFTER) & (stamps <= end)]
    creep = np.abs(after - after[0]).max()
    print(f"rest after {1000 * last:.0f} ms; then {1000 * creep:.2f} mrad in {seconds:g} s")
    assert last <= REST_AFTER and creep <= CREEP


def up(parameters, folder):
    """Command, more environment variables, and what is printed when all nodes are active; with the bring-up."""
    options = ["--no-driver", "--adapter", "effort", "--state-rate", "500", "--parameters", str(parameters)]
    return [*module("cli"), "up", *options, "--bag", str(folder / "bag")], {}, "all nodes are active"


def launched(parameters, folder):
    """The same with launch, which finds the executables in a prefix."""
    pytest.importorskip("launch_ros", reason="needs launch_ros, which ROS has and no registry")
    given = {"driver": "false", "adapter": "effort", "state_rate": "500.0", "parameters": parameters}
    command = [sys.executable, LAUNCH, *(f"{name}:={value}" for name, value in given.items()), f"bag:={folder / 'bag'}"]
    # The planner takes longest.
    return command, prefix(folder / "prefix"), "[planner]: active"


def ctrl_c(process):
    """As a terminal: to all processes of the group."""
    os.killpg(process.pid, signal.SIGINT)


def end(victim, process, domain):
    """End a node by SIGKILL, what started the stack by SIGKILL or SIGTERM, or all by Ctrl-C."""
    if victim == "Ctrl-C":
        ctrl_c(process)
    elif victim.startswith("SIG"):
        process.send_signal(signal.Signals[victim])
    else:
        os.kill(processes_of_domain(domain)[victim], signal.SIGKILL)


def hold(start, victim, seconds, packages, folder):
    """End the stack in motion and let the adapter go; whether the arm moved."""
    folder.mkdir()
    bench = Bench({**environment(), **packages}, folder, start)
    with bench.moving() as found:
        if found is None:
            return False
        process, seen = found
        end(victim, process, bench.domain)
        assert_rests(seen, seen[-1][0], seconds)
        wait_for(lambda: HOLDS in bench.output.read_text(), 20, "the adapter says that it holds the arm")
        assert alive(bench.adapter) and LETS_GO not in bench.output.read_text()
        # Neither a service manager nor a terminal that closes is the user.
        for number in (signal.SIGTERM, signal.SIGHUP):
            os.kill(bench.adapter, number)
            time.sleep(0.7)
            assert alive(bench.adapter)
        if process.poll() is None:
            ctrl_c(process)
        else:
            os.kill(bench.adapter, signal.SIGINT)
        wait_for(lambda: not alive(bench.adapter), 10, "the adapter lets go")
        wait_for(lambda: process.poll() is not None, 20, "what started the stack ends")
        said = bench.output.read_text()
        assert said.count(HOLDS) == 1 and LETS_GO + "the user insists" in said
        wait_for(lambda: not set(processes_of_domain(bench.domain)) - {"bringup"}, 20, "no process is left")
    return True


# Slow: in real time, which a busy machine disturbs.
pytestmark = pytest.mark.slow


def cases(*victims, longest):
    """Who is ended, and for how long the arm is watched, s."""
    return [*((victim, 3.0) for victim in victims), (longest, 30.0)]


@pytest.mark.parametrize(
    ("victim", "seconds"),
    cases("controller", "planner", "observer", "recorder", "SIGTERM", "Ctrl-C", longest="SIGKILL"),
)
def test_up_is_ended_and_the_arm_is_held_until_the_user_insists(victim, seconds, packages, tmp_path):
    attempts = (hold(up, victim, seconds, packages, tmp_path / str(attempt)) for attempt in range(ATTEMPTS))
    assert any(attempts), "the arm did not move"


@pytest.mark.parametrize(
    ("victim", "seconds"), cases("planner", "observer", "recorder", "Ctrl-C", longest="controller")
)
def test_launch_is_ended_and_the_arm_is_held_until_the_user_insists(victim, seconds, packages, tmp_path):
    attempts = (hold(launched, victim, seconds, packages, tmp_path / str(attempt)) for attempt in range(ATTEMPTS))
    assert any(attempts), "the arm did not move"
