"""Counting the messages that a recording misses."""

from __future__ import annotations

from collections.abc import Callable

LOST = "messages_lost"
"""Key of a bag's custom data for the number of messages that were missed; with a topic behind it, of that topic."""


class LossCounter:
    """Finds gaps in the sequence numbers of the messages of one topic.

    Every publisher numbers its messages on its own and a message does not tell its publisher, so the numbers
    that are expected next are kept, one per publisher seen.

    Attributes
    ----------
    lost :
        Messages that were sent while the topic was recorded and did not arrive.
    known :
        False once a message came without a number (some middlewares send none): then `lost` is a lower bound.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.known = True
        # A list: two publishers may have come equally far.
        self._expected: list[int] = []

    def count(self, sequence: int | None, publishers: Callable[[], int]) -> None:
        """Account for one message, in the order of arrival.

        Parameters
        ----------
        sequence :
            The number that its publisher gave it, None if it has none.
        publishers :
            Called to learn how many publishers the topic has now, only when a number is out of sequence.
        """
        if sequence is None:
            self.known = False
            return
        if sequence in self._expected:
            self._expected.remove(sequence)
        elif len(self._expected) >= publishers():
            # No publisher is new: one of those known has skipped numbers, or was replaced and counts afresh.
            earlier = [number for number in self._expected if number < sequence]
            if earlier:
                self.lost += sequence - max(earlier)
            if self._expected:
                self._expected.remove(max(earlier, default=min(self._expected)))
        self._expected.append(sequence + 1)
