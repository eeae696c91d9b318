"""The closed loop as a Brax pipeline, on Brax's own types: `init(sys, q, qd)` and `step(sys, state, act)`.

The action is that of a knot, {Δx, Δq}, which takes effect when the knot begins; law (3) is inside. The links of the
system are the arm's, and obstacle spheres, each of which moves on three sliders. The springs and dampers of spheres
are those of the sliders. Where spheres are joined to one another, two custom fields of the MJCF hold the matrices L and
D of the network instead, row by row; Brax's own pipelines do not know these. All arithmetic is that of the planner's
rollouts; only the types are Brax's.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple
from xml.etree.ElementTree import Element

import brax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from brax import base, kinematics
from flax import struct
from numpy.typing import NDArray

from contact_reach_ros.arm.arrays import Array
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.cost import Objective, on_the_way
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.brax_generalized import SPHERE, network, sphere_body
from contact_reach_ros.planning.transfer.closed_loop import Reference
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.lanes import single
from contact_reach_ros.planning.transfer.model import custom_field, read_arm

NETWORK_STIFFNESS, NETWORK_DAMPING = "network_stiffness", "network_damping"
"""Custom fields with the matrices (K, K) of spheres that are joined, N/m and N s/m."""


@struct.dataclass
class State(base.State):
    """Brax's state, and what the laws remember."""

    before: Reference
    """Reference from which the present one is approached, without lanes."""
    reference: Reference
    """Reference in force, without lanes."""
    phase: jax.Array
    """() steps taken in the present knot."""
    link_force: jax.Array
    """(L,) largest force in the present knot on each of the arm's links with capsules, N."""
    contact_force: jax.Array
    """() contact(·) of (4d): largest value in the present knot, N."""


class Kernel(NamedTuple):
    """What a system is to the kernel."""

    objective: Objective
    """Its system is the arm of Brax's in closed loop."""
    obstacles: Obstacles | None
    """At rest, with one lane."""
    hinges: NDArray[np.intp]
    """Indices of the arm's joints in q."""
    sliders: NDArray[np.intp]
    """Indices of the spheres' displacements in q, x, y and z of each."""

    def state(self, q: jax.Array, qd: jax.Array) -> pipeline.State:
        """The kernel's state, with one lane, from positions and velocities of all links."""
        obstacles = self.obstacles
        if obstacles is not None:
            displacement = q[self.sliders].reshape(-1, 3).T
            obstacles = obstacles._replace(center=obstacles.rest + displacement[:, :, None])
        return pipeline.init(self.objective.system, q[self.hinges, None], qd[self.hinges, None], obstacles)


class ClosedLoop:
    """A pipeline for `brax.envs.base.PipelineEnv`.

    Parameters
    ----------
    objective
        Has the gains, the contact stiffness, the time step and the steps of a knot. The arm is that of the system that
        `init` and `step` get.
    """

    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        self._last: tuple[brax.System, Kernel] | None = None

    def kernel(self, sys: brax.System) -> Kernel:
        """What the system is to the kernel.

        Raises
        ------
        SettingsError
            If its links or geometries are none that the kernel knows, see `read_arm` and `read_spheres`, or its fields
            are no constants.
        """
        if self._last is None or self._last[0] is not sys:
            try:
                arm, obstacles = read_arm(sys), read_spheres(sys)
            except jax.errors.TracerArrayConversionError:
                raise SettingsError(
                    "the system's fields are variables of a program, as with randomised domains; expected constants, "
                    "which this pipeline compiles into its program"
                ) from None
            system = dataclasses.replace(self._objective.system, arm=arm)
            ranges = list(zip(sys.link_types, sys.dof_ranges(), strict=True))
            hinges, sliders = ([dof for kind, dofs in ranges if kind == own for dof in dofs] for own in "13")
            objective = dataclasses.replace(self._objective, system=system)
            self._last = sys, Kernel(objective, obstacles, np.array(hinges, int), np.array(sliders, int))
        return self._last[1]

    def init(
        self,
        sys: brax.System,
        q: jax.Array,
        qd: jax.Array,
        act: jax.Array | None = None,
        ctrl: jax.Array | None = None,
        debug: bool = False,
    ) -> State:
        """State at positions and velocities of all links, with the arm held where it is; the rest is ignored."""
        kernel = self.kernel(sys)
        system = kernel.objective.system
        pose = pipeline.tip_pose(system, kernel.state(q, qd))
        hold = Reference(pose.position[:, 0], pose.rotation[..., 0], q[kernel.hinges])
        x, xd = kinematics.forward(sys, q, qd)
        none = jnp.zeros(len(system.arm.contact_links), q.dtype)
        return State(q, qd, x, xd, None, hold, hold, jnp.zeros((), jnp.int32), none, none.sum())

    def step(self, sys: brax.System, state: State, act: jax.Array, debug: bool = False) -> State:
        """One step under the action {Δx, Δq} (6 + n,), m and rad, which a knot reads in its first step."""
        kernel = self.kernel(sys)
        objective, begins = kernel.objective, state.phase == 0
        lanes = kernel.state(state.q, state.qd)
        pose = pipeline.tip_pose(objective.system, lanes)
        latched = objective.latch(lanes.q, lanes.qd, pose, act[:, None])
        reference, before = jax.tree.map(lambda array: array[..., None], (state.reference, state.before))
        reference = jax.tree.map(lambda new, old: jnp.where(begins, new, old), latched, reference)
        shares = objective.shares()
        share = None if shares is None else shares[state.phase]
        lanes = pipeline.step(objective.system, lanes, on_the_way(before, reference, share))
        phase = (state.phase + 1) % objective.substeps
        reached = objective.reached(before if objective.ramp else None, reference) or reference
        before = jax.tree.map(lambda new, old: jnp.where(phase == 0, new, old), reached, before)
        q, qd = self._moved(kernel, state, lanes)
        x, xd = kinematics.forward(sys, q, qd)
        link_force, contact = lanes.link_force[:, 0], objective.measure(lanes.link_force)[0]
        return State(
            q,
            qd,
            x,
            xd,
            None,
            *jax.tree.map(lambda array: array[..., 0], (before, reference)),
            phase,
            jnp.where(begins, link_force, jnp.maximum(link_force, state.link_force)),
            jnp.where(begins, contact, jnp.maximum(contact, state.contact_force)),
        )

    def _moved(self, kernel: Kernel, state: State, lanes: pipeline.State) -> tuple[jax.Array, jax.Array]:
        """Brax's positions and velocities after a step of the kernel; spheres have the mean velocity of the step."""
        q, qd = state.q.at[kernel.hinges].set(lanes.q[:, 0]), state.qd.at[kernel.hinges].set(lanes.qd[:, 0])
        if lanes.obstacles is not None:
            moved = (lanes.obstacles.center - lanes.obstacles.rest)[..., 0].T.ravel()
            speed = (moved - state.q[kernel.sliders]) / kernel.objective.system.timestep
            q, qd = q.at[kernel.sliders].set(moved), qd.at[kernel.sliders].set(speed)
        return q, qd


def bodies_and_fields(obstacles: Obstacles | None) -> tuple[list[Element], dict[str, list[float]]]:
    """What an MJCF has of obstacles with one lane: bodies, and fields where spheres are joined."""
    if obstacles is None:
        return [], {}
    obstacles = jax.tree.map(lambda values: np.asarray(values, np.float64), obstacles)
    stiffness, damping = (np.asarray(matrix) for matrix in network(obstacles))
    alone = not (_off_diagonal(stiffness) or _off_diagonal(damping))
    rest, radius = obstacles.rest[..., 0].T, obstacles.radius[:, 0]
    springs = np.stack([np.diag(stiffness), np.diag(damping)], axis=1) if alone else np.zeros((len(radius), 2))
    bodies = [
        sphere_body(index, rest[index], float(radius[index]), float(spring), float(damper))
        for index, (spring, damper) in enumerate(springs)
    ]
    fields = {NETWORK_STIFFNESS: stiffness.ravel().tolist(), NETWORK_DAMPING: damping.ravel().tolist()}
    return bodies, {} if alone else fields


def _off_diagonal(matrix: Array) -> bool:
    return bool(np.abs(matrix - np.diag(np.diag(matrix))).max() > 1e-6 * np.abs(matrix).max())


def read_spheres(system: brax.System) -> Obstacles | None:
    """The spheres of a system, at rest and with one lane; None if there are none.

    Raises
    ------
    SettingsError
        If a sphere is not held by springs and dampers, or is no sphere on three sliders.
    """
    links = np.flatnonzero([kind == "3" for kind in system.link_types])
    if not len(links):
        return None
    model = system.mj_model
    geoms = np.array([int(np.argmax(model.geom_bodyid == link + 1)) for link in links])
    dofs = np.array([system.dof_ranges()[link] for link in links])
    if (
        not np.array_equal(model.geom_bodyid[geoms], links + 1)
        or np.any(model.geom_type[geoms] != SPHERE)
        or np.any(np.asarray(system.dof.motion.vel)[dofs] != np.eye(3))
    ):
        names = [system.link_names[link] for link in links]
        raise SettingsError(f"links {names}: expected spheres on sliders along x, y and z, one geometry each")
    size = len(links) ** 2
    stiffness, damping = (
        np.diag(np.asarray(values, float)[dofs[:, 0]]) if given is None else given.reshape(len(links), -1)
        for values, given in (
            (system.dof.stiffness, custom_field(system, NETWORK_STIFFNESS, size)),
            (system.dof.damping, custom_field(system, NETWORK_DAMPING, size)),
        )
    )
    if min(np.linalg.eigvalsh(stiffness)[0], np.linalg.eigvalsh(damping)[0]) <= 0.0:
        raise SettingsError("expected a spring and a damper for each sphere: give its sliders stiffness and damping")
    rates, shapes = scipy.linalg.eigh(stiffness, damping)
    rest = np.asarray(system.link.transform.pos)[links].T[:, :, None]
    return Obstacles(
        center=single(rest),
        rest=single(rest),
        radius=single(np.asarray(system.geom_size)[geoms, :1]),
        shapes=single(shapes),
        amplitudes=single(shapes.T @ damping),
        rates=single(rates),
    )
