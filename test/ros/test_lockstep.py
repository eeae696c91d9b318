"""Who waits for whom in lockstep, without any process."""

import random
from collections import deque

import pytest
from std_msgs.msg import Header

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep, LockstepDriver

TICK = MS = 1_000_000
START = 1_000_000_000_000
NODES = ("observer", "planner", "controller")


def horizon(name: str, until_ns: int) -> Header:
    return Header(frame_id=name, stamp=to_time(until_ns))


class Clock:
    """Steady time that passes while messages are waited for; `arriving` are handled one by one."""

    def __init__(self, step_ns: int = 30 * MS) -> None:
        self.now_ns = 0
        self.step_ns = step_ns
        self.arriving: deque = deque()

    def __call__(self) -> int:
        return self.now_ns

    def handle(self, _: int) -> None:
        self.now_ns += self.step_ns
        if self.arriving:
            self.arriving.popleft()()


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def driver(clock):
    driver = LockstepDriver(TICK, clock=clock)
    driver.expect(START)
    return driver


def never() -> bool:
    return False


def promise_all(driver: LockstepDriver, until_ns: int) -> None:
    for name in NODES:
        driver.hear(horizon(name, until_ns))


class TestDriver:
    def test_waits_for_controller_observer_and_planner(self, driver, clock):
        promise_all(driver, START)
        assert driver.silent == [*NODES]
        promises = [("planner", START + 40 * MS), ("controller", START + TICK), ("observer", START + TICK)]
        clock.arriving += [lambda promise=promise: driver.hear(horizon(*promise)) for promise in promises]
        assert driver.wait(clock.handle, never)
        assert clock.now_ns == 3 * clock.step_ns
        # The planner has promised enough for the next states.
        driver.expect(START + TICK)
        assert driver.silent == ["observer", "controller"]

    def test_others_take_part_if_named(self, clock):
        driver = LockstepDriver(TICK, ["demo"], clock)
        driver.expect(START)
        promise_all(driver, START + TICK)
        assert driver.silent == ["demo"]
        driver.hear(horizon("demo", FOREVER_NS))
        driver.expect(START + TICK)
        assert "demo" not in driver.silent

    def test_silent_nodes_are_named(self, driver, clock):
        driver.hear(horizon("observer", START + TICK))
        with pytest.raises(ContactReachError, match="no answer from planner, controller for 30 s"):
            driver.wait(clock.handle, never)
        assert 30_000 * MS < clock.now_ns < 30_100 * MS

    def test_first_state_is_repeated_until_everybody_is_there_and_commands_come(self, driver, clock):
        repeated, commands = [], []
        clock.step_ns = 10_000 * MS
        nothing = lambda: None  # noqa: E731
        clock.arriving += [nothing, lambda: promise_all(driver, START + TICK), nothing, lambda: commands.append(1)]
        assert driver.begin(clock.handle, never, lambda: bool(commands), lambda: repeated.append(1))
        # Patience is not limited.
        assert clock.now_ns == 40_000 * MS and len(repeated) == 4

    def test_time_begins_without_commands_after_a_while(self, driver, clock):
        promise_all(driver, START + TICK)
        assert driver.begin(clock.handle, never, never, lambda: None)
        assert 1_000 * MS < clock.now_ns < 4_000 * MS

    def test_gives_up_when_the_node_ends(self, driver, clock):
        assert not driver.wait(clock.handle, lambda: True)
        assert not driver.begin(clock.handle, lambda: True, never, lambda: None)


class TestOthers:
    def test_a_state_is_done_as_often_as_it_comes(self):
        sent = []
        node = Lockstep("planner", TICK, lambda header: sent.append((header.frame_id, nanoseconds(header.stamp))))
        node.done(START)
        node.done(START)
        assert sent == 2 * [("planner", START + TICK)]

    @pytest.mark.parametrize(
        ("name", "before"),
        [
            ("observer", ()),
            ("planner", ("observer",)),
            ("controller", ("observer",)),
            ("adapter", ()),
            ("demo", NODES),
        ],
    )
    def test_a_state_is_handled_when_those_before_are_done_with_it(self, name, before):
        node = Lockstep(name, TICK, None)
        for other in before:
            assert not node.may_handle(START)
            node.hear(horizon(other, START))
            assert not node.may_handle(START)
            node.hear(horizon(other, START + TICK))
        assert node.may_handle(START) and not (before and node.may_handle(START + TICK))

    @pytest.mark.parametrize(("name", "earlier"), [("controller", "planner"), ("adapter", "controller")])
    def test_who_has_promised_takes_part(self, name, earlier):
        node = Lockstep(name, TICK, None)
        node.hear(horizon("observer", START + TICK))
        node.hear(horizon(earlier, START))
        assert not node.may_handle(START)
        node.hear(horizon(earlier, START + TICK))
        node.hear(horizon("demo", START - TICK))
        assert not node.may_handle(START)
        # Later, it may send what takes effect with the next state.
        node.hear(horizon("demo", START))
        assert node.may_handle(START)

    def test_a_controller_waits_for_the_adapter_that_passes_its_commands_on(self):
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
            ("planner", tick, ["goal"] * (tick >= 4) + [f"report {before}" for before in range(tick + 1)]),
            ("controller", tick, [f"plan {before}" for before in range(tick + 1)]),
        ]
    assert [(name, tick, sorted(known)) for name, tick, known in log] == expected


def run(chance: random.Random) -> list:
    """Ten ticks, with a goal after the fourth; returns who handled which state, and what was known by then."""
    ways: dict[tuple[str, str], deque] = {}

    def send(sender: str, receiver: str, message) -> None:
        ways.setdefault((sender, receiver), deque()).append(message)

    def promise(name: str):
        return lambda header: [send(name, receiver, header) for receiver in ("driver", *NODES, "demo")]

    driver = LockstepDriver(TICK, ["demo"], lambda: 0)
    nodes = {name: Lockstep(name, TICK, promise(name)) for name in (*NODES, "demo")}
    known: dict[str, list] = {name: [] for name in nodes}
    held: dict[str, deque] = {name: deque() for name in nodes}
    log = []
    for name in ("planner", "controller"):
        nodes[name].hear(horizon("demo", START))
    nodes["controller"].hear(horizon("planner", START))

    def act(name: str, tick: int) -> None:
        if name == "observer":
            send(name, "planner", f"report {tick}")
        if name == "planner":
            send(name, "controller", f"plan {tick}")
        if name in ("planner", "controller"):
            log.append((name, tick, list(known[name])))
        if name == "demo" and tick == 3:
            send(name, "planner", "goal")
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

    def deliver(_: int) -> None:
        way = chance.choice([way for way, messages in ways.items() if messages])
        handle(way[1], ways[way].popleft())

    for tick in range(10):
        driver.expect(START + tick * TICK)
        for receiver in nodes:
            send("driver", receiver, tick)
        assert driver.wait(deliver, never)
    return log
