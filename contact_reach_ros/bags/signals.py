"""Arm and time series of an episode, read from a bag, as reports, the viewer and identification use them.

Times are seconds of the robot's own clock since its first joint state. Joint states, torques and contacts carry stamps
of that clock. `Clock` translates the reception times of messages without a stamp, also where the robot's clock runs at
another rate than the wall clock.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from contact_reach_ros.arm import Arm, tip_positions
from contact_reach_ros.arms import EARLIER_DIGESTS, ROBOT_DIGEST, ROBOT_TABLE, arm_in, load_arm
from contact_reach_ros.bags.columns import Arrays, Collector, Column, JointStates
from contact_reach_ros.bags.mcap_file import Messages
from contact_reach_ros.bags.reader import BagReader, RawMessage
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.messages.intake import Taken, read_batch
from contact_reach_ros.messages.safety_state import SafetyState, read_state
from contact_reach_ros.messages.values import GOAL_PHASE, GOAL_STAMP, nanoseconds, numbers, read_settings
from contact_reach_ros.timing import NANOSECONDS

SETTINGS = "settings"
COMMANDS = ("adapter/commands", "effort_controller/commands")
"""Topics with the controller's torques, in the arm's order: behind an adapter the second one is the drive's."""

_ONLOOKERS = ("recorder", "viewer")
"""Nodes that may have been started apart from the stack, with another arm."""

_REFUSED, _SETTLED = "refused", "settled"
"""Phases of goals that are kept: one that is not pursued, and one at which the arm is at rest."""

_OF_PLANS = ("took ms", "cost")
"""Beginnings of the keys in plan/statistics that are kept."""
_STOP_REASON, _MISSED = "stop reason", "missed ticks"
"""Keys: why the search for a plan ended, and the driver's count in its diagnostics."""

_ROUNDING = 1e-9
"""Difference of two times that are equal except for rounding, s."""


class Clock:
    """Places messages on the robot's clock, in s since its first joint state, by reception and stamps of these, ns.

    Attributes
    ----------
    origin_ns :
        Stamp of the first joint state, ns.
    """

    def __init__(self, received_ns: np.ndarray, stamps_ns: np.ndarray) -> None:
        stamped = np.flatnonzero(stamps_ns)
        if not len(stamped):
            received_ns = stamps_ns = np.append(received_ns, 0)[:1]
        elif len(stamped) < len(stamps_ns):
            received_ns, stamps_ns = received_ns[stamped], stamps_ns[stamped]
        self._received_ns, self._stamps_ns = received_ns, stamps_ns
        self.origin_ns = int(stamps_ns[0])

    def of_stamps(self, stamps_ns: np.ndarray, received_ns: np.ndarray) -> np.ndarray:
        """By the stamps in the headers, or by reception where they are zero."""
        times = (stamps_ns - self.origin_ns) / NANOSECONDS
        unknown = stamps_ns == 0
        times[unknown] = self.of_receptions(received_ns[unknown])
        return times

    def of_receptions(self, received_ns: np.ndarray) -> np.ndarray:
        """By times of reception, ns."""
        known_ns, begin_ns = self._received_ns, self._received_ns[0]
        inside = np.interp(received_ns - begin_ns, known_ns - begin_ns, self._stamps_ns - self.origin_ns)
        # Outside of the joint states both clocks are taken to run alike.
        return np.asarray((inside + (received_ns - np.clip(received_ns, begin_ns, known_ns[-1]))) / NANOSECONDS)


@dataclasses.dataclass(frozen=True)
class Series:
    """Values over time.

    Attributes
    ----------
    time :
        (n,), s.
    names :
        Names of the k columns.
    values :
        (n, k); NaN where a message lacks the value.
    """

    time: np.ndarray
    names: tuple[str, ...]
    values: np.ndarray

    def column(self, name: str) -> np.ndarray:
        """The values (n,) of one name; all NaN without such a column."""
        if name not in self.names:
            return np.full(len(self.time), np.nan)
        return self.values[:, self.names.index(name)]

    def between(self, start: float, end: float) -> Series:
        """The part from `start` to `end`, s, both included."""
        inside = (self.time >= start) & (self.time <= end)
        return Series(self.time[inside], self.names, self.values[inside])


@dataclasses.dataclass(frozen=True)
class EpisodeSignals:
    """The signals of an episode; a series is empty where its topic was not recorded.

    Attributes
    ----------
    clock :
        Translates stamps and reception times to the times of the series.
    position, velocity, effort :
        Joint states, rad, rad/s, Nm.
    command :
        Commanded torques, Nm.
    external_torque :
        Residual of the momentum observer, Nm.
    contact_force :
        True contact force in simulation, N: a column per robot body, and the columns "sum" and "max".
    safety_states :
        Safety states of the nodes, as they were published.
    goals :
        Positions of the goals that the planner accepted, m: the columns x, y and z.
    refused_goals :
        Positions of the goals that the planner refused, likewise.
    settled :
        (n,) times at which the planner reported that the arm has settled at its goal, s.
    missed_ticks :
        The driver's count of missed ticks: one column.
    plans :
        Solve time and costs of the plans by key, at the times at which they take effect.
    stop_reasons :
        Why the search for each of the plans ended.
    state_sent_ns :
        (n,) when the joint states were sent, ns since the epoch.
    answers_ns :
        (n,) from the sending of a joint state to the sending of its command, ns.
    notes :
        Irregularities of the messages, one sentence each.
    """

    clock: Clock
    position: Series
    velocity: Series
    effort: Series
    command: Series
    external_torque: Series
    contact_force: Series
    safety_states: tuple[SafetyState, ...]
    goals: Series
    refused_goals: Series
    settled: np.ndarray
    missed_ticks: Series
    plans: Series
    stop_reasons: tuple[str, ...]
    state_sent_ns: np.ndarray
    answers_ns: np.ndarray
    notes: tuple[str, ...]

    @property
    def safety(self) -> tuple[SafetyState, ...]:
        """Changes of the safety states: repetitions are left out."""
        last: dict[str, tuple[int, str]] = {}
        changes = []
        for state in self.safety_states:
            if last.get(state.name) != (state.level, state.message):
                last[state.name] = state.level, state.message
                changes.append(state)
        return tuple(changes)

    def plan_age(self, times: np.ndarray) -> np.ndarray:
        """Time (n,), s, since the plan in force at each of the times (n,), s, took effect; NaN before the first."""
        rows = np.searchsorted(self.plans.time, times + _ROUNDING, side="right") - 1
        return np.asarray(times - np.append(self.plans.time, np.nan)[rows])


def settings_of_bag(bag: BagReader) -> dict[str, Mapping[str, Any]]:
    """The last settings of each node."""
    return {status.name: read_settings(status) for status in bag.messages(f"/{SETTINGS}")}


def arm_of_bag(bag: BagReader) -> Arm:
    """The arm that the nodes of a bag had, with its last tool; raises `BagError` as `recorded_arm`."""
    return recorded_arm(settings_of_bag(bag))


def recorded_arm(settings: Mapping[str, Mapping[str, Any]]) -> Arm:
    """The arm that nodes had, with its tool; `settings` are the recorded ones by node.

    Raises `BagError` if this version does not have it, or has another one of that name.
    """
    found: Arm | None = None
    for node, values in settings.items():
        try:
            arm = arm_in(values, f"settings of the {node}")
        except SettingsError as error:
            raise BagError(str(error)) from error
        digest = values.get(ROBOT_DIGEST, arm.digest)
        # A table is the arm itself.
        if digest not in (arm.digest, *EARLIER_DIGESTS.get(arm.digest, ())) and ROBOT_TABLE not in values:
            raise BagError(
                f"settings of the {node}: the arm '{arm.name}' had digest {digest}, this version's has {arm.digest}; "
                "use the version that recorded the bag"
            )
        if node not in _ONLOOKERS:
            found = found or arm
    return found or load_arm()


def read_signals(bag: BagReader, arm: Arm) -> EpisodeSignals:
    """Read an episode; joints and contact links are mapped by name to those of the arm."""
    joints, count = arm.joint_names, arm.n
    forces = *arm.contact_links, "sum", "max"
    commands = next((name for name in COMMANDS if f"/{name}" in bag.topics), COMMANDS[-1])
    columns: dict[str, Collector] = {
        "joint_states": JointStates(("position", "velocity", "effort"), joints),
        commands: Arrays(count),
        "external_torque": JointStates(("effort",), joints),
        "sim/contacts": JointStates(("effort",), forces),
    }
    take: dict[str, Callable[[Any], Any]] = {
        "goal/state": _end_of_goal,
        "goal_pose": lambda message: message,
        "safety_state": partial(read_state, arm=arm),
        "diagnostics": _missed_ticks,
        "plan/statistics": _plan,
        "intake/controller": _answered,
    }
    sparse: dict[str, list[tuple[int, Any]]] = {name: [] for name in take}

    def few(name: str, messages: Messages) -> None:
        """Keep of each message what is needed."""
        for _, *row in messages.tolist():
            raw = RawMessage(f"/{name}", *row)
            message = bag.decode(raw)
            taken = None if message is None else take[name](message)
            if taken is not None:
                sparse[name].append((raw.log_time_ns, taken))

    handlers: dict[str, Callable[[Messages], None]] = {f"/{name}": column for name, column in columns.items()}
    handlers |= {f"/{name}": partial(few, name) for name in sparse}
    bag.pass_on(handlers)
    state, command, torque, contact = read = [column.column() for column in columns.values()]
    clock = Clock(state.log_ns, state.stamp_ns)

    def received(name: str) -> list[tuple[float, Any]]:
        """Time, s, and what is kept of a message."""
        times = clock.of_receptions(np.array([log_ns for log_ns, _ in sparse[name]], np.int64)).tolist()
        return list(zip(times, (taken for _, taken in sparse[name]), strict=True))

    state_times = clock.of_stamps(state.stamp_ns, state.log_ns)
    plans = sorted((plan for _, plan in sparse["plan/statistics"]), key=lambda plan: plan[0])
    keys = sorted({key for *_, values in plans for key in values})
    effects_ns = np.array([effect_ns for effect_ns, *_ in plans], np.int64)
    plan_table = np.array([[values.get(key, np.nan) for key in keys] for *_, values in plans])
    missed = np.array(received("diagnostics")).reshape(-1, 2)
    states = received("goal/state")
    goals, refused_goals = _goals(received("goal_pose"), states, arm.base_frame)
    return EpisodeSignals(
        clock,
        Series(state_times, joints, state.values[:, :count]),
        Series(state_times, joints, state.values[:, count : 2 * count]),
        Series(state_times, joints, state.values[:, 2 * count :]),
        Series(clock.of_receptions(command.log_ns), joints, command.values),
        Series(clock.of_stamps(torque.stamp_ns, torque.log_ns), joints, torque.values),
        Series(clock.of_stamps(contact.stamp_ns, contact.log_ns), forces, contact.values),
        tuple(state._replace(time=time) for time, state in received("safety_state")),
        goals,
        refused_goals,
        np.array([time for time, values in states if values[GOAL_PHASE] == _SETTLED]),
        Series(missed[:, 0], ("missed ticks",), missed[:, 1:]),
        Series((effects_ns - clock.origin_ns) / NANOSECONDS, tuple(keys), plan_table.reshape(len(plans), len(keys))),
        tuple(reason for _, reason, _ in plans),
        state.publish_ns,
        _answers(command, [taken for _, taken in sparse["intake/controller"]]),
        tuple(_oddities(dict(zip(columns, read, strict=True)), joints)),
    )


def goal_distance(signals: EpisodeSignals, arm: Arm, period: float = 0.01) -> Series:
    """Distance of the flange from the goal in force; before the first goal, from the first goal.

    Parameters
    ----------
    signals :
        The episode.
    arm :
        The recorded arm.
    period :
        Spacing of the result, s; joint states in between are left out.

    Returns
    -------
    Series
        The column "distance", m; empty without goals or without joint states.
    """
    time, positions = signals.position.time, signals.position.values
    if not len(signals.goals.time) or not len(time):
        return Series(np.empty(0), ("distance",), np.empty((0, 1)))
    # The first joint state of each period, and the last of all; a stamp far from all others makes no more of them.
    _, rows = np.unique(np.floor((time - time[0]) / period + 1e-3), return_index=True)
    rows = np.union1d(rows, [len(time) - 1])
    rows = rows[np.all(np.isfinite(positions[rows]), axis=1)]
    in_force = np.maximum(np.searchsorted(signals.goals.time, time[rows], side="right") - 1, 0)
    away = tip_positions(arm, positions[rows]) - signals.goals.values[in_force]
    return Series(time[rows], ("distance",), np.linalg.norm(away, axis=1, keepdims=True))


def _end_of_goal(message: Any) -> dict[str, str] | None:
    """The values of a goal's state in which it is refused or settled; None for others."""
    values = {entry.key: entry.value for entry in message.values}
    return values if values.get(GOAL_PHASE) in (_REFUSED, _SETTLED) else None


def _missed_ticks(message: Any) -> float | None:
    """The driver's count of missed ticks in its diagnostics; None in those of other nodes."""
    counts = (dict(numbers(status)).get(_MISSED) for status in message.status if status.name == "driver")
    return next(counts, None)


def _plan(message: Any) -> tuple[int, str, dict[str, float]] | None:
    """When a plan takes effect, ns, why its search ended, and its numbers; None without a plan."""
    for status in message.status:
        reason = next((entry.value for entry in status.values if entry.key == _STOP_REASON), status.message)
        values = {key: value for key, value in numbers(status) if key.startswith(_OF_PLANS)}
        return nanoseconds(message.header.stamp), reason, values
    return None


def _answered(message: Any) -> np.ndarray:
    """Of the joint states in a batch of the controller's intake (2, n): number of the next command, and sending, ns."""
    _, rows = read_batch(message)
    return np.stack([rows[:, 3] + 1, rows[:, 1]])[:, rows[:, 0] == Taken.JOINT_STATES]


def _answers(command: Column, answered: Sequence[np.ndarray]) -> np.ndarray:
    """From the sending of each joint state to that of its command, ns; `answered` are those of `_answered`."""
    if not len(command) or not answered:
        return np.zeros(0, np.int64)
    wanted, states_ns = np.concatenate(answered, axis=1)
    order = np.argsort(command.sequence, kind="stable")
    at = order[np.minimum(np.searchsorted(command.sequence, wanted, sorter=order), len(command) - 1)]
    # States before the start, or that came again, have no answer: the number of commands stays as it is.
    is_last = np.append(wanted[1:] != wanted[:-1], True)
    found = (command.publish_ns[at] - states_ns)[is_last & (command.sequence[at] == wanted)]
    return found[(found >= 0) & (found < NANOSECONDS)]


def _oddities(columns: Mapping[str, Column], joints: Sequence[str]) -> Iterator[str]:
    for name, column in columns.items():
        if column.refused:
            yield f"{name}: {column.refused} messages cannot be read and are left out"
        if column.back:
            yield f"{name}: {column.back} stamps are older than the one before; curves follow the stamps"
    for name in columns:
        if name == "sim/contacts":
            continue
        is_unknown = np.isnan(columns[name].values[:, : len(joints)])
        # Grippers have joint states of their own on the same topic.
        foreign = int(is_unknown.all(axis=1).sum()) if name == "joint_states" else 0
        lacking = int(is_unknown.any(axis=1).sum()) - foreign
        if foreign and foreign == len(is_unknown):
            yield f"joint_states: has none of the joints {', '.join(joints)}: is it another robot's?"
        elif lacking:
            yield f"{name}: at least {lacking} messages lack a number for one of the arm's {len(joints)} joints"


def _goals(
    goals: Sequence[tuple[float, Any]], states: Sequence[tuple[float, Mapping[str, str]]], base_frame: str
) -> Iterator[Series]:
    """Yield the goals that were not refused, and the others; those in other frames come again, transformed."""
    goals = [(time, message) for time, message in goals if message.header.frame_id in ("", base_frame)]
    times, places = np.array([time for time, _ in goals]), [message.pose.position for _, message in goals]
    stamps_ns = np.array([str(nanoseconds(message.header.stamp)) for _, message in goals])
    positions = np.array([(place.x, place.y, place.z) for place in places]).reshape(-1, 3)
    kept = np.isfinite(positions).all(axis=1)
    for time, values in states:
        sent = np.flatnonzero(stamps_ns == values.get(GOAL_STAMP, ""))
        if values[GOAL_PHASE] == _REFUSED and len(sent):
            # Stamps may be zero.
            kept[sent[np.abs(times[sent] - time).argmin()]] = False
    for some in (kept, ~kept):
        yield Series(times[some], ("x", "y", "z"), positions[some])
