"""Who gets in: page and websocket, with a real HTTP and websocket client."""

import http.client
import queue
import socket

import msgspec
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.viewer.access import serve


@pytest.fixture(scope="module")
def server():
    server = serve(0, "test")
    yield server
    server.stop()


@pytest.fixture(scope="module")
def port(server):
    return server.get_port()


def get(port, path="/", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read()


def websocket(port, host="", **headers):
    """The websocket as a page opens it that has come from a host."""
    uri = f"ws://{host or f'127.0.0.1:{port}'}"
    protocols = [f"viser-v{viser.__version__}"]
    way = socket.create_connection(("127.0.0.1", port))
    return connect(uri, sock=way, additional_headers=headers, subprotocols=protocols, max_size=None)


@pytest.mark.parametrize("host", ["127.0.0.1:{port}", "localhost:9000"])
def test_browsers_of_this_machine_get_page_and_websocket(port, host):
    """By a port of another number, too, as SSH may forward it."""
    host = host.format(port=port)
    status, body = get(port, Host=host)
    assert status == 200 and b"<html" in body.lower()
    with websocket(port, host, Origin=f"http://{host}") as page:
        assert page.recv(timeout=10)


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("", "http://elsewhere.example"),
        ("", "http://localhost:1"),
        ("", "null"),
        ("elsewhere.example", "http://elsewhere.example"),
        ("127.0.0.1.elsewhere.example", "http://127.0.0.1.elsewhere.example"),
    ],
)
def test_other_pages_and_names_that_point_at_this_machine_are_kept_out(port, host, origin):
    status, body = get(port, Host=host or f"127.0.0.1:{port}", Origin=origin)
    assert status == 403 and b"<html" not in body.lower()
    with pytest.raises(InvalidStatus) as refusal:
        websocket(port, host, Origin=origin)
    assert refusal.value.response.status_code == 403


def test_other_machines_do_not_reach_it(port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outwards:
        # Sends nothing: the address that this machine would send from.
        try:
            outwards.connect(("192.0.2.1", 9))
        except OSError:
            pytest.skip("this machine has no address but its own")
        address = outwards.getsockname()[0]
    with pytest.raises(OSError):
        socket.create_connection((address, port), timeout=5)


def test_no_visitor_gets_a_public_address(server, port, monkeypatch):
    def answer(*arguments):
        answers.put(original(*arguments))

    answers, tunnels = queue.SimpleQueue(), []
    monkeypatch.setattr(viser.ViserServer, "request_share_url", lambda *_: tunnels.append("a public address"))
    original = type(server).request_share_url
    monkeypatch.setattr(type(server), "request_share_url", answer)
    with websocket(port) as page:
        page.send(msgspec.msgpack.encode({"type": "ShareUrlRequest"}))
        assert answers.get(timeout=10) is None
    assert not tunnels


def test_a_port_in_use_is_refused(port):
    with pytest.raises(SettingsError, match=f"port = {port}.*Choose another port"):
        serve(port, "test")


def test_a_server_that_cannot_be_guarded_is_not_served(monkeypatch):
    """As with a viser that serves in another way."""
    stopped = []
    monkeypatch.setattr(viser.ViserServer, "__init__", lambda *_, **options: None)
    monkeypatch.setattr(viser.ViserServer, "stop", lambda server: stopped.append(server))
    with pytest.raises(ContactReachError, match="cannot be guarded"):
        serve(0, "test")
    assert stopped
