"""The security policies permit what the nodes do, and nothing else."""

from contextlib import contextmanager
from xml.etree import ElementTree

import pytest
from policies import policy
from stack_helpers import ros

from contact_reach_ros.bringup.processes import BringupOptions, processes
from contact_reach_ros.messages import topics
from contact_reach_ros.nodes.adapter import AdapterNode
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.nodes.planner import PlannerNode
from contact_reach_ros.nodes.recorder import RecorderNode
from contact_reach_ros.nodes.viewer import ViewerNode
from contact_reach_ros.resources import share_directory
from contact_reach_ros.ros.interfaces import INTERFACES, MANAGED

NODES = {
    "driver": DriverNode,
    "controller": ControllerNode,
    "observer": ObserverNode,
    "planner": PlannerNode,
    "adapter": AdapterNode,
    "recorder": RecorderNode,
    "viewer": ViewerNode,
}
FREE_PORT = ("-p", "port:=0")
LOCKSTEP = ("-p", "use_sim_time:=true", "-p", "lockstep:=true")
SHADOW = ("-p", "supervision.shadow:=true")
ADAPTED = ("-p", "supervision.adapter:=true")

EVERYTHING = BringupOptions(bag="bag", view=True, adapter="effort")

FOLDER = share_directory() / "config" / "security"


@contextmanager
def made(name, *parameters):
    """One node of the stack, not yet configured."""
    with ros("--ros-args", *parameters):
        node = NODES[name]()
        yield node
        node.destroy_node()


def names(pairs, node):
    """Names as policies have them."""
    kept = ("/parameter_events", "/rosout")
    shared = {f"/{topic.name}" for topic in topics.ALL}
    return {
        name
        if name in kept
        else f"~/{name.removeprefix(f'/{node}/')}"
        if name.startswith(f"/{node}/") and name not in shared
        else name[1:]
        for name, _ in pairs
    }


def interface(name, *parameters):
    """What a node publishes, subscribes to, serves and calls."""
    with made(name, *parameters) as node:
        return [
            names(getattr(node, f"get_{kind}_names_and_types_by_node")(name, "/"), name)
            for kind in ("publisher", "subscriber", "service", "client")
        ]


@pytest.mark.parametrize("name", NODES)
def test_the_table_says_what_a_node_does_in_all_its_modes(name):
    modes = (FREE_PORT, (*LOCKSTEP, *SHADOW, *FREE_PORT), (*ADAPTED, *FREE_PORT))
    publishes, subscribes, serves, calls = (
        set().union(*parts) for parts in zip(*(interface(name, *mode) for mode in modes), strict=True)
    )
    if name == "recorder":
        # It subscribes to topics once they have a publisher.
        subscribes |= {topic.name for topic in topics.ALL}
    table = INTERFACES[name]
    if name in ("viewer", "adapter"):
        # It calls services when its users ask for it, or where a package is installed.
        assert calls <= table.calls
        calls = table.calls
    assert publishes == table.publishes
    assert subscribes == table.subscribes
    assert serves == table.serves
    assert calls == table.calls


def test_every_process_and_every_topic_of_the_stack_is_in_the_table():
    assert {process.name for process in processes(EVERYTHING)} == set(MANAGED) == set(NODES)
    named = {name for interface in INTERFACES.values() for name in interface.publishes | interface.subscribes}
    assert {topic.name for topic in topics.ALL} <= named


@pytest.mark.parametrize("name", INTERFACES)
def test_the_shipped_file_is_made_from_the_table(name):
    remake = "run `python test/policies.py config/security`"
    assert (FOLDER / f"{name}.policy.xml").read_text() == policy(name, INTERFACES[name]), remake


def test_no_other_policy_is_shipped():
    assert {file.name for file in FOLDER.iterdir()} == {f"{name}.policy.xml" for name in INTERFACES}


def test_only_controller_and_adapter_may_command_and_only_the_planner_may_lead():
    writers = {}
    for file in FOLDER.iterdir():
        for profile in ElementTree.parse(file).getroot().iter("profile"):
            for group in profile.iter("topics"):
                for topic in group:
                    if group.get("publish") == "ALLOW":
                        writers.setdefault(topic.text, set()).add(profile.get("node"))
    assert writers[topics.COMMANDS.name] == {"controller", "adapter"}
    assert writers[topics.ADAPTER_COMMANDS.name] == {"controller"}
    assert writers[topics.REFERENCE_POSE.name] == writers[topics.REFERENCE_POSTURE.name] == {"planner"}
    assert writers[topics.JOINT_STATES.name] == {"driver"}


def test_the_processes_use_the_enclaves_of_the_policies():
    for process in processes(BringupOptions(bag="bag")):
        root = ElementTree.parse(FOLDER / f"{process.name}.policy.xml").getroot()
        assert [enclave.get("path") for enclave in root.iter("enclave")] == [process.enclave]
