"""A bag may end right after a stop: what led to it has been published by then."""

import pytest
from rclpy.serialization import deserialize_message
from stack_helpers import ros
from std_msgs.msg import Int64MultiArray

from contact_reach_ros.errors import requested
from contact_reach_ros.messages.intake import COLUMNS, Taken
from contact_reach_ros.nodes.controller import ControllerNode
from contact_reach_ros.nodes.observer import ObserverNode


@pytest.fixture(params=[ControllerNode, ObserverNode])
def node(request):
    with ros():
        yield request.param()


def published_rows(node) -> list[list[int]]:
    """Rows of all batches that the node publishes from now on."""
    rows: list[list[int]] = []

    def publish(data: bytes) -> None:
        numbers = list(deserialize_message(data, Int64MultiArray).data)[1:]
        rows.extend(numbers[at : at + len(COLUMNS)] for at in range(0, len(numbers), len(COLUMNS)))

    node.inbox.intake._publish = publish
    return rows


def test_a_requested_stop_is_noted_at_once_with_all_that_came_before(node):
    rows = published_rows(node)
    node.running = True
    node.inbox.intake.add(Taken.JOINT_STATES, 1, 2)
    assert rows == []
    node.stop_for(requested("stop service called"))
    assert [row[0] for row in rows] == [Taken.JOINT_STATES, Taken.STOP]


def test_while_the_node_is_inactive_and_nobody_records_it_waits(node):
    rows = published_rows(node)
    node.stop_for(requested("stop service called"))
    assert rows == []
    node.inbox.intake.flush()
    assert [row[0] for row in rows] == [Taken.STOP]
