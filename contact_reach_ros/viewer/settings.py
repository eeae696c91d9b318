"""Settings of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

from contact_reach_ros.settings import Sections, Settings, setting

ADDRESS = "127.0.0.1"
"""The only address that serves the page; SSH can forward it to other machines."""
MAX_RATE = 30.0
"""Greatest update rate of the page, Hz: more than the eye follows costs the browser and this machine their time."""


@dataclass(frozen=True)
class ViewerSettings(Settings):
    """Port and contents of the page."""

    port: int = setting(8080, "port of 127.0.0.1 to listen on; 0 takes a free one", minimum=0, maximum=65535)
    bag: str = setting("", "bag to show instead of the running stack")


VIEWER_SECTIONS: Sections = {"": ViewerSettings}
"""Settings of the viewer by parameter prefix."""


def page_address(port: int) -> str:
    """URL of the page for browsers on this machine."""
    return f"http://{ADDRESS}:{port}"
