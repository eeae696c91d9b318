"""An arm that differs from the iiwa 14 in all that modules might take for granted.

It is the iiwa without its third joint, and so has the same flange where that joint's angle is zero. It has six joints
with limits that are not symmetric, two capsules on its second link, and none on its last.
"""

import dataclasses

import numpy as np
from arm_simulation import ARM
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm import Arm, Capsule, rotation_from_quaternion

_DROPPED = 2
"""Index of the joint that it lacks."""


def of_six(values: tuple) -> tuple:
    """One value for each of its joints, from those of the iiwa."""
    return values[:_DROPPED] + values[_DROPPED + 1 :]


def _make() -> Arm:
    dropped, after = ARM.joints[_DROPPED], ARM.joints[_DROPPED + 1]
    turn = rotation_from_quaternion(dropped.rotation)

    def in_the_link_before(point: tuple[float, float, float]) -> tuple[float, float, float]:
        x, y, z = (np.array(dropped.offset) + turn @ point).tolist()
        return x, y, z

    rotation = Rotation.from_matrix(turn @ rotation_from_quaternion(after.rotation)).as_quat(scalar_first=True)
    joints = [
        *ARM.joints[:_DROPPED],
        dataclasses.replace(after, offset=in_the_link_before(after.offset), rotation=tuple(rotation.tolist())),
        *ARM.joints[_DROPPED + 2 :],
    ]
    joints = [dataclasses.replace(joint, lower=0.9 * joint.lower, name=f"joint_{i}") for i, joint in enumerate(joints)]
    capsules = []
    for capsule in ARM.capsules[:-1]:
        if capsule.link == _DROPPED + 1:
            start, end = in_the_link_before(capsule.start), in_the_link_before(capsule.end)
            capsules.append(Capsule(_DROPPED, start, end, capsule.radius))
        else:
            capsules.append(dataclasses.replace(capsule, link=capsule.link - (capsule.link > _DROPPED)))

    return dataclasses.replace(
        ARM,
        name="six_axis",
        joints=tuple(joints),
        link_names=tuple(f"link_{i}" for i in range(1, len(joints) + 1)),
        base_frame="base",
        tip_frame="tip",
        capsules=tuple(capsules),
        inertia_sets={"only": of_six(ARM.inertias()), "nominal": of_six(ARM.inertias())},
        home=of_six(ARM.home),
        defaults={name: of_six(values) for name, values in ARM.defaults.items()},
    )


SIX_AXIS = _make()
