"""Banner over the scene: the safety state in large letters, and a legend for the arm's colours."""

from __future__ import annotations

import html

import viser

from contact_reach_ros.viewer.colours import BANNER, SILENT, share_gradient
from contact_reach_ros.viewer.frame import Frame, SafetyLevel
from contact_reach_ros.viewer.live import SILENCE

_OVER = (
    "position:fixed;left:10px;top:10px;z-index:1000;pointer-events:none;display:flex;flex-direction:column;gap:8px;"
    "align-items:flex-start;max-width:min(620px,calc(100vw - 20px))"
)
_NOTES_BELOW = "<style>.mantine-Notifications-root{top:auto!important;bottom:16px!important}</style>"
"""viser's own notes, such as one about the graphics card, come up in the same corner as the banner."""
_CONTROLLER = "controller"


def banner_text(frame: Frame | None, silence: float | None) -> tuple[SafetyLevel | None, str, str]:
    """Level, headline and details of a moment; the level is None if it is unknown.

    Parameters
    ----------
    frame
        The moment to describe; None before the first joint state.
    silence
        Time without a joint state, s; None for a recording.
    """
    if silence is not None and (silence >= SILENCE or frame is None):
        more = "the stack is not running, or starting" if frame is None else "the picture is out of date"
        return None, f"no joint_states for {silence:.0f} s", more
    assert frame is not None
    stops = frame.stops()
    if stops:
        return SafetyLevel.STOP, "STOPPED", "; ".join(f"{name}: {reason}" for name, reason in stops.items())
    touched = [status for status in frame.safety.values() if status.level is SafetyLevel.CONTACT]
    if touched:
        contact = touched[0].contact
        return SafetyLevel.CONTACT, "contact", "" if contact is None else f"at {contact.link}"
    controller = frame.safety.get(_CONTROLLER)
    return (SafetyLevel.OK, controller.message, "") if controller is not None else (None, "no controller", "")


class Banner:
    """Banner and legend in the upper left corner of the window."""

    def __init__(self, server: viser.ViserServer, thresholds: tuple[float, ...]) -> None:
        self._shown = ""
        self._handle = server.gui.add_html("")
        self._legend = (
            '<div style="width:230px;padding:6px 10px;border-radius:6px;font-size:12px;line-height:1.4;'
            'background:rgba(255,255,255,0.85);color:#222222">Links: external torque as a share of what stops the arm '
            f"({min(thresholds):g} to {max(thresholds):g} Nm)"
            f'<div style="height:10px;border-radius:3px;margin-top:3px;background:{share_gradient()}"></div>'
            '<div style="display:flex;justify-content:space-between"><span>0 %</span><span>50 %</span>'
            "<span>100 %</span></div></div>"
        )

    def show(self, source: str, frame: Frame | None, silence: float | None) -> None:
        """Show the safety state of a moment; `source` is a line above it."""
        level, headline, more = banner_text(frame, silence)
        ground, ink = SILENT if level is None else BANNER[level]
        content = (
            f'{_NOTES_BELOW}<div style="{_OVER}"><div id="safety" style="background:{ground};color:{ink};'
            'border-radius:8px;padding:8px 16px;line-height:1.3">'
            f'<div style="font-size:13px">{html.escape(source)}</div>'
            f'<div style="font-size:26px;font-weight:700">{html.escape(headline)}</div>'
            f'<div style="font-size:15px">{html.escape(more)}</div></div>{self._legend}</div>'
        )
        if content != self._shown:
            self._shown = content
            self._handle.content = content
