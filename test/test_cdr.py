"""Numbers and texts out of serialised messages, against what rclpy serialises."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.serialization import serialize_message

from contact_reach_ros.cdr import diagnostic_array


def message() -> DiagnosticArray:
    """Texts of all lengths modulo four, and statuses with and without values."""
    array = DiagnosticArray()
    array.header.stamp.sec, array.header.stamp.nanosec = 1700000000, 123456789
    array.header.frame_id = "lbr"
    for count in range(6):
        values = [KeyValue(key="k" * number, value="wert ü" + "v" * (number + count)) for number in range(count)]
        status = DiagnosticStatus(level=bytes([count % 3]), name="n" * count, message="m" * (2 * count), values=values)
        status.hardware_id = "h" * (count + 1)
        array.status.append(status)
    return array


def test_array_of_statuses():
    array = message()
    stamp_ns, found = diagnostic_array(serialize_message(array))
    assert stamp_ns == 1_700_000_000_123_456_789
    assert [(bytes([status.level]), status.name, status.message) for status in found] == [
        (status.level, status.name, status.message) for status in array.status
    ]
    assert [list(status.values) for status in found] == [
        [(item.key, item.value) for item in status.values] for status in array.status
    ]


def test_what_is_cut_or_another_encoding_is_refused():
    data = serialize_message(message())
    whole = diagnostic_array(data)
    for size in range(0, len(data) - 8, 5):
        with pytest.raises(ValueError, match=r"is not little-endian CDR|ends"):
            diagnostic_array(data[:size])
    assert diagnostic_array(data + b"more") == whole
    with pytest.raises(ValueError, match="is not little-endian CDR"):
        diagnostic_array(b"\0\0" + data[2:])
