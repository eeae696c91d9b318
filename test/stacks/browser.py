"""A headless Chromium, driven through its DevTools protocol: just what the tests of the page need."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stack_helpers import running, wait_for
from websockets.sync.client import connect

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_START_S, _ANSWER_S = 60.0, 120.0

_THROTTLE_MS = 60
"""viser's page sends once in 50 ms, and of what is done meanwhile on all its inputs only the last."""

_FIND_INPUT = (
    "(() => {{ const labels = [...document.querySelectorAll('label')].filter(e => e.innerText.trim() === {0}); "
    "for (const l of labels) {{ let n = l; for (let i = 0; i < 5 && n; i++) {{ "
    "const e = n.querySelector('input:not([type=hidden])'); if (e) {{ {1} }} n = n.parentElement; }} }} "
    "return null; }})()"
)
"""Does something with the first input next to a label."""
_MIDDLE = (
    "e.scrollIntoView({block: 'center'}); const r = e.getBoundingClientRect(); "
    "return [r.x + r.width / 2, r.y + r.height / 2];"
)
"""Returns the middle of an element."""


def find_chromium() -> str | None:
    """Its path; None where there is none."""
    return next((path for name in _NAMES if (path := shutil.which(name))), None)


class Page:
    """One tab."""

    def __init__(self, address: str) -> None:
        self._socket = connect(address, max_size=None, open_timeout=_START_S)
        self._numbers = itertools.count(1)
        self.errors: list[str] = []
        """What the page's scripts threw."""
        self.call("Page.enable")
        self.call("Runtime.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol, and its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=_ANSWER_S))
            if answer.get("method") == "Runtime.exceptionThrown":
                details = answer["params"]["exceptionDetails"]
                self.errors.append(details.get("exception", {}).get("description", details["text"]))
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def open(self, url: str) -> None:
        """Load a page."""
        self.call("Page.navigate", url=url)

    def run(self, script: str) -> Any:
        """Value of an expression."""
        result = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def text(self) -> str:
        """All that can be read on the page."""
        return self.run("document.body ? document.body.innerText : ''")

    def wait_for(self, script: str, what: str, timeout: float = 60.0) -> Any:
        """Value of an expression once it is true."""
        deadline = time.monotonic() + timeout
        while not (value := self.run(script)):
            assert time.monotonic() < deadline, (
                f"not within {timeout:.0f} s: {what}; the page says: {self.text()[:2000]}"
            )
            time.sleep(0.1)
        return value

    def wait_for_text(self, text: str, timeout: float = 60.0) -> None:
        """Wait until the page shows a text."""
        self.wait_for(f"document.body && document.body.innerText.includes({json.dumps(text)})", text, timeout)

    def click(self, text: str, selector: str = "button") -> None:
        """Click the first visible element with exactly this text, as a hand would."""
        find = (
            f"[...document.querySelectorAll({json.dumps(selector)})].find(e => e.innerText.trim() === "
            f"{json.dumps(text)} && e.getClientRects().length && !e.disabled)"
        )
        place = f"(() => {{ const e = {find}; if (!e) return null; {_MIDDLE} }})()"
        self.press(*self.wait_for(place, f"{selector} '{text}'"))

    def press(self, x: float, y: float) -> None:
        """Press and release the mouse, and let the page send what that changed."""
        for kind, buttons in (("mousePressed", 1), ("mouseReleased", 0)):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)
        self._settle()

    def fill(self, label: str, value: str) -> None:
        """Put a text into the first input next to a label, and leave it."""
        self.press(*self._input(label))
        self.run("document.activeElement.select()")
        self.call("Input.insertText", text=value)
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13)
        self._settle()

    def close_notes(self) -> None:
        """Close what viser says, about browsers without a graphics card for one: it lies over the page."""
        self.wait_for(
            "(() => { const found = [...document.querySelectorAll('.mantine-Notification-closeButton')]; "
            "found.forEach(e => e.click()); return !found.length; })()",
            "the notes are closed",
        )

    def value(self, label: str) -> str:
        """What the first input next to a label holds."""
        return self.wait_for(_FIND_INPUT.format(json.dumps(label), "return e.value;"), f"input '{label}'")

    def _input(self, label: str) -> tuple[float, float]:
        """Where the first input next to a label is."""
        return tuple(self.wait_for(_FIND_INPUT.format(json.dumps(label), _MIDDLE), f"input '{label}'"))

    def close(self) -> None:
        """Let go of the tab."""
        self._socket.close()

    def _settle(self) -> None:
        """Timers come in the order of their times: after this one the page's own has sent what it held back."""
        self.run(f"new Promise(done => setTimeout(done, {_THROTTLE_MS}))")


@contextmanager
def chromium(folder: Path) -> Iterator[Page]:
    """A browser whose files are kept in a folder; it draws without a graphics card."""
    path = find_chromium()
    assert path is not None
    home = folder / "chromium"
    home.mkdir()
    flags = "--headless=new --remote-debugging-port=0 --use-angle=swiftshader --enable-unsafe-swiftshader "
    flags += "--window-size=800,743 --no-first-run --disable-extensions --disable-background-networking "
    flags += "--disable-renderer-backgrounding --disable-backgrounding-occluded-windows "
    flags += "--disable-background-timer-throttling "
    flags += "--no-sandbox" * (os.geteuid() == 0)
    command = [path, *flags.split(), f"--user-data-dir={home}", "about:blank"]
    log, port_file = folder / "chromium.log", home / "DevToolsActivePort"
    with running(command, {**os.environ, "HOME": str(home)}, log) as process:
        wait_for(lambda: process.poll() is not None or "\n" in _text(port_file), _START_S, "chromium is up")
        assert process.poll() is None, log.read_text()
        port = _text(port_file).split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10) as response:
            tabs = json.load(response)
        page = Page(next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page"))
        try:
            yield page
        finally:
            page.close()


def _text(file: Path) -> str:
    return file.read_text() if file.exists() else ""
