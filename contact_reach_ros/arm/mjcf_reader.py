"""An MJCF as the <robot> element of a URDF: MuJoCo compiles it, and bodies, sites and joints are written as links."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
import pinocchio as pin

from contact_reach_ros.arm.arm import Array, Inertia
from contact_reach_ros.arm.kinematics import tensor_values, vector
from contact_reach_ros.arm.mjcf import numbers
from contact_reach_ros.arm.robot_file import POINTS
from contact_reach_ros.arm.rotations import rotation_from_quaternion
from contact_reach_ros.arm.urdf import add_inertial, add_joint, add_origin
from contact_reach_ros.arm.urdf_tree import RANGE
from contact_reach_ros.errors import SettingsError

_SPEED = 1.0
"""Speed limit of joints, rad/s: MJCF has none."""
_KINDS = {
    int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
    int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
    int(mujoco.mjtJoint.mjJNT_BALL): "floating",
    int(mujoco.mjtJoint.mjJNT_FREE): "floating",
}
_ROUND = {int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere", int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule"}
_ROUND[int(mujoco.mjtGeom.mjGEOM_CYLINDER)] = "cylinder"
_BOXES = (int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_ELLIPSOID))


def robot_of_mjcf(file: Path) -> tuple[Element, list[str]]:
    """The robot in an MJCF, and what was assumed: its bodies and sites are links, and the world is the root.

    Geometry that touches nothing is visual; floors of the world do not count.

    Raises `SettingsError` if MuJoCo refuses the file.
    """
    try:
        # MuJoCo opens no file with another ending, nor one in capitals.
        spec = mujoco.MjSpec.from_file(str(file)) if file.suffix == ".xml" else _in_folder(file)
        return _Writer(spec.compile(), spec.modelname or file.stem).write()
    except (ValueError, mujoco.FatalError) as error:
        raise SettingsError(f"{file}: MuJoCo refuses it: {error}; mend what it names") from error


def _in_folder(file: Path) -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(file.read_text("utf-8"))
    spec.modelfiledir = str(file.parent)
    return spec


class _Writer:
    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model = model
        has_gravity = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        self._robot = Element("robot", name=name, gravity=numbers(has_gravity * model.opt.gravity))
        self._assumed = [f"limits: velocity {_SPEED:g} rad/s where none is given, since MJCF has none"]
        self._bodies = [model.body(number).name or f"body_{number}" for number in range(model.nbody)]

    def write(self) -> tuple[Element, list[str]]:
        model = self._model
        links = [SubElement(self._robot, "link", name=name) for name in self._bodies]
        for body, link in enumerate(links):
            if body:
                center, mass = model.body_ipos[body], float(model.body_mass[body])
                turn = _place(center, model.body_iquat[body]).rotation
                tensor = tensor_values(turn @ np.diag(model.body_inertia[body]) @ turn.T)
                add_inertial(link, Inertia(mass, vector(center), tensor))
                self._add_joints(body)
        for geom in range(model.ngeom):
            self._add_geometry(geom, links[model.geom_bodyid[geom]])
        for site in range(model.nsite):
            name = model.site(site).name
            if name:
                name = name if name not in self._bodies else f"{name}_site"
                SubElement(self._robot, "link", name=name)
                place = _place(model.site_pos[site], model.site_quat[site])
                add_joint(self._robot, f"{name} mount", "fixed", (self._bodies[model.site_bodyid[site]], name), place)
        for constraint in map(int, np.flatnonzero(model.eq_active0)):
            self._add_mimic(constraint)
        self._say_what_is_left_out()
        return self._robot, self._assumed

    def _say_what_is_left_out(self) -> None:
        """Forces that the arm's model has not."""
        model = self._model
        springs = [model.joint(each).name or f"joint_{each}" for each in np.flatnonzero(model.jnt_stiffness)]
        floating = [self._bodies[each] for each in np.flatnonzero(model.body_gravcomp)]
        tendons = [model.tendon(each).name or f"tendon_{each}" for each in range(model.ntendon)]
        for what, names in (("springs of", springs), ("gravity compensation of", floating), ("tendons", tendons)):
            if names:
                self._assumed.append(f"forces: {what} {', '.join(names)} are left out; the arm must not depend on them")

    def _add_mimic(self, constraint: int) -> None:
        """An equality between two joints, if it is linear; of all others only a line remains."""
        model = self._model
        objects, factors = (model.eq_obj1id[constraint], model.eq_obj2id[constraint]), model.eq_data[constraint]
        is_of_joints = model.eq_type[constraint] == mujoco.mjtEq.mjEQ_JOINT
        if is_of_joints and objects[1] >= 0 and not factors[2:5].any():
            at, leads = (model.qpos0[model.jnt_qposadr[each]] for each in objects)
            name, leader = (model.joint(each).name or f"joint_{each}" for each in objects)
            follower = next(each for each in self._robot.findall("joint") if each.get("name") == name)
            offset = at + factors[0] - factors[1] * leads
            SubElement(follower, "mimic", joint=leader, multiplier=repr(float(factors[1])), offset=repr(float(offset)))
        else:
            kind = mujoco.mjtEq(model.eq_type[constraint]).name.removeprefix("mjEQ_").lower()
            name = model.equality(constraint).name or str(constraint)
            self._assumed.append(f"equality: constraint {name} ({kind}) is left out; the arm must not depend on it")

    def _add_joints(self, body: int) -> None:
        """The joints of a body, one after the other about their anchors, with links between them."""
        model, name = self._model, self._bodies[body]
        at, before = _place(model.body_pos[body], model.body_quat[body]), self._bodies[model.body_parentid[body]]
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        for joint in range(first, first + count):
            anchor, axis, kind = model.jnt_pos[joint], model.jnt_axis[joint], _KINDS[int(model.jnt_type[joint])]
            place, back = at * pin.SE3(np.eye(3), anchor), -model.qpos0[model.jnt_qposadr[joint]] * axis
            if kind == "revolute":
                place = place * pin.SE3(pin.exp3(back), np.zeros(3))
            elif kind == "prismatic":
                place = place * pin.SE3(np.eye(3), back)
            is_last = joint == first + count - 1 and not anchor.any()
            label = model.joint(joint).name or f"joint_{joint}"
            after = name if is_last else f"{name} after {label}"
            if not is_last:
                SubElement(self._robot, "link", name=after)
            if kind == "revolute" and not model.jnt_limited[joint]:
                kind = "continuous"
            element = add_joint(self._robot, label, kind, (before, after), place)
            SubElement(element, "axis", xyz=numbers(axis))
            SubElement(element, "dynamics", armature=repr(float(model.dof_armature[model.jnt_dofadr[joint]])))
            limits = {"velocity": repr(_SPEED)}
            if model.jnt_limited[joint]:
                limits |= dict(zip(RANGE, numbers(model.jnt_range[joint]).split(), strict=True))
            if (effort := self._effort(joint)) is not None:
                limits["effort"] = repr(effort)
            SubElement(element, "limit", limits)
            at, before = pin.SE3(np.eye(3), -anchor), after
        if before != name:
            add_joint(self._robot, f"{name} mount", "fixed", (before, name), at)

    def _effort(self, joint: int) -> float | None:
        """The torque that a joint and its actuators permit in both directions, N m; None where nothing limits it."""
        model = self._model
        found = [np.abs(model.jnt_actfrcrange[joint]).min()] if model.jnt_actfrclimited[joint] else []
        on_joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        for each in np.flatnonzero(on_joints & (model.actuator_trnid[:, 0] == joint)):
            gear = abs(model.actuator_gear[each, 0])
            if model.actuator_forcelimited[each]:
                found.append(gear * np.abs(model.actuator_forcerange[each]).min())
            if model.actuator_ctrllimited[each] and model.actuator_biastype[each] == mujoco.mjtBias.mjBIAS_NONE:
                least = np.abs(model.actuator_ctrlrange[each]).min()
                found.append(gear * abs(model.actuator_gainprm[each, 0]) * least)
        return float(min(found)) if found else None

    def _add_geometry(self, geom: int, link: Element) -> None:
        model, kind, size = self._model, int(self._model.geom_type[geom]), self._model.geom_size[geom]
        if kind in (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD):
            body = self._bodies[model.geom_bodyid[geom]]
            self._assumed += [f"capsules: a plane of {body} is left out"] * bool(model.geom_bodyid[geom])
            return
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        element = SubElement(link, "collision" if collides else "visual")
        add_origin(element, _place(model.geom_pos[geom], model.geom_quat[geom]))
        geometry = SubElement(element, "geometry")
        if kind in _ROUND:
            length = {} if _ROUND[kind] == "sphere" else {"length": repr(2.0 * float(size[1]))}
            SubElement(geometry, _ROUND[kind], {"radius": repr(float(size[0])), **length})
        elif kind in _BOXES:
            SubElement(geometry, "box", size=numbers(2.0 * size))
        elif kind == mujoco.mjtGeom.mjGEOM_MESH:
            SubElement(geometry, POINTS, at=numbers(_hull(model, model.geom_dataid[geom]).ravel()))
        else:
            SubElement(geometry, mujoco.mjtGeom(kind).name)


def _hull(model: mujoco.MjModel, mesh: int) -> Array:
    """Vertices of a mesh (V, 3), m: those of its convex hull where MuJoCo has one."""
    first, graph = model.mesh_vertadr[mesh], model.mesh_graphadr[mesh]
    vertices = np.array(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], float)
    if graph < 0:
        return vertices
    # Numbers of vertices and faces, the places of their edges, then the vertices' indices.
    count = model.mesh_graph[graph]
    return vertices[model.mesh_graph[graph + 2 + count : graph + 2 + 2 * count]]


def _place(position: Array, quaternion: Array) -> pin.SE3:
    return pin.SE3(rotation_from_quaternion(quaternion), np.array(position))
