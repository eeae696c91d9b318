"""The page: scene, banner with the safety state, buttons and tabs."""

from __future__ import annotations

import asyncio
import html
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import viser

from contact_reach_ros.arm import Arm, Array, link_frames
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.safety_state import ERROR, OK, WARN
from contact_reach_ros.observer.budget import ContactBudget
from contact_reach_ros.palette import GREEN, GREY, ORANGE, VERMILION, as_bytes
from contact_reach_ros.viewer.arm import share_gradient
from contact_reach_ros.viewer.frame import Frame, LiveState
from contact_reach_ros.viewer.playback import BagTab, Player
from contact_reach_ros.viewer.plots import Plots
from contact_reach_ros.viewer.scene import SceneView
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.goal import Goal

_SLOW_PERIOD = 0.2
"""Time between updates of plots, timeline and the goal's reach, s."""
_SILENCE = 2.0
"""Time without a joint state after which the banner reports it, s."""
_BANNER = {
    OK: (GREEN, "#FFFFFF"),
    WARN: (ORANGE, "#000000"),
    ERROR: (VERMILION, "#FFFFFF"),
}
"""Background and text colours of the banner by level."""
_SILENT = (GREY, "#FFFFFF")
_OVER = (
    "position:fixed;left:10px;top:10px;z-index:1000;pointer-events:none;display:flex;flex-direction:column;gap:8px;"
    "align-items:flex-start;max-width:min(620px,calc(100vw - 20px))"
)
_NOTES_BELOW = "<style>.mantine-Notifications-root{top:auto!important;bottom:16px!important}</style>"
"""Moves viser's own notes, such as one about the graphics card, out of the banner's corner."""
_CONTROLLER = "controller"

_MOVED = 0.02
"""Joint motion after which the reach of an unchanged goal is checked again, rad."""


class Actions(Protocol):
    """Actions on the running stack. All may take seconds; they return their outcome as a line for the page."""

    def send_goal(self, position: Array) -> str:
        """Command a flange position (3,), m."""

    def stop(self) -> str:
        """Stop the arm."""

    def reset(self) -> str:
        """Release all stops."""


class _GoalTab:
    """A goal in the scene, green where the arm can reach it, and the button that sends it."""

    def __init__(self, server: viser.ViserServer, arm: Arm, actions: Actions, say: Callable[[str], None]) -> None:
        self._arm = arm
        self._checked: tuple[Array, Array] | None = None
        self._position = np.zeros(3)
        gui = server.gui
        gui.add_markdown("Drag the arrows in the scene, or type. Nothing moves before you send it.")
        self._field: Any = gui.add_vector3(
            "Goal (m)", (0.0, 0.0, 0.0), step=0.001, hint=f"flange position in {arm.base_frame}: x, y, z"
        )
        self._reach_text = gui.add_markdown("")
        self._send = gui.add_button("Send goal", color="blue", icon=viser.Icon.SEND)
        around = [(middle - arm.reach - 0.15, middle + arm.reach + 0.15) for middle in arm.shoulder]
        self._arrows = server.scene.add_transform_controls(
            "/new_goal",
            scale=0.18,
            disable_rotations=True,
            disable_sliders=True,
            translation_limits=(around[0], around[1], around[2]),
            depth_test=False,
            visible=False,
        )
        self._ball = server.scene.add_icosphere("/new_goal/ball", radius=0.02, color=as_bytes(GREEN))

        @self._arrows.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._position = np.array(event.target.position, float)
            self._field.value = tuple(np.round(self._position, 4).tolist())

        @self._field.on_update
        async def _(event: viser.GuiEvent[Any]) -> None:
            if event.client_id is not None:
                self._position = np.array(event.target.value, float)
                self._arrows.position = self._position

        @self._send.on_click
        async def _(_: Any) -> None:
            say(await asyncio.to_thread(actions.send_goal, self._position.copy()))

    def show(self, frame: Frame | None) -> None:
        """Show whether the arm, whose present moment is `frame`, reaches the goal; None hides the goal."""
        self._arrows.visible = frame is not None
        self._send.disabled = frame is None
        if frame is None:
            return
        if self._checked is None:
            self._position = np.round(link_frames(self._arm, frame.q)[1][-1], 3)
            self._arrows.position = self._position
            self._field.value = tuple(self._position.tolist())
        elif np.array_equal(self._checked[0], self._position) and np.abs(frame.q - self._checked[1]).max() < _MOVED:
            return
        self._checked = self._position.copy(), frame.q.copy()
        refusal = self._refusal(frame)
        self._ball.color = as_bytes(VERMILION if refusal else GREEN)
        self._reach_text.content = f"✘ will be refused: {refusal}" if refusal else "✔ reachable"

    def _refusal(self, frame: Frame) -> str:
        """Why the planner would refuse the goal in the present orientation; empty if it would not."""
        environment = () if frame.obstacles is None else frame.obstacles.environment
        try:
            target = Goal(self._position).resolve(self._arm, link_frames(self._arm, frame.q)[0][-1])
            check_goal(self._arm, target, environment, frame.q)
        except InputError as error:
            return str(error)
        return ""


class Page:
    """The page on a server, of a running stack or of a bag.

    Call its methods in the server's own thread (`access.call`), since viser's buffers are not safe in others. Slow
    actions run in threads of their own.

    Parameters
    ----------
    server
        Server of the page.
    arm
        The arm to show.
    budget
        Permitted contact force and torque thresholds.
    live, actions
        State of the running stack, and actions on it.
    player
        Player of the bag to show; None for the running stack.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        arm: Arm,
        budget: ContactBudget,
        live: LiveState,
        actions: Actions,
        player: Player | None = None,
    ) -> None:
        self._server = server
        self._live = live
        self._player = player
        self._slow_due = 0.0
        self._last = 0.0
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        server.scene.configure_default_lights(cast_shadow=True)
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(360)
        self._scene = SceneView(server, arm, budget.torque_thresholds, budget.permitted_force)
        self._banner = _Banner(server, budget.torque_thresholds)
        if player is None:
            self._add_stop(actions)
        self._line = server.gui.add_html("")
        group = server.gui.add_tab_group()
        # The first one is shown.
        with group.add_tab("Goal" if player is None else "Bag"):
            self._tab = _GoalTab(server, arm, actions, self.say) if player is None else BagTab(server, player)
        with group.add_tab("Plots"):
            self._plots = Plots(server, arm.joint_names, budget.permitted_force)

    def turn(self, clock: float) -> None:
        """Update the page once; call it at the update rate. `clock` is a steady clock, s."""
        passed, self._last = clock - self._last, clock
        live, player = self._live, self._player
        frame = live.frame() if player is None else player.frame(passed)
        if not self._server.get_clients():
            return
        if player is None:
            self._banner.show("live", frame, live.silence(clock))
        else:
            self._banner.show(f"bag {player.recording.path.name}, {player.time:.3f} s", frame, None)
        if frame is not None:
            self._scene.show(frame)
        if clock >= self._slow_due:
            self._slow_due = clock + _SLOW_PERIOD
            self._tab.show(frame)
            self._plots.show(live.history.table() if player is None else player.recording.table(player.time))

    def say(self, text: str) -> None:
        """Show a line to all users."""
        self._line.content = f'<div style="padding:0 10px 6px;font-size:13px">{html.escape(text)}</div>'

    def _add_stop(self, actions: Actions) -> None:
        gui = self._server.gui
        stop = gui.add_button("Stop", color="red", icon=viser.Icon.HAND_STOP, hint="compliant stop of the arm")
        reset = gui.add_button("Reset", color="gray", icon=viser.Icon.REFRESH, hint="release the stop of the arm")

        @stop.on_click
        async def _(_: Any) -> None:
            self.say(await asyncio.to_thread(actions.stop))

        @reset.on_click
        async def _(_: Any) -> None:
            self.say(await asyncio.to_thread(actions.reset))


def _banner_text(frame: Frame | None, silence: float | None) -> tuple[int | None, str, str]:
    """Level, headline and details of a moment; the level is None if it is unknown.

    Parameters
    ----------
    frame
        The moment to describe; None before the first joint state.
    silence
        Time without a joint state, s; None for a recording.
    """
    if silence is not None and (silence >= _SILENCE or frame is None):
        more = "the stack is not running, or starting" if frame is None else "the picture is out of date"
        return None, f"no joint_states for {silence:.0f} s", more
    assert frame is not None
    stops = [f"{name}: {status.message}" for name, status in frame.safety.items() if status.is_stop]
    if stops:
        return ERROR, "STOPPED", "; ".join(stops)
    touched = [status for status in frame.safety.values() if status.level == WARN]
    if touched:
        contact = touched[0].contact
        return WARN, "contact", "" if contact is None else f"at {contact.link}"
    controller = frame.safety.get(_CONTROLLER)
    return (OK, controller.message, "") if controller is not None else (None, "no controller", "")


class _Banner:
    """Banner and legend in the upper left corner of the window."""

    def __init__(self, server: viser.ViserServer, thresholds: tuple[float, ...]) -> None:
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
        level, headline, more = _banner_text(frame, silence)
        ground, ink = _SILENT if level is None else _BANNER[level]
        self._handle.content = (
            f'{_NOTES_BELOW}<div style="{_OVER}"><div id="safety" style="background:{ground};color:{ink};'
            'border-radius:8px;padding:8px 16px;line-height:1.3">'
            f'<div style="font-size:13px">{html.escape(source)}</div>'
            f'<div style="font-size:26px;font-weight:700">{html.escape(headline)}</div>'
            f'<div style="font-size:15px">{html.escape(more)}</div></div>{self._legend}</div>'
        )
