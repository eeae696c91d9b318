"""How processes that belong together end: with the one that started them, which a signal makes end them in order."""

from __future__ import annotations

import ctypes
import signal

from contact_reach_ros.errors import ContactReachError

_PR_SET_PDEATHSIG = 1


class StackError(ContactReachError):
    """The stack did not come up, or one of its processes died."""


def end_with_parent() -> None:
    """In a child: be ended by the kernel when its parent is killed, so that no orphan moves an arm."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Interruption:
    """Records signals from its creation on; only `check` raises `KeyboardInterrupt`.

    Python would raise it anywhere, also where rclpy's C++ makes a Python object and then reports another error, and a
    second Ctrl-C would leave processes behind.
    """

    def __init__(self) -> None:
        self._came = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if a signal came, at every call."""
        if self._came:
            raise KeyboardInterrupt

    def _note(self, *_: object) -> None:
        self._came = True
