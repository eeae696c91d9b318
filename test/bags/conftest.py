"""A small bag with messages of several types, as the middleware serialises them."""

from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from visualization_msgs.msg import Marker, MarkerArray

from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter

START_NS = 1_700_000_000_000_000_000
STEP_NS = 1_000_000


def _message(index: int) -> tuple[str, Any]:
    """Message number `index`, with its topic."""
    kind = index % 5
    if kind == 0:
        names = [f"lbr_A{joint + 1}" for joint in range(7)]
        message = JointState(name=names, position=[index + 0.1] * 7, velocity=[0.2] * 7, effort=[-3.0] * 7)
        message.header.stamp.nanosec = index
        return "/joint_states", message
    if kind == 1:
        return "/effort_controller/commands", Float64MultiArray(data=[float(index), -1.0, 0.5])
    if kind == 2:
        message = PoseStamped()
        message.header.frame_id = "lbr_link_0"
        message.pose.position = Point(x=0.5, y=-0.25, z=index / 8)
        return "/goal_pose", message
    if kind == 3:
        values = [KeyValue(key="Gelenk", value="A₃"), KeyValue(key="number", value=str(index))]
        return "/safety_state", DiagnosticStatus(level=b"\x02", name="observer", message="stop", values=values)
    spheres = Marker(type=Marker.SPHERE_LIST, points=[Point(x=1.0 * index), Point(y=2.0)])
    return "/obstacles", MarkerArray(markers=[spheres, Marker(text="wall")])


TYPES = {
    "/joint_states": JointState,
    "/effort_controller/commands": Float64MultiArray,
    "/goal_pose": PoseStamped,
    "/safety_state": DiagnosticStatus,
    "/obstacles": MarkerArray,
}


class SampleBag:
    """What was written, and where to."""

    def __init__(self, directory: Path, count: int = 200) -> None:
        self.directory = directory
        self.topics = {name: f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}" for name, kind in TYPES.items()}
        known = [RecordedTopic(name, type_name, depth=1, latched=True) for name, type_name in self.topics.items()]
        self.written: list[tuple[str, int, int, Any, bytes]] = []
        custom_data = {"scene": "ball", "seed": "7"}
        with BagWriter(directory, known, custom_data=custom_data) as writer:
            for index in range(count):
                topic, message = _message(index)
                received = START_NS + index * STEP_NS
                data = serialize_message(message)
                self.written.append((topic, received, received - 1000, message, data))
                writer.write(topic, data, received, received - 1000, index)
                if index % 40 == 39:
                    # Several chunks, as a recorder makes them.
                    writer.flush()

    @property
    def file(self) -> Path:
        return self.directory / f"{self.directory.name}_0.mcap"


@pytest.fixture
def sample(tmp_path: Path) -> SampleBag:
    return SampleBag(tmp_path / "sample")


@pytest.fixture(scope="session")
def shared_sample(tmp_path_factory: pytest.TempPathFactory) -> SampleBag:
    """For tests that only read."""
    return SampleBag(tmp_path_factory.mktemp("bags") / "sample")
