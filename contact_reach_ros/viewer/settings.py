"""Settings of the viewer."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass

from contact_reach_ros.settings import Settings, setting

MAX_RATE = 30.0
"""Of the page's updates, Hz."""


@dataclass(frozen=True)
class ViewerSettings(Settings):
    """Where the page is served, and what it offers."""

    address: str = setting("127.0.0.1", "address to listen on; one that others reach, such as 0.0.0.0, needs a token")
    port: int = setting(8080, "port to listen on; 0 takes a free one", minimum=0, maximum=65535)
    token: str = setting("", "what a browser has to know to see or do anything: 16 characters or more; none when empty")
    rate: float = setting(MAX_RATE, "updates of the page, at most", unit="Hz", minimum=1.0, maximum=MAX_RATE)
    bags: str = setting("bags", "folder whose bags the page offers")
    bag: str = setting("", "bag to show at the start instead of the running stack")
    dark: bool = setting(False, "dark page instead of a light one")
    shadows: bool = setting(True, "draw shadows; false is easier on browsers without a graphics card")
    contact_budget: str = setting("", "contact budget YAML; the one of the package when empty")

    def page_address(self, port: int) -> str:
        """What to open in a browser, the token left out."""
        host = self.address if is_loopback(self.address) else "<this machine>"
        return f"http://{host}:{port}{'/?token=<token>' if self.token else ''}"


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False
