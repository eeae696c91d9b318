"""The security policies permit what the nodes do, and nothing else."""

from xml.etree import ElementTree

import pytest
from arm_simulation import ARM
from interfaces import INTERFACES
from policies import policy
from stack_helpers import ros

from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.doctor import driver, stack
from contact_reach_ros.drives.settings import FRANKA_STATES, KINDS
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.nodes.viewer import ViewerNode
from contact_reach_ros.resources import share_directory
from contact_reach_ros.ros.client import Client
from contact_reach_ros.ros.interfaces import DOCTOR, MANAGED

CLASSES = (DriverNode, ControllerNode, ObserverNode, PlannerNode, AdapterNode, RecorderNode, ViewerNode)
NODES = {node_class.NAME: node_class for node_class in CLASSES}
MODES = (
    (),
    ("use_sim_time:=true", "supervision.shadow:=true"),
    ("supervision.adapter:=true",),
    ("kind:=lbr", "gravity_compensation:=false", "state_rate:=500.0"),
    ("kind:=franka", "gravity_compensation:=false"),
)
pytestmark = pytest.mark.usefixtures("packages")

FOLDER = share_directory() / "config" / "security"


def in_policies(name, node):
    """A name of the graph as policies have it."""
    if name in ("/parameter_events", "/rosout"):
        return name
    own = f"/{node}/"
    is_private = name.startswith(own) and name[1:] not in {topic.name for topic in topics.ALL}
    return f"~/{name.removeprefix(own)}" if is_private else name[1:]


def interface(name, mode):
    """What a node publishes, subscribes to, serves and calls."""
    of_franka = "kind:=franka" in mode and name != "driver"
    with ros(*mode, "port:=0", more=("-r", f"joint_states:={FRANKA_STATES}") if of_franka else ()):
        node = NODES[name]()
        if isinstance(node, PlannerNode):
            # As it does when it is active.
            node.describe_robot()
        found = used_by(node)
        node.destroy_node()
        return found


def used_by(node):
    name, kinds = node.get_name(), ("publisher", "subscriber", "service", "client")
    found = [getattr(node, f"get_{kind}_names_and_types_by_node")(name, "/") for kind in kinds]
    return [{in_policies(each, name) for each, _ in pairs} for pairs in found]


@pytest.mark.parametrize("name", NODES)
def test_the_table_says_what_a_node_does_in_all_its_modes(name):
    found = zip(*(interface(name, mode) for mode in MODES), strict=True)
    publishes, subscribes, serves, calls = (set().union(*parts) for parts in found)
    if name == "recorder":
        # It subscribes to topics once they have a publisher.
        subscribes |= {*(topic.name for topic in topics.ALL), *topics.OF_OTHERS, FRANKA_STATES}
    table = INTERFACES[name]
    assert (publishes, subscribes, serves) == (table.publishes, table.subscribes, table.serves)
    # Two call services when their users ask for it, or where a package is installed.
    assert calls <= table.calls if name in ("viewer", "adapter") else calls == table.calls


@pytest.mark.parametrize("kind", KINDS)
def test_the_doctor_listens_to_drivers_within_its_policy(kind, monkeypatch):
    found = []

    class Seen(Client):
        def close(self):
            found.append(used_by(self.node))
            super().close()

    monkeypatch.setattr(driver, "Client", Seen)
    monkeypatch.setattr(stack, "SETTLED_S", 0.0)
    driver.listen(BringupOptions(driver=False, adapter=kind), ARM, 0.002, 0.0)
    ((publishes, subscribes, serves, calls),) = found
    table = INTERFACES[DOCTOR]
    assert publishes <= table.publishes and subscribes <= table.subscribes
    assert serves <= table.serves and calls <= table.calls


def test_every_process_and_every_topic_of_the_stack_is_in_the_table():
    everything = processes(BringupOptions(bag="bag", view=True, adapter="effort"))
    assert {process.name for process in everything} == set(MANAGED) == set(NODES)
    named = {name for interface in INTERFACES.values() for name in interface.publishes | interface.subscribes}
    assert {topic.name for topic in topics.ALL} <= named
    for process in everything:
        root = ElementTree.parse(FOLDER / f"{process.name}.policy.xml").getroot()
        assert [enclave.get("path") for enclave in root.iter("enclave")] == [process.enclave]


def test_the_shipped_files_are_made_from_the_table():
    remake = "run `python test/policies.py config/security`"
    expected = {f"{name}.policy.xml": policy(name, interface) for name, interface in INTERFACES.items()}
    assert {file.name: file.read_text() for file in FOLDER.iterdir()} == expected, remake


def test_only_controller_and_adapter_may_command_and_only_the_planner_may_lead():
    def writers(topic):
        return {name for name, interface in INTERFACES.items() if topic.name in interface.publishes}

    assert writers(topics.COMMANDS) == {"controller", "adapter"}
    assert writers(topics.ADAPTER_COMMANDS) == {"controller"}
    assert writers(topics.REFERENCE_POSE) == writers(topics.REFERENCE_POSTURE) == {"planner"}
    # KUKA's driver has none.
    assert writers(topics.JOINT_STATES) == {"driver", "adapter"}
