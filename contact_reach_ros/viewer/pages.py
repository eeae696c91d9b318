"""Load on a viewer, as from browsers: pages that receive everything and draw nothing.

viser has no public client, so its camera message comes from a private module.
"""

from __future__ import annotations

import sys
import threading
import urllib.parse

import msgspec
import viser
from viser import _messages as viser_messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

_SUBPROTOCOL = Subprotocol(f"viser-v{viser.__version__}")

_CAMERA = viser_messages.ViewerCameraMessage(
    wxyz=(1.0, 0.0, 0.0, 0.0),
    position=(2.0, 2.0, 1.0),
    fov=1.0,
    near=0.01,
    far=100.0,
    image_height=800,
    image_width=1280,
    look_at=(0.0, 0.0, 0.0),
    up_direction=(0.0, 0.0, 1.0),
)
"""The first message of a page, which makes it a client."""


def receive(address: str) -> None:
    """Receive as one page of the viewer at an address, until the viewer closes the connection."""
    place = urllib.parse.urlsplit(address)
    with connect(f"ws://{place.netloc}", subprotocols=[_SUBPROTOCOL], max_size=None, proxy=None) as page:
        page.send(msgspec.msgpack.encode(_CAMERA.as_serializable_dict()))
        try:
            while True:
                page.recv()
        except ConnectionClosed:
            pass


def main(address: str, count: str) -> None:
    """Receive as `count` pages."""
    pages = [threading.Thread(target=receive, args=(address,)) for _ in range(int(count))]
    for page in pages:
        page.start()
    for page in pages:
        page.join()


if __name__ == "__main__":
    main(*sys.argv[1:])
