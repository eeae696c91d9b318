"""Whether a description can be that of a real arm: what is refused, all at once, and what is doubtful."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Array
from contact_reach_ros.arm.assumptions import inertias_at_home
from contact_reach_ros.arm.capsules import volume
from contact_reach_ros.arm.kinematics import tensor_values
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.errors import SettingsError

LEAST_EFFORT = 0.1
"""N m: for less there are no thresholds."""
_ROUNDING = 1e-6
"""Share of the greatest moment of inertia by which the others may fall short of it together."""
_LEAST_SHARE = 1e-3
"""Of the greatest second moment of mass, which the others have at least in a balanced tensor."""
_POSTURES = 500
_LIGHT = 0.05
"""Mass by volume of the capsules, kg per litre, below which the masses are hardly real; robots have 0.3 to 2."""
_SLOW = 5.0
"""Acceleration at home, rad/s², which the drives of real arms are good for; those of a UR20 for 40."""
_THICK = 1.0
"""Radius of a link, m, that no arm has."""
_ALIKE = 3
"""So many links, if they are most of all, are hardly alike."""
_BLOCKS = {
    "limits": ("rad, rad/s, Nm", f"lower < upper, a velocity above 0 and an effort of at least {LEAST_EFFORT:g} Nm"),
    "inertias": ("kg, m, kg m²", "masses above 0 and moments of inertia of which none exceeds the sum of the others"),
}
"""Units and rules of what is refused, by the keys of `ArmOptions`."""


class Fault(NamedTuple):
    """What is wrong with the limits of a joint or the inertia of a link."""

    key: str
    """One of `_BLOCKS`."""
    name: str
    """Of the joint or link."""
    text: str
    mend: str
    """What belongs under key and name."""


def refuse(faults: Sequence[Fault], file: Path, options: Path) -> None:
    """Raise `SettingsError` with all faults, if there are any, and the block for the YAML file `options`.

    The message begins with `file`, the robot's.
    """
    expected, lines = [], []
    for key, (units, rule) in _BLOCKS.items():
        if entries := [(fault.name, fault.mend) for fault in faults if fault.key == key]:
            plain = {name: name.replace("_", "a").isalnum() and not name.isdigit() for name, _ in entries}
            expected.append(rule)
            lines += [f"{key}: # {units}"]
            lines += [f"  {name if plain[name] else repr(name)}: {{{mend}}}" for name, mend in entries]
    if lines:
        wrong = "; ".join(fault.text for fault in faults)
        mend = f"mend the file, or put this, with numbers in place of dots, into {options}:"
        raise SettingsError("\n".join([f"{file}: {wrong}. Expected {', '.join(expected)}: {mend}", *lines]))


def wrong_limits(joint: str, wrong: Mapping[str, float | None], why: str = "") -> Fault:
    """Limits of a joint that are wrong, rad, rad/s, N m, or missing, by their keys."""
    found = ", ".join(f"no {key}" if value is None else f"{key} {value:g}" for key, value in wrong.items())
    return Fault("limits", joint, f"joint '{joint}' has {found}{why}", ", ".join(f"{key}: ..." for key in wrong))


def wrong_inertias(link: str, lumped: pin.Inertia, own: Mapping[str, pin.Inertia]) -> Iterator[Fault]:
    """No mass, or moments of inertia that no body has: `lumped`, of a link with all that is fixed to it.

    `own`: inertias of the link and of those that are fixed to it, by name, each in its frame in the file.
    """
    # In a sum these might vanish.
    found = {name: f"mass {each.mass:g} kg" for name, each in own.items() if each.mass < 0.0}
    found |= {name: _excess(each) for name, each in own.items() if name not in found and _is_negative(each)}
    if not (found or lumped.mass > 0.0):
        found = {link: "no mass"}
    for name, text in found.items():
        mend = "mass: ..., center: [x, y, z], tensor: [xx, yy, zz, xy, xz, yz]"
        yield Fault("inertias", name, f"link '{name}' has {text}", mend)
    # A sum of inertias that bodies have is one that a body has.
    for name, each in own.items() if not found and _excess(lumped) else ():
        if excess := _excess(each):
            mend = f"mass: {each.mass:g}, center: {_listed(each.lever)}, tensor: {_balanced(each)}"
            yield Fault("inertias", name, f"link '{name}' has {excess}", mend)


def _is_negative(inertia: pin.Inertia) -> bool:
    """Whether a principal moment is below zero by more than rounding errors."""
    moments = np.linalg.eigvalsh(inertia.inertia)
    return bool(moments[0] < -_ROUNDING * np.abs(moments).max())


def _excess(inertia: pin.Inertia) -> str:
    """How principal moments of inertia miss what every body has; empty if they do not."""
    moments = np.linalg.eigvalsh(inertia.inertia)
    values = ", ".join(f"{moment:.6g}" for moment in moments)
    if moments[0] <= 0.0:
        return f"principal moments of inertia {values} kg m², not all above 0"
    share = moments[2] / (moments[0] + moments[1]) - 1.0
    if share <= _ROUNDING:
        return ""
    return f"principal moments of inertia {values} kg m², the last {100.0 * share:.4g} % above the sum of the others"


def _balanced(inertia: pin.Inertia) -> str:
    """The nearest tensor (6,) that a body has, kg m²: no second moment of its mass is negative."""
    matrix = np.array(inertia.inertia)
    seconds, axes = np.linalg.eigh(0.5 * np.trace(matrix) * np.eye(3) - matrix)
    least = _LEAST_SHARE * seconds.max() if seconds.max() > 0.0 else 1e-3 * inertia.mass
    seconds = np.maximum(seconds, least)
    balanced = axes @ np.diag(seconds.sum() - seconds) @ axes.T
    return _listed(np.array(tensor_values(balanced)))


def _listed(values: Array) -> str:
    return f"[{', '.join(f'{value:.6g}' for value in np.where(np.abs(values) < 1e-12, 0.0, values))}]"


def too_weak(model: RobotModel) -> Iterator[Fault]:
    """The joints that cannot hold the arm's weight in its home posture."""
    arm = model.arm
    for joint, torque in zip(arm.joints, np.abs(model.gravity_at(np.array(arm.home))), strict=True):
        if torque > joint.torque_limit:
            why = f" Nm, less than the {torque:.3g} Nm that gravity needs at home"
            yield wrong_limits(joint.name, {"effort": joint.torque_limit}, why)


def doubts(model: RobotModel) -> list[str]:
    """What is hardly that of a real arm, in words: efforts, masses and inertias."""
    arm, inertias = model.arm, model.arm.inertias()
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (_POSTURES, arm.n))
    most = np.max([np.abs(model.gravity_at(q)) for q in postures], axis=0)
    found = [
        f"limits: {joint.name} needs up to {torque:.3g} Nm against gravity, more than its effort limit of "
        f"{joint.torque_limit:g} Nm"
        for joint, torque in zip(arm.joints, most, strict=True)
        if torque > joint.torque_limit
    ]
    found += [
        f"limits: {joint.name} can speed up by no more than {joint.torque_limit / inertia:.2g} rad/s² at home with its "
        f"effort limit of {joint.torque_limit:g} Nm"
        for joint, inertia in zip(arm.joints, inertias_at_home(arm), strict=True)
        if joint.torque_limit < _SLOW * inertia
    ]
    found += [
        f"capsules: that of {arm.link_names[shape.link - 1]} has a radius of {shape.radius:.3g} m; are lengths in m?"
        for shape in arm.capsules
        if shape.radius > _THICK
    ]
    mass = sum(inertia.mass for inertia in inertias)
    litres = 1e3 * sum(volume(np.array(shape.start), np.array(shape.end), shape.radius) for shape in arm.capsules)
    if mass < _LIGHT * litres:
        found.append(f"inertias: the moving links weigh {mass:.3g} kg in {litres:.3g} litres; these are placeholders")
    for what, values in (("masses", [each.mass for each in inertias]), ("tensors", [each.tensor for each in inertias])):
        count = Counter(values).most_common(1)[0][1]
        if count >= _ALIKE and count > 0.5 * arm.n:
            found.append(f"inertias: {count} of {arm.n} links have equal {what}; these are placeholders")
    return found
