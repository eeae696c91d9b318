"""Access to the page, since it can move a robot: only browsers on this machine, or connected through SSH.

Any other page in such a browser could send requests to this server, too. viser has no hook for checking requests, so
the one public function of websockets that viser uses to serve is wrapped while viser starts.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import io
import socket
from collections.abc import Callable, Iterator
from typing import Any, TypeVar
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.http11 import Request

from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.viewer.settings import ADDRESS

T = TypeVar("T")

_LOOPBACK_NAMES = ("localhost", ADDRESS, "::1")


class _Server(viser.ViserServer):
    """A server without public addresses, which viser offers to every visitor without an option against it."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse."""


def serve(port: int, label: str) -> viser.ViserServer:
    """Start a viser server that only answers browsers on this machine, and no requests from pages of other servers.

    Parameters
    ----------
    port
        Port of `ADDRESS`; 0 takes a free one, which `get_port` returns.
    label
        Title of the page.

    Raises
    ------
    SettingsError
        If the port is not available.
    ContactReachError
        If this version of viser would answer everybody.
    """
    try:
        # viser would take the next free port, where nobody would look for the page.
        listener = socket.create_server((ADDRESS, port))
    except OSError as error:
        raise SettingsError(
            f"port = {port}: {error.strerror}; is another viewer running? Choose another port"
        ) from error
    with listener, _guarded(listener) as used, contextlib.redirect_stdout(io.StringIO()):
        server = _Server(host=ADDRESS, port=listener.getsockname()[1], label=label, verbose=False)
        if not used:
            server.stop()
            raise ContactReachError(
                f"viser {viser.__version__} cannot be guarded: it does not serve with websockets.asyncio.server.serve; "
                "install another version"
            )
        return server


def call(server: viser.ViserServer, function: Callable[[], T]) -> T:
    """Call a function in the server's own thread, wait for it, and return its result."""

    async def run() -> T:
        return function()

    return asyncio.run_coroutine_threadsafe(run(), server.get_event_loop()).result()


def _refusal(request: Request) -> str:
    """Why a request is refused; empty to let it pass."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    host = hosts[0] if len(hosts) == 1 else ""
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        name = None
    if name not in _LOOPBACK_NAMES:
        # The name of another server can be made to point here, and its pages would then have the same origin.
        return "open this page as localhost or 127.0.0.1"
    if any(urlsplit(origin).netloc != host for origin in origins):
        return "requests from other pages are refused"
    return ""


@contextlib.contextmanager
def _guarded(listener: socket.socket) -> Iterator[list[bool]]:
    """Make a server that viser starts within it use this socket and refuse requests; the list is empty if none did."""
    used: list[bool] = []
    original: Callable[..., Any] = websockets.asyncio.server.serve

    def guarded(handler: Any, host: str, port: int, **options: Any) -> Any:
        answer = options["process_request"]

        def process(connection: Any, request: Request) -> Any:
            reason = _refusal(request)
            if reason:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            return answer(connection, request)

        used.append(True)
        return original(handler, sock=listener.dup(), **{**options, "process_request": process})

    websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
    try:
        yield used
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[assignment,misc]
