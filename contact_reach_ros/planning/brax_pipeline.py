"""The closed loop as a Brax pipeline, on Brax's own types: `init(sys, q, qd)` and `step(sys, state, act)`.

The action is that of a knot, {Δx, Δq}, which takes effect when the knot begins; law (3) is inside. The links of the
system are those of the arm, and spheres on sliders, see `planning.transfer.brax_spheres`. All arithmetic is that of
the planner's rollouts; only the types are Brax's.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import brax
import jax
import jax.numpy as jnp
import numpy as np
from brax import base, kinematics
from flax import struct
from numpy.typing import NDArray

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.planning.cost import Objective, on_the_way
from contact_reach_ros.planning.transfer import pipeline
from contact_reach_ros.planning.transfer.brax_spheres import read_spheres
from contact_reach_ros.planning.transfer.closed_loop import Reference
from contact_reach_ros.planning.transfer.contact import Obstacles
from contact_reach_ros.planning.transfer.model import read_arm


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
