"""Who waits for whom in lockstep, without any process."""

import random
from collections import deque

import pytest
from std_msgs.msg import Header

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep, LockstepDriver

TICK = MS = 1_000_000
START = 1_000_000_000_000
NODES = ("observer", "planner", "controller")


def horizon(name: str, until_ns: int) -> Header:
    return Header(frame_id=name, stamp=to_time(until_ns))


class Driver(LockstepDriver):
    """On a clock that goes on while messages are awaited; `arriving` are handled one by one."""

    def __init__(self, participants: int = 3, ends: bool = False) -> None:
        self.now_ns, self.step_ns = 0, 30 * MS
        self.arriving: deque = deque()
        super().__init__(TICK, lambda: participants, self.handle, lambda: ends, lambda: self.now_ns)
        self.expect(START)

    def handle(self, _: int) -> None:
        self.now_ns += self.step_ns
        if self.arriving:
            self.arriving.popleft()()

    def hear_all(self, until_ns: int) -> None:
        for name in NODES:
            self.hear(horizon(name, until_ns))


class TestDriver:
    def test_waits_for_controller_observer_and_planner_and_those_that_have_promised(self):
        driver = Driver()
        assert driver.silent == [*NODES]
        driver.hear_all(START)
        driver.hear(horizon("recorder", START))
        assert driver.silent == [*NODES, "recorder"]
        promises = [("planner", START + 40 * MS), ("controller", START + TICK), ("observer", START + TICK)]
        promises += [("recorder", FOREVER_NS)]
        driver.arriving += [lambda promise=promise: driver.hear(horizon(*promise)) for promise in promises]
        driver.wait()
        assert driver.now_ns == 4 * driver.step_ns
        # The planner has promised enough for the next states.
        driver.expect(START + TICK)
        assert driver.silent == ["observer", "controller"]

    def test_silent_nodes_are_named(self):
        driver = Driver()
        driver.hear(horizon("observer", START + TICK))
        with pytest.raises(ContactReachError, match="no answer from planner, controller for 30 s"):
            driver.wait()
        assert 30_000 * MS < driver.now_ns < 30_100 * MS

    def test_first_state_is_repeated_until_everybody_is_there_and_commands_come(self):
        driver, repeated, commands = Driver(), [], []
        driver.step_ns = 10_000 * MS
        driver.arriving += [int, lambda: driver.hear_all(START + TICK), int, lambda: commands.append(1)]
        driver.begin(lambda: bool(commands), lambda: repeated.append(1))
        # Patience is not limited.
        assert driver.now_ns == 40_000 * MS and len(repeated) == 4

    def test_first_state_is_repeated_until_everybody_who_takes_part_has_promised(self):
        driver = Driver(participants=4)
        driver.hear_all(START + TICK)
        driver.arriving += [*99 * [int], lambda: driver.hear(horizon("recorder", START)), *99 * [int]]
        driver.arriving += [lambda: driver.hear(horizon("recorder", START + TICK))]
        driver.begin(lambda: True, int)
        assert driver.now_ns == 200 * driver.step_ns

    def test_time_begins_without_commands_after_a_while(self):
        driver = Driver()
        driver.hear_all(START + TICK)
        driver.begin(lambda: False, int)
        assert 1_000 * MS < driver.now_ns < 4_000 * MS

    def test_stands_still_for_as_long_as_it_takes(self):
        driver, wanted = Driver(), deque([True, True, False])
        driver.step_ns = 100_000 * MS
        driver.stand_still(wanted.popleft)
        assert driver.now_ns == 200_000 * MS

    def test_gives_up_when_the_node_ends(self):
        driver = Driver(ends=True)
        driver.wait()
        driver.begin(lambda: False, int)
        driver.stand_still(lambda: True)


class TestOthers:
    def test_a_controller_waits_for_the_adapter_that_passes_its_commands_on(self):
        assert not Lockstep("controller", TICK, None).may_handle(START), "the observer comes first"
        node = Lockstep("controller", TICK, None, after=["adapter"])
        node.hear(horizon("observer", START + TICK))
        assert not node.may_handle(START)
        node.hear(horizon("adapter", START))
        assert node.may_handle(START)

    def test_a_promise_holds_after_the_clock_was_set_back(self):
        node = Lockstep("planner", TICK, None)
        node.hear(horizon("observer", START + TICK))
        node.hear(horizon("observer", START - 50 * TICK))
        assert node.may_handle(START)


@pytest.mark.parametrize("seed", range(5))
def test_every_run_is_like_the_other(seed):
    """Messages of five nodes on ways of random length: what each handles, and in which order, is the same."""
    log = run(random.Random(seed))
    expected = []
    for tick in range(10):
        expected += [
            ("planner", tick, ["grasp"] * (tick >= 4) + [f"report {before}" for before in range(tick + 1)]),
            ("controller", tick, [f"plan {before}" for before in range(tick + 1)]),
        ]
    assert [(name, tick, sorted(known)) for name, tick, known in log] == expected


def run(chance: random.Random) -> list:
    """Ten ticks, with a message of a gripper after the fourth; returns who handled which state knowing what."""
    ways: dict[tuple[str, str], deque] = {}

    def send(sender: str, receiver: str, message) -> None:
        ways.setdefault((sender, receiver), deque()).append(message)

    def promise(name: str):
        return lambda header: [send(name, receiver, header) for receiver in ("driver", *NODES, "gripper")]

    def deliver(_: int) -> None:
        way = chance.choice([way for way, messages in ways.items() if messages])
        handle(way[1], ways[way].popleft())

    driver = LockstepDriver(TICK, lambda: 4, deliver, lambda: False, lambda: 0)
    nodes = {name: Lockstep(name, TICK, promise(name)) for name in (*NODES, "gripper")}
    known: dict[str, list] = {name: [] for name in nodes}
    held: dict[str, deque] = {name: deque() for name in nodes}
    log = []
    for name in ("planner", "controller"):
        nodes[name].hear(horizon("gripper", START))
    driver.hear(horizon("gripper", START))
    nodes["controller"].hear(horizon("planner", START))

    def act(name: str, tick: int) -> None:
        if name == "observer":
            send(name, "planner", f"report {tick}")
        if name == "planner":
            send(name, "controller", f"plan {tick}")
        if name in ("planner", "controller"):
            log.append((name, tick, list(known[name])))
        if name == "gripper" and tick == 3:
            send(name, "planner", "grasp")
        nodes[name].done(START + tick * TICK)

    def handle(receiver: str, message) -> None:
        if receiver == "driver":
            driver.hear(message)
            return
        if isinstance(message, Header):
            nodes[receiver].hear(message)
        elif isinstance(message, str):
            known[receiver].append(message)
        else:
            held[receiver].append(message)
        while held[receiver] and nodes[receiver].may_handle(START + held[receiver][0] * TICK):
            act(receiver, held[receiver].popleft())

    for tick in range(10):
        driver.expect(START + tick * TICK)
        for receiver in nodes:
            send("driver", receiver, tick)
        driver.wait()
        assert not driver.silent
    return log
