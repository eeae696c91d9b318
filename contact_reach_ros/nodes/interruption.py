"""SIGINT and SIGTERM for a process that has others to end first."""

from __future__ import annotations

import signal

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Takes note of the signals from its creation on; a `KeyboardInterrupt` comes only where `check` is called.

    Python would raise it at any place, also where rclpy's C++ makes a Python object and reports something else.

    Attributes
    ----------
    came
        Whether there was a signal.
    """

    def __init__(self) -> None:
        self.came = False
        for number in _SIGNALS:
            signal.signal(number, self._note)

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if there was a signal, also when asked again."""
        if self.came:
            raise KeyboardInterrupt

    def ignore(self) -> None:
        """Let no further signal do anything: a second Ctrl-C must not leave processes behind."""
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _note(self, *_: object) -> None:
        self.came = True
