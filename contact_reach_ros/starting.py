"""Signals while a process starts: they end it at once, as successful, since it has not done anything yet."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_watcher: threading.Thread | None = None


def end_at_signals() -> None:
    """End this process at SIGINT or SIGTERM, with exit code 0, until others are to handle them.

    Imports and compilers keep the main thread from handling signals for seconds: another thread does it for that long.
    """
    global _watcher
    for number in _SIGNALS:
        signal.signal(number, _end)
    if _watcher is None:
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        _watcher = threading.Thread(target=_watch, args=[reader], name="starting", daemon=True)
        _watcher.start()


def _end(number: int, frame: FrameType | None) -> None:
    os._exit(0)


def _watch(reader: int) -> None:
    while data := os.read(reader, 1):
        # Whoever has replaced the handler meanwhile wants to do more.
        if signal.getsignal(data[0]) is _end:
            os._exit(0)
