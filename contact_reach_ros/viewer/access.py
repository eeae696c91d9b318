"""Who may open the page: it can move a robot.

viser answers everyone who reaches its port. Here every request, be it for the page or for its websocket, passes a guard
first. On this machine's own address it asks for nothing but that the request comes from a page of this server, since
any other page in the same browser could send one too. On another address it asks for a token.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import http
import io
import logging
import re
import socket
import threading
from collections.abc import Callable, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Any, TypeVar
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from viser import _messages as viser_messages
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.viewer.settings import is_loopback

T = TypeVar("T")

TOKEN_LENGTH = 16
"""Least number of characters of a token."""

_COOKIE = "contact_reach_viewer"
_TOKEN = re.compile(r"[A-Za-z0-9_-]+")
_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")

_patching = threading.Lock()

_QUIET = logging.getLogger(__name__)
"""For the server, which has a traceback for each connection that somebody opens and closes without a word."""
_QUIET.setLevel(logging.CRITICAL)


def check_access(address: str, token: str) -> None:
    """Refuse to serve others without a token.

    Raises
    ------
    SettingsError
        If the address is not this machine's own and the token missing, or the token is too short or no word.
    """
    make_one = "make one with: python3 -c 'import secrets; print(secrets.token_urlsafe(24))'"
    if token and not (len(token) >= TOKEN_LENGTH and _TOKEN.fullmatch(token)):
        raise SettingsError(
            f"token: expected at least {TOKEN_LENGTH} letters, digits, '-' and '_', got {len(token)} characters; "
            f"{make_one}"
        )
    if not token and not is_loopback(address):
        raise SettingsError(
            f"address = '{address}': others can reach it and move the robot; expected a token with it, or 127.0.0.1 "
            f"(and 'ssh -L' to look from elsewhere); {make_one}"
        )


class Guard:
    """Decides on each request before viser sees it.

    Parameters
    ----------
    token
        That whoever asks must know; empty for none.
    """

    def __init__(self, token: str) -> None:
        self._token = token
        self.port = 0

    def check(self, request: Request) -> Response | None:
        """None to let the request through, else what it gets."""
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        host = hosts[0] if len(hosts) == 1 else ""
        if not self._token and _name(host) not in _LOOPBACK_NAMES:
            # Without a token, a name that some other server has pointed at this machine must not open the page.
            return _refuse(http.HTTPStatus.FORBIDDEN, "open this page as localhost or 127.0.0.1")
        if any(urlsplit(origin).netloc != host for origin in origins):
            return _refuse(http.HTTPStatus.FORBIDDEN, "requests from other pages are refused")
        if not self._token or self._has_cookie(headers):
            return None
        given = parse_qs(urlsplit(request.path).query).get("token", [])
        if "Upgrade" not in headers and len(given) == 1 and self._is_token(given[0]):
            # The token moves from the address, which is shown and kept, into a cookie.
            answer = Headers()
            answer["Location"] = "/"
            answer["Set-Cookie"] = f"{self._cookie}={self._token}; Path=/; HttpOnly; SameSite=Lax"
            answer["Content-Length"] = "0"
            return Response(http.HTTPStatus.SEE_OTHER, "See Other", answer, b"")
        return _refuse(
            http.HTTPStatus.UNAUTHORIZED, "this page needs its token: open it as http://<address>:<port>/?token=<token>"
        )

    @property
    def _cookie(self) -> str:
        # Cookies are shared by all ports of a host.
        return f"{_COOKIE}_{self.port}"

    def _has_cookie(self, headers: Headers) -> bool:
        for line in headers.get_all("Cookie"):
            try:
                morsel = SimpleCookie(line).get(self._cookie)
            except CookieError:
                continue
            if morsel is not None and self._is_token(morsel.value):
                return True
        return False

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), self._token.encode())


def serve(address: str, port: int, token: str, label: str) -> viser.ViserServer:
    """A viser server behind a guard.

    Parameters
    ----------
    address, port
        Where to listen; port 0 takes a free one, which `get_port` tells.
    token
        That the page asks for; empty for none.
    label
        Title of the page.

    Raises
    ------
    SettingsError
        As `check_access`, or if the port cannot be had.
    """
    check_access(address, token)
    # viser would take the next free port, which nobody would look at, and try for ever on a wrong address.
    with contextlib.closing(_listen(address, port)) as probe:
        port = probe.getsockname()[1]
    guard = Guard(token)
    guard.port = port
    with _guarded(guard) as used, contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=address, port=port, label=label, verbose=False)
    if not used or server.get_port() != port:
        server.stop()
        raise SettingsError(f"port = {port} at '{address}': could not be taken; choose another port")
    # Any visitor could ask for a public address on the internet.
    server._websock_server.unregister_handler(viser_messages.ShareUrlRequest)
    return server


def call(server: viser.ViserServer, function: Callable[[], T]) -> T:
    """Call a function in the server's own thread, wait for it, and return what it does."""

    async def run() -> T:
        return function()

    return asyncio.run_coroutine_threadsafe(run(), server.get_event_loop()).result()


def _listen(address: str, port: int) -> socket.socket:
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(
            address, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        found = socket.socket(family, kind, protocol)
    except OSError as error:
        raise SettingsError(f"address = '{address}': {error.strerror}; expected an address of this machine") from error
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind(place)
    except OSError as error:
        found.close()
        raise SettingsError(
            f"port = {port} at '{address}': {error.strerror}; is another viewer running? Choose another port"
        ) from error
    return found


@contextlib.contextmanager
def _guarded(guard: Guard) -> Iterator[list[bool]]:
    """Within it, the server that viser starts asks the guard first; the list is empty if it did not come to that."""
    used: list[bool] = []
    original: Callable[..., Any] = websockets.asyncio.server.serve

    def guarded(*arguments: Any, **options: Any) -> Any:
        answer = options["process_request"]

        def process(connection: Any, request: Request) -> Response | None:
            return guard.check(request) or answer(connection, request)

        used.append(True)
        return original(*arguments, **{**options, "process_request": process, "logger": _QUIET})

    # viser has no option for it.
    with _patching:
        websockets.asyncio.server.serve = guarded  # type: ignore[assignment,misc]
        try:
            yield used
        finally:
            websockets.asyncio.server.serve = original  # type: ignore[assignment,misc]


def _refuse(status: http.HTTPStatus, reason: str) -> Response:
    body = f"{reason}\n".encode()
    headers = Headers()
    headers["Content-Type"] = "text/plain; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    return Response(status, status.phrase, headers, body)


def _name(host: str) -> str:
    """Name in a Host header, without its port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
