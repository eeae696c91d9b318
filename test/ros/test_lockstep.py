"""Who waits for whom in lockstep, without any process."""

import random
from collections import deque

import pytest
from std_msgs.msg import Header

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.messages.values import nanoseconds
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep, LockstepDriver

TICK = 1_000_000
START = 1_000_000_000_000
MS = 1_000_000


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
    return LockstepDriver(True, TICK, clock=clock)


def never() -> bool:
    return False


def promise_all(driver: LockstepDriver, until_ns: int) -> None:
    for name in ("observer", "planner"):
        driver.hear(horizon(name, until_ns))


class TestDriver:
    def test_waits_for_controller_observer_and_planner(self, driver, clock):
        driver.expect([START])
        assert driver.silent == ["observer", "planner", "controller"]
        clock.arriving += [
            lambda: driver.hear(horizon("planner", START + 40 * MS)),
            lambda: driver.answered(),
            lambda: driver.hear(horizon("observer", START + TICK)),
        ]
        assert driver.wait(clock.handle, never)
        assert clock.now_ns == 3 * clock.step_ns
        # The planner has promised enough for the next states.
        driver.expect([START + TICK])
        assert driver.silent == ["observer", "controller"]

    def test_promise_up_to_the_state_itself_is_not_enough(self, driver):
        driver.expect([START])
        promise_all(driver, START)
        assert driver.silent == ["observer", "planner", "controller"]

    def test_controller_may_answer_without_a_command(self, driver):
        driver.expect([START])
        promise_all(driver, START + TICK)
        driver.hear(horizon("controller", START))
        assert driver.silent == []

    def test_others_take_part_if_named(self, clock):
        driver = LockstepDriver(True, TICK, ["demo"], clock)
        driver.expect([START])
        promise_all(driver, START + TICK)
        driver.answered()
        assert driver.silent == ["demo"]
        driver.hear(horizon("demo", FOREVER_NS))
        assert driver.silent == []
        driver.expect([START + TICK])
        assert "demo" not in driver.silent

    def test_only_an_expected_answer_counts(self, driver):
        driver.expect([START])
        assert driver.answered()
        assert not driver.answered()
        driver.expect([START + TICK])
        assert driver.unanswered == 1

    def test_nobody_answers_a_lost_state(self, driver):
        driver.expect([])
        assert driver.silent == []

    def test_controller_does_not_answer_repeated_and_older_states(self, driver):
        driver.expect([START])
        driver.expect([START, START - 5 * TICK])
        assert driver.unanswered == 0
        assert driver.silent == ["observer", "planner"]
        promise_all(driver, START - 4 * TICK)
        assert driver.silent == []

    def test_silent_nodes_are_named(self, driver, clock):
        driver.expect([START])
        driver.hear(horizon("observer", START + TICK))
        with pytest.raises(ContactReachError, match="no answer from planner, controller for 30 s"):
            driver.wait(clock.handle, never)
        assert 30_000 * MS < clock.now_ns < 30_100 * MS

    def test_first_state_is_repeated_until_everybody_has_received_it(self, driver, clock):
        repeated = []

        def repeat() -> None:
            repeated.append(clock.now_ns)
            driver.expect([START])

        driver.expect([START])
        clock.step_ns = 10_000 * MS
        clock.arriving += [driver.answered, lambda: None, lambda: None, lambda: None]
        clock.arriving.append(lambda: promise_all(driver, START + TICK))
        assert driver.wait(clock.handle, never, repeat)
        # Neither is patience limited, nor an answer that was given forgotten.
        assert clock.now_ns == 50_000 * MS and len(repeated) == 5

    def test_gives_up_when_the_node_ends(self, driver, clock):
        driver.expect([START])
        assert not driver.wait(clock.handle, lambda: True)

    def test_in_real_time_only_answers_are_counted(self):
        driver = LockstepDriver(False, TICK)
        assert driver.qos == topics.NEWEST
        driver.expect([START])
        assert driver.unanswered == 1
        assert driver.answered() and not driver.answered()


class TestOthers:
    @pytest.fixture
    def sent(self):
        return []

    @pytest.fixture
    def node(self, sent):
        return Lockstep("planner", TICK, lambda header: sent.append((header.frame_id, nanoseconds(header.stamp))))

    def test_a_state_is_done_as_often_as_it_comes(self, node, sent):
        node.done(START)
        node.done(START)
        assert sent == 2 * [("planner", START + TICK)]

    def test_an_answer_names_the_state(self, node, sent):
        node.answer(START)
        assert sent == [("planner", START)]

    def test_in_real_time_nothing_is_published_and_nothing_held_back(self):
        node = Lockstep("controller", TICK, None)
        node.done(START)
        node.promise(START)
        node.answer(START)
        assert node.may_handle(START) and not node.active
        assert node.qos == topics.NEWEST

    @pytest.mark.parametrize(
        ("name", "before"),
        [
            ("observer", ()),
            ("planner", ("observer",)),
            ("controller", ("observer",)),
            ("demo", ("observer", "planner")),
        ],
    )
    def test_a_state_is_handled_when_those_before_are_done_with_it(self, name, before):
        node = Lockstep(name, TICK, lambda header: None)
        for other in before:
            assert not node.may_handle(START)
            node.hear(horizon(other, START))
            assert not node.may_handle(START)
            node.hear(horizon(other, START + TICK))
        node.hear(horizon("controller", START))
        assert node.may_handle(START) and not (before and node.may_handle(START + TICK))

    def test_time_stands_while_the_first_state_is_repeated_but_not_for_ever(self, node):
        assert all(node.time_stands(START) for _ in range(100))
        assert not node.time_stands(START)
        assert not node.time_stands(START + TICK)

    def test_the_controller_waits_for_a_planner_that_has_promised(self):
        node = Lockstep("controller", TICK, lambda header: None)
        node.hear(horizon("observer", START + TICK))
        assert node.may_handle(START)
        node.hear(horizon("planner", START))
        assert not node.may_handle(START)
        node.hear(horizon("planner", START + TICK))
        assert node.may_handle(START)

    def test_who_has_promised_takes_part(self):
        node = Lockstep("planner", TICK, lambda header: None)
        node.hear(horizon("observer", START + TICK))
        node.hear(horizon("demo", START - TICK))
        assert not node.may_handle(START)
        # Later, it may send what takes effect with the next state.
        node.hear(horizon("demo", START))
        assert node.may_handle(START)

    def test_a_promise_holds_after_the_clock_was_set_back(self):
        node = Lockstep("planner", TICK, lambda header: None)
        node.hear(horizon("observer", START + TICK))
        node.hear(horizon("observer", START - 50 * TICK))
        assert node.may_handle(START)


@pytest.mark.parametrize("seed", range(20))
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
        receivers = ("driver", "planner", "controller", "demo")
        return lambda header: [send(name, receiver, header) for receiver in receivers]

    driver = LockstepDriver(True, TICK, ["demo"], lambda: 0)
    nodes = {name: Lockstep(name, TICK, promise(name)) for name in ("observer", "planner", "controller", "demo")}
    known: dict[str, list] = {name: [] for name in nodes}
    held: dict[str, deque] = {name: deque() for name in nodes}
    log = []
    for name in ("planner", "controller"):
        nodes[name].hear(horizon("demo", START))
    nodes["controller"].hear(horizon("planner", START))

    def act(name: str, tick: int) -> None:
        node, stamp_ns = nodes[name], START + tick * TICK
        if name == "observer":
            send(name, "planner", f"report {tick}")
        if name == "planner":
            send(name, "controller", f"plan {tick}")
        if name in ("planner", "controller"):
            log.append((name, tick, list(known[name])))
        if name == "demo" and tick == 3:
            send(name, "planner", "goal")
        node.answer(stamp_ns) if name == "controller" else node.done(stamp_ns)

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
        driver.expect([START + tick * TICK])
        for receiver in ("controller", "demo", "planner", "observer"):
            send("driver", receiver, tick)
        assert driver.wait(deliver, never)
    return log
