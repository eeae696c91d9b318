"""SIGINT and SIGTERM for a process that has to end others first."""

from __future__ import annotations

import signal

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interruption:
    """Records signals from its creation on; only `check` raises `KeyboardInterrupt`.

    Python would raise it anywhere, also where rclpy's C++ makes a Python object and then reports another error.

    Attributes
    ----------
    came
        Whether a signal came.
    """

    def __init__(self) -> None:
        self.came = False
        for number in _SIGNALS:
            signal.signal(number, self._note)

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if a signal came, at every call."""
        if self.came:
            raise KeyboardInterrupt

    def ignore(self) -> None:
        """Ignore further signals: a second Ctrl-C must not leave processes behind."""
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _note(self, *_: object) -> None:
        self.came = True
