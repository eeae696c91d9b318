"""Counts the messages missing from a recording."""

from __future__ import annotations

from collections.abc import Callable

LOST = "messages_lost"
"""Key of a bag's custom data for the number of lost messages; with a topic's name appended, those of that topic."""


class LossCounter:
    """Finds gaps in the sequence numbers of the messages of one topic.

    Each publisher numbers its own messages, and a message does not name its publisher; so the counter keeps one
    expected number for each publisher seen.

    Attributes
    ----------
    lost :
        Number of messages that were sent while the topic was recorded and did not arrive.
    known :
        False after a message without a number (some middlewares send none): then `lost` is a lower bound.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.known = True
        # A list, not a set: two publishers may have reached the same number.
        self._expected: list[int] = []

    def count(self, sequence: int | None, publishers: Callable[[], int]) -> None:
        """Count one message; messages must be passed in the order of arrival.

        Parameters
        ----------
        sequence :
            Its publisher's number of the message, None if it has none.
        publishers :
            Returns the current number of publishers; called only when a number is out of sequence.
        """
        if sequence is None:
            self.known = False
            return
        if sequence in self._expected:
            self._expected.remove(sequence)
        elif len(self._expected) >= publishers():
            # No publisher is new: a known one skipped numbers, or was replaced by one with a count of its own.
            earlier = [number for number in self._expected if number < sequence]
            if earlier:
                self.lost += sequence - max(earlier)
            if self._expected:
                self._expected.remove(max(earlier, default=min(self._expected)))
        self._expected.append(sequence + 1)
