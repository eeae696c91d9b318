"""The three-dimensional part of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.messages.plan_reader import PlanPicture
from contact_reach_ros.palette import BLUE, ORANGE, SKY_BLUE, as_bytes
from contact_reach_ros.viewer.arm import ArmView
from contact_reach_ros.viewer.contacts import ContactView
from contact_reach_ros.viewer.frame import Frame
from contact_reach_ros.viewer.obstacles import ObstacleView


class SceneView:
    """Arm, obstacles, plan, contacts and goal of a frame.

    Parameters
    ----------
    server
        Server of the page.
    arm
        Arm to show.
    thresholds
        (n,) external torque at which a link has the colour of a stop, Nm.
    permitted_force
        Force above which an arrow has the colour of a stop, N.
    """

    def __init__(
        self, server: viser.ViserServer, arm: Arm, thresholds: Sequence[float], permitted_force: float
    ) -> None:
        self._server = server
        self._thresholds = np.array(thresholds)
        self._arm = ArmView(server, arm)
        self._obstacles = ObstacleView(server)
        self._plan = _PlanView(server)
        self._contacts = ContactView(server, arm, permitted_force)
        scene = server.scene
        scene.add_grid(
            "/floor", width=3.0, height=3.0, cell_size=0.1, section_size=0.5, plane="xy", shadow_opacity=0.15
        )
        scene.world_axes.visible = False
        server.initial_camera.position = (1.2, -1.25, 0.95)
        server.initial_camera.look_at = (0.25, 0.0, 0.35)
        self._goal = scene.add_icosphere("/goal", radius=0.025, color=as_bytes(SKY_BLUE))
        self._goal.visible = False

    def show(self, frame: Frame) -> None:
        """Show a moment; hide what is unknown."""
        with self._server.atomic():
            self._arm.move(frame.q)
            torque = np.zeros(len(self._thresholds)) if frame.external_torque is None else frame.external_torque
            self._arm.colour(np.abs(np.nan_to_num(torque)) / self._thresholds)
            self._obstacles.show(frame.obstacles)
            self._plan.show(frame.plan)
            self._contacts.show(frame)
            self._goal.visible = frame.goal is not None
            if frame.goal is not None:
                self._goal.position = frame.goal


class _PlanView:
    """Paths of flange and elbow."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._shown: PlanPicture | None = None
        self._lines: list[Any] = []

    def show(self, plan: PlanPicture | None) -> None:
        """Show a plan; None hides it."""
        if plan is self._shown:
            return
        self._shown = plan
        for line in self._lines:
            line.remove()
        self._lines = []
        if plan is not None:
            self._add("flange", BLUE, plan.flange)
            self._add("elbow", ORANGE, plan.elbow)

    def _add(self, name: str, colour: str, points: Array) -> None:
        if len(points) > 1:
            segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
            self._lines.append(
                self._server.scene.add_line_segments(f"/plan/{name}", segments, as_bytes(colour), thickness=0.006)
            )
