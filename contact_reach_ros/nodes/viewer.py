"""The viewer node: shows the stack's topics on a browser page, sends goals, stops and resets."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import InputError, SettingsError
from contact_reach_ros.messages import topics
from contact_reach_ros.messages.conversions import to_goal_pose
from contact_reach_ros.messages.obstacle_reader import ObstacleMarkerReader
from contact_reach_ros.messages.plan_reader import read_plan
from contact_reach_ros.messages.safety_state import read_state
from contact_reach_ros.messages.serialized import JointStateReader
from contact_reach_ros.messages.values import efforts, places_of
from contact_reach_ros.observer.budget import load_budget
from contact_reach_ros.observer.settings import OBSERVER_SECTIONS
from contact_reach_ros.resources import config_file
from contact_reach_ros.ros.client import NOTHING, Client
from contact_reach_ros.ros.inbox import LARGEST_SCENE
from contact_reach_ros.ros.interfaces import OBSERVER, VIEWER
from contact_reach_ros.ros.managed_node import ManagedNode
from contact_reach_ros.ros.parameters import settings_of
from contact_reach_ros.ros.process import in_namespace, run
from contact_reach_ros.settings import DEFAULT_PARAMETERS, as_arguments
from contact_reach_ros.viewer.access import call, serve
from contact_reach_ros.viewer.frame import LiveState
from contact_reach_ros.viewer.page import Page
from contact_reach_ros.viewer.playback import Player
from contact_reach_ros.viewer.recorded import Recording
from contact_reach_ros.viewer.settings import MAX_RATE, VIEWER_SECTIONS, ViewerSettings, page_address

TITLE = "contact_reach_ros"

_FEW = topics.Qos(20, reliable=False)


class ViewerNode(ManagedNode):
    """Keeps the page up to date, and does its `Actions` on the stack: in threads of the server, where they may wait."""

    NAME = VIEWER
    SECTIONS = VIEWER_SECTIONS

    def __init__(self) -> None:
        super().__init__()
        settings: ViewerSettings = self.settings[""]
        self._due = 0.0
        self.live = LiveState(self.arm, time.monotonic())
        self._states = JointStateReader(self.arm.joint_names, topics.JOINT_STATES.name)
        self._obstacles = ObstacleMarkerReader(self.arm.base_frame)
        self._goals = self.make_publisher(topics.GOAL_POSE)
        self._client = Client(self, is_served=True)
        if settings.bag:
            player = Player(Recording(Path(settings.bag).resolve()))
            arm = player.recording.arm
        else:
            player, arm = None, self.arm
            self._listen()
        try:
            observer = settings_of(self.ARGUMENTS, OBSERVER, OBSERVER_SECTIONS, self.arm)[""]
            budget = load_budget(observer.contact_budget).resolve(arm)
        except SettingsError as error:
            # Nothing is stopped by what the page shows.
            self.get_logger().warning(f"{error}; the page shows forces against the package's own contact budget")
            budget = load_budget().resolve(arm)
        self._server = serve(settings.port, TITLE)
        self._page = call(self._server, lambda: Page(self._server, arm, budget, self.live, self, player))
        port = self._server.get_port()
        self.get_logger().info(
            f"open {page_address(port)}; on another machine, first run ssh -L {port}:localhost:{port} robot"
        )

    def _listen(self) -> None:
        inbox = self.inbox
        # The page shows thirty moments a second: of fast topics, only the newest message is ever decoded.
        inbox.add(topics.JOINT_STATES, self._on_state, topics.NEWEST, serialized=True)
        inbox.add(topics.EXTERNAL_TORQUE, self._on_torque, topics.NEWEST)
        inbox.add(topics.OBSTACLES, self._on_obstacles, serialized=True, largest=LARGEST_SCENE)
        inbox.add(topics.PLAN_MARKERS, self._on_plan, topics.NEWEST, largest=LARGEST_SCENE)
        inbox.add(topics.SIM_CONTACTS, self._on_contacts, _FEW)
        inbox.add(topics.PLAN_STATISTICS, self.live.on_statistics, _FEW)
        inbox.add(topics.SAFETY_STATE, self._on_safety, topics.ALL_EVENTS)

    def turn(self) -> None:
        """Update the page once."""
        wait = self._due - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        self._due = max(self._due + 1.0 / MAX_RATE, time.monotonic())
        self.inbox.poll()
        call(self._server, lambda: self._page.turn(time.monotonic()))

    def destroy_node(self) -> None:
        """Shut the server down as well."""
        self._server.stop()
        super().destroy_node()

    def diagnosis(self) -> tuple[str, Mapping[str, Any]]:
        """Number of browsers."""
        return "", {"browsers": len(self._server.get_clients())}

    def send_goal(self, position: Array) -> str:
        """See `Actions`."""
        if not self._goals.get_subscription_count():
            return "nobody subscribes to goal_pose: is the planner running?"
        self._goals.publish(to_goal_pose(position.tolist(), self.arm.base_frame, self.get_clock().now().to_msg()))
        return f"goal {np.round(position, 3).tolist()} m is sent"

    def stop(self) -> str:
        """See `Actions`."""
        return self._client.stop().text

    def reset(self) -> str:
        """See `Actions`."""
        safety = self.live.safety
        is_stopped = any(state.is_stop for state in safety.values())
        return self._client.release(safety).text if is_stopped else NOTHING

    def _on_state(self, data: bytes) -> None:
        stamp_ns, q, _, _ = self._states.read(data)
        if not np.isfinite(q).all():
            raise InputError(f"joint_states: position = {q.tolist()}; expected finite numbers in rad")
        self.live.on_joint_state(stamp_ns, q, time.monotonic())

    def _on_torque(self, message: JointState) -> None:
        found = efforts(message, topics.EXTERNAL_TORQUE.name)
        places = places_of(self.arm.joint_names, list(found), topics.EXTERNAL_TORQUE.name)
        self.live.update(external_torque=np.array(list(found.values()))[places])

    def _on_obstacles(self, data: bytes) -> None:
        self.live.update(obstacles=self._obstacles.read(data))

    def _on_plan(self, message: MarkerArray) -> None:
        self.live.update(plan=read_plan(message))

    def _on_contacts(self, message: JointState) -> None:
        forces = efforts(message, topics.SIM_CONTACTS.name)
        largest = forces.pop("max", float("nan"))
        forces.pop("sum", None)
        self.live.on_contacts(forces, largest)

    def _on_safety(self, message: DiagnosticStatus) -> None:
        self.live.safety[message.name] = read_state(message, self.arm)


def view(chosen: Mapping[str, Any], parameters: Path | None, namespace: str = "") -> int:
    """Run the viewer with some of its parameters; returns the exit code.

    Parameters
    ----------
    chosen
        Parameters by the names of `ViewerSettings`.
    parameters
        Parameter file; None for the package's own.
    namespace
        Of the stack that it shows.
    """
    file = parameters or config_file(DEFAULT_PARAMETERS)
    texts = {name: value if isinstance(value, int) else str(value) for name, value in chosen.items()}
    arguments = [VIEWER, "--ros-args", "--params-file", str(file), *in_namespace(namespace), *as_arguments(texts)]
    return run(ViewerNode, arguments)


if __name__ == "__main__":
    sys.exit(run(ViewerNode, sys.argv))
