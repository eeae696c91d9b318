"""What nodes get from a command line: files as the package reads them, not as ROS does."""

import pytest
from rclpy.parameter import Parameter
from stack_helpers import ros

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.nodes.observer import ObserverNode
from contact_reach_ros.ros.parameters import given_parameters, namespace_in, without_parameters
from contact_reach_ros.ros.process import initialise

TEXT = """
observer:
  ros__parameters:
    use_sim_time: true
    momentum:
      gain: 50
      coulomb_friction: [1e-1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]
      torque_offset: [0, 0.5, 0, 0, 0, 0, 0]
      viscous_friction: [1, 1, 1, 1, 1, 1, 1]
      gravity_in_torque: off
"""


@pytest.fixture
def arguments(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text(TEXT)
    return ["observer", "--ros-args", "--params-file", str(file), "-p", "state_rate:=5e2", "-r", "__ns:=/left"]


def test_a_node_has_them_in_its_namespace(arguments, monkeypatch):
    with ros():
        monkeypatch.setattr(ObserverNode, "ARGUMENTS", arguments)
        node = ObserverNode()
        try:
            assert node.get_parameter("momentum.gain").value == 50
            assert node.get_parameter("momentum.torque_offset").type_ is Parameter.Type.DOUBLE_ARRAY
            assert node.get_parameter("momentum.coulomb_friction").value[0] == 0.1
            assert node.get_parameter("state_rate").value == 500.0
            assert node.get_parameter("momentum.torque_offset").value[:2] == [0.0, 0.5]
            assert node.settings["momentum"].viscous_friction == (1.0,) * 7
            assert node.settings["momentum"].gravity_in_torque is False
            assert node.get_parameter("use_sim_time").value is True
        finally:
            node.destroy_node()


def test_ros_gets_the_rest_of_the_command_line(arguments):
    assert without_parameters(arguments) == ["observer", "--ros-args", "-r", "__ns:=/left"]


@pytest.mark.parametrize("namespace", ["/left/", "/1x", "/a b"])
def test_a_namespace_that_is_none_is_refused(namespace):
    with pytest.raises(SettingsError, match=f"__ns:={namespace}: expected a name of letters"):
        namespace_in(["observer", "--ros-args", "-r", f"__ns:={namespace}"])


@pytest.mark.parametrize("last", [["-p"], ["--params-file"], ["-p", "momentum.gain"], ["-p", ":=3"]])
def test_a_parameter_without_its_value_is_refused(last):
    arguments = ["observer", "--ros-args", *last]
    with pytest.raises(SettingsError, match="expected"):
        given_parameters(arguments, "observer")
        initialise(arguments)
