"""Who waits for whom in lockstep, without any process."""

import random
from collections import defaultdict, deque

import pytest

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.ros.lockstep import FOREVER_NS, Lockstep, LockstepDriver, promise

TICK = MS = 1_000_000
START = 1_000_000_000_000
NODES = ("observer", "planner", "controller")
HEARD = {"planner": ("report", "grasp"), "controller": ("plan",), "driver": ("command",)}
"""What who hears, in the test of whole runs."""


class Driver(LockstepDriver):
    """On a clock that goes on while messages are awaited; `arriving` are handled one by one."""

    def __init__(self, participants: int = 3, ends: bool = False) -> None:
        self.now_ns, self.step_ns = 0, 30 * MS
        self.arriving: deque = deque()
        super().__init__(TICK, lambda: participants, self.handle, lambda: ends, lambda: self.now_ns)

    def handle(self, _: int) -> None:
        self.now_ns += self.step_ns
        if self.arriving:
            self.arriving.popleft()()

    def hear_all(self, until_ns: int) -> None:
        for name in NODES:
            self.hear(promise(name, until_ns))


class TestDriver:
    def test_waits_for_controller_observer_and_planner_and_those_that_have_promised(self):
        driver = Driver()
        driver.hear_all(START)
        driver.hear(promise("recorder", START))
        promises = [("planner", START + 40 * MS), ("controller", START + TICK), ("observer", START + TICK)]
        promises += [("recorder", FOREVER_NS), ("observer", START + 2 * TICK), ("controller", START + 2 * TICK)]
        driver.arriving += [lambda given=given: driver.hear(promise(*given)) for given in promises]
        driver.wait(START)
        assert driver.now_ns == 4 * driver.step_ns
        # The planner has promised enough for the next states.
        driver.wait(START + TICK)
        assert driver.now_ns == 6 * driver.step_ns

    def test_silent_nodes_are_named(self):
        driver = Driver()
        driver.hear(promise("observer", START + TICK))
        with pytest.raises(ContactReachError, match="no answer from planner, controller for 30 s"):
            driver.wait(START)
        assert 30_000 * MS < driver.now_ns < 30_100 * MS

    def test_time_begins_when_everybody_who_takes_part_has_promised_something(self):
        driver = Driver(participants=4)
        driver.step_ns = 10_000 * MS
        names = deque([*NODES, "recorder"])
        driver.arriving += 4 * [int, lambda: driver.hear(promise(names.popleft(), 0)), int]
        driver.begin()
        assert driver.now_ns == 110_000 * MS and not names

    @pytest.mark.parametrize(("there", "missing"), [(["observer", "planner"], "controller"), (NODES, "1 more")])
    def test_who_does_not_start_is_named(self, there, missing):
        driver = Driver(participants=4)
        driver.step_ns = 1_000 * MS
        for name in there:
            driver.hear(promise(name, 0))
        with pytest.raises(ContactReachError, match=f"no answer from {missing}.* for 300 s; start it"):
            driver.begin()
        assert 300_000 * MS < driver.now_ns < 302_000 * MS

    def test_stands_still_for_as_long_as_it_takes(self):
        driver, wanted = Driver(), deque([True, True, False])
        driver.step_ns = 100_000 * MS
        driver.stand_still(wanted.popleft)
        assert driver.now_ns == 200_000 * MS

    def test_gives_up_when_the_node_ends(self):
        driver = Driver(ends=True)
        driver.begin()
        driver.wait(START)
        driver.stand_still(lambda: True)


class TestOthers:
    def test_a_controller_waits_for_the_adapter_that_passes_its_commands_on(self):
        node = Lockstep("controller", TICK, lambda _: None, others=["adapter"])
        for name in ("observer", "planner"):
            node.hear(promise(name, START + TICK))
        assert not node.may_handle(START)
        node.hear(promise("adapter", START))
        assert node.may_handle(START)

    def test_the_first_state_is_promised_when_all_were_heard_and_handled_when_all_have_promised_it(self):
        promised = []
        node = Lockstep("observer", TICK, promised.append)
        node.hear(promise("planner", START))
        assert not node.may_handle(START) and promised == []
        node.hear(promise("controller", 0))
        assert not node.may_handle(START) and not node.may_handle(START)
        assert promised == [promise("observer", START)]
        node.hear(promise("controller", START))
        assert node.may_handle(START) and len(promised) == 1

    def test_a_promise_holds_after_the_clock_was_set_back(self):
        node = Lockstep("planner", TICK, lambda _: None)
        node.hear(promise("controller", START))
        node.hear(promise("observer", START + TICK))
        node.hear(promise("observer", START - 50 * TICK))
        assert node.may_handle(START)


@pytest.mark.parametrize("seed", range(50))
def test_every_run_is_like_the_other(seed):
    """What each node handles, and in which order, however late nodes start, are connected and get their messages."""
    expected = []
    for tick in range(10):
        expected += [
            ("planner", tick, ["grasp 3"] * (tick >= 4) + [f"report {before}" for before in range(tick + 1)]),
            ("controller", tick, [f"plan {before}" for before in range(tick + 1)]),
            ("driver", tick, [f"command {before}" for before in range(tick + 1)]),
        ]
    assert [(name, tick, sorted(known)) for name, tick, known in Run(random.Random(seed)).log] == expected


class Run:
    """Ten ticks, with a message of a gripper after the fourth; `log`: who handled which state knowing what.

    From each node to each other one data are discovered before promises. What is sent before that is kept, and comes
    some time after it; all that is sent later comes in order.
    """

    def __init__(self, chance: random.Random) -> None:
        self.chance, self.log = chance, []
        names = (*NODES, "gripper")
        self.asleep = [*names]
        self.kept: dict[tuple, deque] = defaultdict(deque)
        self.ways: dict[tuple, deque] = defaultdict(deque)
        self.known: dict[str, list] = defaultdict(list)
        self.held: dict[str, deque] = defaultdict(deque)
        everybody = ("driver", *names)
        self.unconnected = {(sender, receiver): ["promises", "data"] for sender in everybody for receiver in everybody}
        heard_late = chance.choice(names)
        hear_late = chance.choice([("driver",), names])
        self.late = [(heard_late, receiver) for receiver in hear_late]
        """Connected when nothing else happens any more."""
        self.hurries = chance.random() < 0.5
        """Whether promises that were kept come before everything else."""
        others = [name for name in names if name not in NODES]
        self.nodes = {name: Lockstep(name, TICK, self.promise(name), others) for name in names}
        self.driver = LockstepDriver(TICK, lambda: len(names), self.happen, lambda: False, lambda: 0)
        self.driver.begin()
        for tick in range(10):
            self.send("driver", "data", tick)
            self.driver.wait(START + tick * TICK)
            self.log.append(("driver", tick, [*self.known["driver"]]))

    def promise(self, name: str):
        return lambda message: self.send(name, "promises", message)

    def send(self, sender: str, kind: str, message) -> None:
        for receiver in ("driver", *self.nodes):
            if receiver != sender:
                is_kept = kind in self.unconnected[sender, receiver]
                (self.kept[sender, receiver, kind] if is_kept else self.ways[sender, receiver]).append(message)

    def happen(self, _: int) -> None:
        """A node starts, is connected with another, or gets a message."""
        coming = [way for way in self.ways.items() if way[1]]
        coming += [
            (way, kept) for way, kept in self.kept.items() if kept and way[2] not in self.unconnected[way[0], way[1]]
        ]
        starts = [*self.asleep, *(pair for pair, kinds in self.unconnected.items() if kinds and pair not in self.late)]
        if not (starts or coming):
            starts = [pair for pair in self.late if self.unconnected[pair]]
        if starts and (not coming or self.chance.random() < 0.1):
            found = self.chance.choice(starts)
            if found in self.nodes:
                self.asleep.remove(found)
                self.nodes[found].join()
            else:
                del self.unconnected[found][self.chance.choice([-1, 0]) :]
        elif coming:
            kept = [way for way in coming if len(way[0]) == 3 and way[0][2] == "promises"]
            way, messages = self.chance.choice((self.hurries and kept) or coming)
            self.take(way[1], messages.popleft())

    def take(self, receiver: str, message) -> None:
        held = self.held[receiver]
        if isinstance(message, int):
            held.append(message)
        elif not isinstance(message, str):
            (self.nodes.get(receiver) or self.driver).hear(message)
        elif message.startswith(HEARD.get(receiver, ())):
            self.known[receiver].append(message)
        while held and self.nodes[receiver].may_handle(START + held[0] * TICK):
            self.act(receiver, held.popleft())

    def act(self, name: str, tick: int) -> None:
        if name in HEARD:
            self.log.append((name, tick, [*self.known[name]]))
        said = {"observer": "report", "planner": "plan", "controller": "command"}.get(name, "grasp")
        if name != "gripper" or tick == 3:
            self.send(name, "data", f"{said} {tick}")
        self.nodes[name].done(START + tick * TICK)
