"""Small URDFs for tests, with what readers like to get wrong."""

from pathlib import Path

LIMIT = '<limit lower="-2.5" upper="1.5" velocity="2" effort="60"/>'


def link(name: str, mass: float = 1.0, extra: str = "") -> str:
    inertial = (
        f'<inertial><origin xyz="0.01 -0.02 0.05" rpy="0.3 0.1 -0.4"/><mass value="{mass}"/>'
        '<inertia ixx="0.02" iyy="0.03" izz="0.015" ixy="0.001" ixz="-0.002" iyz="0.003"/></inertial>'
    )
    return f'<link name="{name}">{inertial if mass else ""}{extra}</link>'


def joint(name: str, parent: str, child: str, axis: str = "0 0 1", kind: str = "revolute", extra: str = LIMIT) -> str:
    number = len(name) + ord(name[-1])
    origin = f'<origin xyz="0.0{number % 5} -0.0{number % 3} 0.2" rpy="0.{number % 7} -0.{number % 4} 1.{number % 9}"/>'
    return (
        f'<joint name="{name}" type="{kind}">{origin}<parent link="{parent}"/><child link="{child}"/>'
        f'<axis xyz="{axis}"/>{extra}</joint>'
    )


def collision(shape: str, origin: str = "") -> str:
    return f"<collision>{origin}<geometry>{shape}</geometry></collision>"


def ball(radius: float = 0.05) -> str:
    return collision(f'<sphere radius="{radius}"/>')


AXES = ("0 0 1", "0 1 0", "-1 0 0", "0 0 -1", "0.6 0 0.8", "1 2 3", "0 -1 0")
"""Of the seven joints: with the frame, aside, backwards, and not normalised."""


def odd_arm(**changed: str) -> str:
    """Seven joints about odd axes, links that are fixed to others, and a finger; `changed`: other texts by name."""
    parts = {"world": '<link name="world"/>', "stand": link("stand", extra=ball(0.1))}
    parts["mount"] = joint("mount", "world", "stand", kind="fixed", extra="")
    before = "stand"
    for number, axis in enumerate(AXES, 1):
        name = f"part_{number}"
        parts[name] = link(name, mass=3.0 - 0.3 * number, extra=ball())
        parts[f"joint_{number}"] = joint(f"joint_{number}", before, name, axis)
        before = name
    # In the middle of the chain, at its side, and at its end.
    parts["sensor"] = link("sensor", 0.4)
    parts["sensor_mount"] = joint("sensor_mount", "part_3", "sensor", kind="fixed", extra="")
    parts["joint_4"] = joint("joint_4", "sensor", "part_4", AXES[3])
    parts["finger"] = link("finger", 0.2)
    parts["finger_joint"] = joint("finger_joint", "part_7", "finger", "0 1 0")
    parts["tool"] = '<link name="tool"/>'
    parts["tool_mount"] = joint("tool_mount", "part_7", "tool", kind="fixed", extra="")
    return '<robot name="odd">' + "".join({**parts, **changed}.values()) + "</robot>"


def written(folder: Path, text: str, name: str = "arm.urdf") -> Path:
    file = folder / name
    file.write_text(text)
    return file
