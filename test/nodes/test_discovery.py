"""How far the nodes can be heard: nothing leaves this host unless somebody asks for it."""

import pytest
from contact_reach_command import python
from stack_helpers import environment

from contact_reach_ros.bringup.settings import BRINGUP_SECTIONS
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.ros import discovery
from contact_reach_ros.ros.parameters import check_arguments

TALK = """
import contextlib, os, socket, sys
from contact_reach_ros.ros.discovery import environment, reach
from contact_reach_ros.ros.process import bare_node

os.environ.update(environment(*sys.argv[1:]))
with bare_node("test"):
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError), socket.socket(fileno=os.dup(int(name))) as opened:
            if opened.family == socket.AF_INET and opened.getsockname()[1]:
                print(opened.getsockname()[0])
    print(*reach(os.environ))
"""


def talk(*choice):
    """Addresses of the sockets of a process with a node, and what `reach` finds there."""
    *addresses, reach = python(TALK, *choice, env=environment()).splitlines()
    return set(addresses), reach


def test_by_default_every_socket_is_bound_to_this_host():
    addresses, reach = talk()
    assert "127.0.0.1" in addresses and reach.startswith("host ")
    assert all(address.startswith(("127.", "239.255.")) for address in addresses)


def test_subnet_opens_the_sockets_and_says_so():
    addresses, reach = talk("subnet")
    assert "0.0.0.0" in addresses and reach.startswith("subnet ") and "OPEN" in reach


@pytest.fixture
def unset(monkeypatch):
    for name in (discovery.RANGE, *discovery.PROFILES):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize("choice", discovery.CHOICES)
def test_middleware_that_reads_no_profile_gets_the_range(unset, monkeypatch, choice):
    monkeypatch.setattr(discovery, "get_rmw_implementation_identifier", lambda: "rmw_cyclonedds_cpp")
    variables = discovery.environment(choice)
    assert set(variables) == {discovery.RANGE} and discovery.reach(variables)[0] == choice


def test_nothing_is_set_over_the_choice_of_the_user_and_an_unknown_choice_is_refused(unset, monkeypatch):
    with pytest.raises(SettingsError, match="discovery = 'world': expected one of"):
        discovery.environment("world")
    monkeypatch.setenv(discovery.RANGE, "chosen")
    assert discovery.environment("subnet") == {}
    assert discovery.reach({discovery.PROFILES[1]: "mine.xml"})[0] == ""


@pytest.mark.parametrize(
    ("argument", "value"),
    [("discovery:=subnet", "subnet"), ("bringup:discovery:=subnet", "subnet"), ("recorder:discovery:=subnet", "host")],
)
def test_bringup_knows_the_choice_before_ros_starts(argument, value):
    options = check_arguments(["bringup", "--ros-args", "-p", argument], "bringup", BRINGUP_SECTIONS)[""]
    assert options.discovery == value
