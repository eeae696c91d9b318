"""Who gets in: page and websocket, with a real HTTP and websocket client."""

import http.client

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.viewer.access import serve

TOKEN = "a-token-of-20-letters"


@pytest.fixture(scope="module")
def guarded():
    server = serve("0.0.0.0", 0, TOKEN, "test")
    yield server.get_port()
    server.stop()


@pytest.fixture(scope="module")
def local():
    server = serve("127.0.0.1", 0, "", "test")
    yield server.get_port()
    server.stop()


def get(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.getheader("Set-Cookie"), answer.read()


def speak(port, **headers):
    """Open the websocket as the page does; returns the first message."""
    protocols = [f"viser-v{viser.__version__}"]
    options = {"additional_headers": headers, "subprotocols": protocols, "max_size": None}
    with connect(f"ws://127.0.0.1:{port}", **options) as socket:
        return socket.recv(timeout=10)


def test_with_the_token_page_and_websocket_open(guarded):
    status, cookie, _ = get(guarded, f"/?token={TOKEN}")
    assert status == 303 and "HttpOnly" in cookie
    pair = cookie.partition(";")[0]
    status, _, body = get(guarded, Cookie=pair)
    assert status == 200 and b"<html" in body.lower()
    assert speak(guarded, Cookie=pair)


@pytest.mark.parametrize("headers", [{}, {"Cookie": "x=y"}, {"Cookie": "contact_reach_viewer_{port}=wrong"}])
def test_without_the_token_neither_opens(guarded, headers):
    headers = {name: value.format(port=guarded) for name, value in headers.items()}
    for path in ("/", "/?token=", "/?token=wrong", "/index.html"):
        status, cookie, body = get(guarded, path, **headers)
        assert status == 401 and cookie is None and b"<html" not in body.lower()
    with pytest.raises(InvalidStatus) as refusal:
        speak(guarded, **headers)
    assert refusal.value.response.status_code == 401


def test_a_token_in_the_address_of_the_websocket_is_not_enough(guarded):
    with pytest.raises(InvalidStatus), connect(f"ws://127.0.0.1:{guarded}/?token={TOKEN}"):
        pass


def test_on_this_machine_no_token_is_needed(local):
    assert get(local)[0] == 200
    assert speak(local, Origin=f"http://127.0.0.1:{local}")


@pytest.mark.parametrize("headers", [{"Origin": "http://elsewhere.example"}, {"Host": "elsewhere.example"}])
def test_other_pages_in_the_same_browser_are_kept_out(local, headers):
    assert get(local, **headers)[0] == 403
    if "Origin" in headers:
        with pytest.raises(InvalidStatus):
            speak(local, **headers)


@pytest.mark.parametrize(
    ("address", "token", "what"),
    [("0.0.0.0", "", "token"), ("127.0.0.1", "short", "16"), ("127.0.0.1", "sixteen letters;", "16")],
)
def test_what_would_let_everybody_in_is_refused(address, token, what):
    with pytest.raises(SettingsError, match=what):
        serve(address, 0, token, "test")


def test_a_port_in_use_is_refused(local):
    with pytest.raises(SettingsError, match=f"port = {local}"):
        serve("127.0.0.1", local, "", "test")
