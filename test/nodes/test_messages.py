"""Joints are mapped by name, whatever their order."""

import ctypes
import gc

import numpy as np
import pytest
from sensor_msgs.msg import JointState

from contact_reach_ros.arm.kinematics import rotation_about
from contact_reach_ros.arms import iiwa14
from contact_reach_ros.errors import InputError
from contact_reach_ros.messages.conversions import to_quaternion, to_time
from contact_reach_ros.messages.values import nanoseconds, pick


def state(names):
    return JointState(name=list(names), position=[float(name[-1]) for name in names])


def test_joints_are_picked_by_name_from_any_order_and_among_others():
    joints = iiwa14.ARM.joint_names
    expected = np.arange(1.0, 8.0)
    for names in (
        iiwa14.ARM.joint_names,
        iiwa14.ARM.joint_names[::-1],
        ("gripper_9", *iiwa14.ARM.joint_names[3:], *iiwa14.ARM.joint_names[:3]),
    ):
        assert np.array_equal(pick(state(names), joints, "position", "joint_states"), expected)


def test_missing_joints_and_fields_of_the_wrong_length_are_named():
    joints = iiwa14.ARM.joint_names
    with pytest.raises(InputError, match=r"joint_states: field name lacks lbr_A3, lbr_A7; expected all of lbr_A1"):
        pick(state([name for name in joints if name[-1] not in "37"]), joints, "position", "joint_states")
    with pytest.raises(InputError, match="velocity has 0 values"):
        pick(state(iiwa14.ARM.joint_names), joints, "velocity", "joint_states")


def test_times_survive_the_way_to_a_message_and_back():
    for time_ns in (0, 999_999_999, 1_795_233_693_122_143_135):
        assert nanoseconds(to_time(time_ns)) == time_ns


class MemoryInUse(ctypes.Structure):
    """What glibc's mallinfo2 answers, in bytes."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "in_use", "free", "top")
    )


@pytest.mark.parametrize("layout", ["C", "F"])
def test_a_quaternion_leaves_nothing_behind(layout):
    # Pinocchio's bindings lose 80 bytes for each matrix that is stored row by row: 7 kB a second in the planner.
    mallinfo = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if mallinfo is None:
        pytest.skip("there is no glibc 2.33")
    mallinfo.restype = MemoryInUse
    rotation = np.array(rotation_about(np.array([0.0, 0.6, 0.8]), 0.7), order=layout)

    def in_use_after(count: int) -> int:
        for _ in range(count):
            to_quaternion(rotation)
        gc.collect()
        return mallinfo().in_use

    before = in_use_after(100)
    assert in_use_after(5000) - before < 5000 * 8
