"""Contacts of the simulated arm and their forces."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.arm.arrays import Array


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of the arm at one moment.

    Attributes
    ----------
    links
        (C,) indices into `Plant.contact_links`.
    points
        (C, 3), m, base frame.
    forces
        (C, 3) on the arm, N, base frame.
    """

    links: NDArray[np.intp]
    points: Array
    forces: Array


class ContactReader:
    """Reads MuJoCo's contacts with some links of the arm."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, links: Sequence[str]) -> None:
        self._data = data
        self._count = len(links)
        names = [model.body(body).name for body in model.geom_bodyid]
        self._link_of_geom = [links.index(name) if name in links else -1 for name in names]

    def forces(self) -> Array:
        """Magnitude of the vector sum of the forces on each link, (L,), N."""
        sums = [[0.0, 0.0, 0.0] for _ in range(self._count)]
        for _, link, sign, force, frame in self._rows():
            total = sums[link]
            for row, size in enumerate(force):
                along = sign * size
                total[0] += along * frame[3 * row]
                total[1] += along * frame[3 * row + 1]
                total[2] += along * frame[3 * row + 2]
        return np.array([math.hypot(*total) for total in sums])

    def normal_forces(self) -> Array:
        """Sum of the normal forces on each link, (L,), N, without friction."""
        sums = [0.0] * self._count
        for _, link, _, force, _ in self._rows():
            sums[link] += force[0]
        return np.array(sums)

    def contacts(self) -> Contacts:
        """All contacts; those of a link add up to its force in `forces`."""
        rows, contact = list(self._rows()), self._data.contact
        indices = [index for index, *_ in rows]
        forces = np.zeros((len(rows), 3))
        for total, (_, _, sign, force, frame) in zip(forces, rows, strict=True):
            total[:] = sign * (np.array(force) @ np.reshape(frame, (3, 3))[: len(force)])
        links = np.array([link for _, link, *_ in rows], np.intp)
        return Contacts(links, contact.pos[indices].reshape(-1, 3), forces)

    def _rows(self) -> Iterator[tuple[int, int, float, list[float], list[float]]]:
        """Index, link, sign, force and frame of each contact with a link, as plain numbers.

        Where the arm touches itself there is a row for each of the two links. The sign is that of the force on the
        link: MuJoCo gives the force on the second geometry of the two.

        The force (1,) or (3,), N, is normal and, with friction, tangential; MuJoCo's frame (9,) is a rotation matrix in
        row order, whose first row is the normal.
        """
        data = self._data
        if data.ncon == 0:
            return
        # Plain numbers: arrays are slower for fewer than a dozen contacts. With an elliptic friction cone the rows of
        # a contact among the constraints are its force.
        contact, links, forces = data.contact, self._link_of_geom, data.efc_force.tolist()
        columns = (contact.geom, contact.efc_address, contact.dim, contact.frame)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for index, ((first, second), address, dim, frame) in enumerate(rows):
            # MuJoCo leaves out contacts without an address, which carry no force.
            if address < 0:
                continue
            force = forces[address : address + dim]
            if links[first] >= 0:
                yield index, links[first], -1.0, force, frame
            if links[second] >= 0:
                yield index, links[second], 1.0, force, frame
