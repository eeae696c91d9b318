"""The goal tab: a new goal for the running arm."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import viser

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.arm.inverse_kinematics import is_attainable, unreachable
from contact_reach_ros.arm.kinematics import link_frames
from contact_reach_ros.palette import GREEN, VERMILION, as_bytes
from contact_reach_ros.viewer.frame import Frame

_REACH_PERIOD = 0.15
"""Time between runs of inverse kinematics, s."""
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


class GoalTab:
    """A goal in the scene, green where the arm can reach it, and the button that sends it."""

    def __init__(self, server: viser.ViserServer, arm: Arm, actions: Actions, say: Callable[[str], None]) -> None:
        self._arm = arm
        self._due = 0.0
        self._checked: tuple[Array, Array] | None = None
        self._position = np.zeros(3)
        gui = server.gui
        gui.add_markdown("Drag the arrows in the scene, or type. Nothing moves before you send it.")
        self._field: Any = gui.add_vector3(
            "Goal (m)", (0.0, 0.0, 0.0), step=0.001, hint=f"flange position in {arm.base_frame}: x, y, z"
        )
        self._reach_text = gui.add_markdown("")
        self._send = gui.add_button("Send goal", color="blue", icon=viser.Icon.SEND)
        size = arm.reach + 0.15
        self._arrows = server.scene.add_transform_controls(
            "/new_goal",
            scale=0.18,
            disable_rotations=True,
            disable_sliders=True,
            translation_limits=((-size, size), (-size, size), (0.0, size + arm.shoulder[2])),
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

    def show(self, frame: Frame | None, clock: float) -> None:
        """Show whether the running arm, whose present moment is `frame`, reaches the goal; None hides the goal.

        `clock` is a steady clock, s.
        """
        self._arrows.visible = frame is not None
        self._send.disabled = frame is None
        if frame is None or clock < self._due:
            return
        if self._checked is None:
            self._position = np.round(link_frames(self._arm, frame.q)[1][-1], 3)
            self._arrows.position = self._position
            self._field.value = tuple(self._position.tolist())
        elif np.array_equal(self._checked[0], self._position) and np.abs(frame.q - self._checked[1]).max() < _MOVED:
            return
        self._due = clock + _REACH_PERIOD
        self._checked = self._position.copy(), frame.q.copy()
        reachable, text = reach(self._arm, self._position, frame.q)
        self._ball.color = as_bytes(GREEN if reachable else VERMILION)
        self._reach_text.content = f"{'✔' if reachable else '✘'} {text}"


def reach(arm: Arm, position: Array, q: Array) -> tuple[bool, str]:
    """Whether some posture has the flange at `position` (3,), m, and an explanation; `q` (n,), rad, is the present one.

    By the planner's rule, except for rigid bodies. Other obstacles do not count: the arm may touch them.
    """
    refused = unreachable(arm, position)
    if refused:
        return False, f"will be refused: the position {refused}"
    rotations, origins = link_frames(arm, q)
    away = float(np.linalg.norm(position - origins[-1]))
    if is_attainable(arm, position, rotations[-1], q):
        return True, f"reachable, {away:.2f} m away"
    if is_attainable(arm, position, None, q):
        return False, f"{away:.2f} m away, reachable only with `goal_orientation: free`, not in this orientation"
    return False, "will be refused: the joint limits are in the way"
