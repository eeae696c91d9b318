"""Stopping the arm and releasing it, through the services ~/stop and ~/reset of whichever nodes answer."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.ros.interfaces import STOPPABLE

Call = Callable[[str], Any]
"""Calls the Trigger service of a name and returns its answer; raises `ContactReachError` without one."""

_NOTHING = "nothing is stopped"


class Outcome(NamedTuple):
    """Whether it was done, and a line for the user."""

    done: bool
    text: str


def stop_arm(call: Call, names: Sequence[str] = STOPPABLE) -> Outcome:
    """Stop the arm by the first of these nodes that does it: by default the controller, or another if that fails."""
    failures = []
    for name in names:
        try:
            answer = call(f"{name}/stop")
        except ContactReachError as error:
            failures.append(str(error))
            continue
        if answer.success:
            return Outcome(True, f"{name}: {answer.message}")
        failures.append(f"{name}: {answer.message}")
    return Outcome(False, "NOT stopped: " + "; ".join(failures))


def release(stopped: Collection[str], call: Call) -> Outcome:
    """Release the stops of these nodes; the controller comes last, since it refuses while the observer is stopped."""
    answers: list[str] = []
    for name in [name for name in reversed(STOPPABLE) if name in stopped]:
        try:
            answer = call(f"{name}/reset")
        except ContactReachError as error:
            return Outcome(False, "; ".join([*answers, str(error)]))
        answers.append(f"{name}: {answer.message or 'done'}")
        if not answer.success:
            return Outcome(False, "; ".join(answers))
    return Outcome(True, "; ".join(answers) or _NOTHING)


def release_all(look: Callable[[], Collection[str]], call: Call, is_over: Callable[[], bool]) -> Outcome:
    """Release whoever is stopped, and look again, until nobody is or the time is over.

    Until the arm is at rest a release is refused; and a drive closes its brakes on its own some seconds after the stop
    of the controller, perhaps just when that is being released. `look` returns the nodes that are stopped.
    """
    released: list[str] = []
    outcome = release(look(), call)
    while not is_over():
        stopped = look()
        if outcome.done and not stopped:
            break
        if outcome.done and outcome.text != _NOTHING:
            released.append(outcome.text)
        outcome = release(stopped, call)
    return Outcome(outcome.done, "; ".join([*released, outcome.text]))
