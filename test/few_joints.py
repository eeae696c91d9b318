"""Arms with five joints and fewer, out of generated URDFs; a letter of their names is the axis of a joint."""

import functools
import tempfile
from pathlib import Path

from contact_reach_ros.arm import Arm
from contact_reach_ros.arm.table import ArmOptions
from contact_reach_ros.arm.urdf_reader import read_arm

_AXES = {"y": "0 1 0", "z": "0 0 1"}
_LENGTHS = (0.15, 0.3, 0.28, 0.1, 0.1)
_SIDEWAYS = "0 1.5708 0"
"""Roll, pitch and yaw of a tip whose z axis is across the last link."""


def _link(name: str, mass: float, length: float) -> str:
    moment = mass * length**2 / 12.0 + 0.001
    inertia = f'<inertia ixx="{moment}" iyy="{moment}" izz="0.002" ixy="0" ixz="0" iyz="0"/>'
    origin, shape = f'<origin xyz="0 0 {0.5 * length}"/>', f'<cylinder radius="0.04" length="{length}"/>'
    inertial = f'<inertial>{origin}<mass value="{mass}"/>{inertia}</inertial>'
    return f'<link name="{name}">{inertial}<collision>{origin}<geometry>{shape}</geometry></collision></link>'


@functools.cache
def few_joints(axes: str, sideways: bool = False, home: tuple[float, ...] | None = None) -> Arm:
    """An arm whose joints turn about the axes that the letters name, in a straight posture at angles of zero."""
    text, before, place = _link("base", 4.0, 0.1), "base", 0.1
    for number, (axis, length) in enumerate(zip(axes, _LENGTHS, strict=False), 1):
        name = f"link_{number}"
        text += _link(name, 3.0 / number, length) + (
            f'<joint name="joint_{number}" type="revolute"><origin xyz="0 0 {place}"/><parent link="{before}"/>'
            f'<child link="{name}"/><axis xyz="{_AXES[axis]}"/>'
            '<limit lower="-2.8" upper="2.8" velocity="2" effort="120"/></joint>'
        )
        before, place = name, length
    text += (
        f'<link name="tool"/><joint name="mount" type="fixed"><origin xyz="0 0 {place + 0.05}" '
        f'rpy="{_SIDEWAYS if sideways else "0 0 0"}"/><parent link="{before}"/><child link="tool"/></joint>'
    )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{axes}.urdf"
        file.write_text(f'<robot name="{axes}">{text}</robot>')
        return read_arm(file, ArmOptions(home=home)).arm
