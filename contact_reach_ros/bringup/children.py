"""Processes that this one starts, watches and ends, and the signals that make it end them."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from contact_reach_ros.errors import ContactReachError

_END_TIMEOUT_S = 15.0
_PR_SET_PDEATHSIG = 1
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StackError(ContactReachError):
    """The stack did not come up, or one of its processes died."""


class Children:
    """Child processes by name.

    Parameters
    ----------
    log
        File for their output; this process's own terminal when None.

    Attributes
    ----------
    optional
        Names of those whose end is only reported.
    """

    def __init__(self, log: Path | None) -> None:
        self._log_path = log
        self._log: IO[bytes] | None = None
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self.optional: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self._running

    @property
    def process_ids(self) -> dict[str, int]:
        """Of the processes that were started, by name."""
        return {name: process.pid for name, process in self._running.items()}

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """Start Python with these arguments."""
        if self._log_path is not None and self._log is None:
            self._log = self._log_path.open("wb")
        self._running[name] = subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            # A Ctrl-C in the terminal reaches this process only, which then ends the others in order.
            start_new_session=True,
            preexec_fn=end_with_parent,
        )

    def is_alive(self, name: str) -> bool:
        """Whether a process was started and has not ended."""
        process = self._running.get(name)
        return process is not None and process.poll() is None

    def check(self) -> None:
        """Raise `StackError` if a process died, with how it ended."""
        for name, process in list(self._running.items()):
            code = process.poll()
            if code is None:
                continue
            how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
            if name not in self.optional:
                raise StackError(f"{name} ended ({how}){self.see_log()}")
            print(f"{name} ended ({how}); the stack goes on without it", file=sys.stderr)
            del self._running[name]

    def end(self, name: str) -> None:
        """End a process, if it is running: by SIGKILL if SIGTERM does not do it."""
        process = self._running.pop(name, None)
        if process is None or process.poll() is not None:
            return
        # Not SIGINT, which Python turns into a traceback while it is still importing.
        process.terminate()
        try:
            process.wait(_END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            print(f"{name} did not end within {_END_TIMEOUT_S:.0f} s of SIGTERM: killed", file=sys.stderr)
            process.kill()
            process.wait()

    def see_log(self) -> str:
        """Where the output of the processes is, to be appended to a message."""
        return f"; its output is in {self._log_path}" if self._log_path else ""

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            self._log.close()


def end_with_parent() -> None:
    """In a child: be ended by the kernel when its parent is killed, so that no orphan moves an arm."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


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
