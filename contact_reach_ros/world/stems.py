"""Plants in scene files: stems that bend at joints, with leaves and fruits at their ends."""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from contact_reach_ros.arm import Array
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import setting
from contact_reach_ros.world.obstacle import Bending, Material, Obstacle, ObstacleSettings

_FRUIT = "fruit"
_FRUIT_DISTANCE = 0.045
"""From the end of a stem to the middle of its fruit, m: a gripper closes around the fruit, not around the stem."""
_MOST_LINKS = 20

_LINK_LENGTH, _LEAF_LENGTH = 0.05, 0.095
"""As in the paper's code, m."""
_LINK_MASS, _LEAF_MASS, _FRUIT_MASS = 0.004, 0.005, 0.02
"""Of herbaceous stems 10 mm thick, and a small fruit, kg."""
_MOST_RIGIDITY = 1.25
"""N m²: 10,000 N/m at the end of the first link that moves, and more is as good as fixed."""
_NODE_DAMPING = 1.0
"""In the planner, N s/m: nodes follow the arm almost at once."""


class Stem(NamedTuple):
    """One stem, as a scene file lists it."""

    links: int
    direction: Array
    """(3,) unit vector from the root."""
    bears_fruit: bool


@dataclass(frozen=True)
class StemsSettings(ObstacleSettings):
    """A plant: stems of straight links from one root, of which the lowest are fixed.

    A stem bends at the joints between its links as a beam of this flexural rigidity does. A leaf is one more link; a
    fruit is a mass at the end of its stem, which touches nothing: the gripper closes around it.
    """

    KIND: ClassVar[str] = "plant"

    center: tuple[float, ...] = setting((0.4, 0.0, 0.0), "its root", unit="m", minimum=-1.5, maximum=1.5)
    stems: tuple[str, ...] = setting(
        (),
        "of each stem the number of links, its angle from the vertical and about it, degrees, and whether it bears "
        f"a {_FRUIT} in place of a leaf, as in '4 45 180 {_FRUIT}'",
    )
    turn: float = setting(
        0.0, "greatest turn about the vertical, drawn by the seed", unit="rad", minimum=0.0, maximum=3.2
    )
    radius: float = setting(0.005, "radius of a stem", unit="m", minimum=0.002, maximum=0.05)
    rigidity: float = setting(0.15, "flexural rigidity of a stem", unit="N m²", minimum=0.001, maximum=_MOST_RIGIDITY)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stems:
            raise SettingsError(f"plant: stems = []: expected a list of stems such as '4 45 180 {_FRUIT}'")
        self.parsed()

    def parsed(self) -> list[Stem]:
        """The stems; raises `SettingsError` if one is not as described."""
        return [_parsed(text) for text in self.stems]

    def drawn(self, random: np.random.Generator) -> StemsSettings:
        """The plant turned about the vertical."""
        if not self.turn:
            return self
        turn = math.degrees(random.uniform(-self.turn, self.turn))
        split = [text.split() for text in self.stems]
        turned = (" ".join([links, tilt, repr(float(angle) + turn), *rest]) for links, tilt, angle, *rest in split)
        return dataclasses.replace(self, stems=tuple(turned), turn=0.0)

    def goals(self, center: Array) -> Array:
        """Middles of the fruits (G, 3), m."""
        reach = [each.links * _LINK_LENGTH + _FRUIT_DISTANCE for each in self.parsed() if each.bears_fruit]
        directions = [each.direction for each in self.parsed() if each.bears_fruit]
        return center + np.reshape([far * way for far, way in zip(reach, directions, strict=True)], (-1, 3))

    def at(self, center: Array) -> tuple[Obstacle, ...]:
        """The plant with its root at `center` (3,), m: its nodes are the root and the ends of all links that move."""
        points, stems, masses = [center], [], []
        edges: list[tuple[int, int]] = []
        stiffness: list[float] = []
        joint_stiffness = self.rigidity / _LINK_LENGTH
        for stem in self.parsed():
            ends = _LINK_LENGTH * np.arange(2, stem.links + 1)
            if not stem.bears_fruit:
                ends = np.append(ends, stem.links * _LINK_LENGTH + _LEAF_LENGTH)
            nodes = len(points) + np.arange(len(ends))
            points += [center + end * stem.direction for end in ends]
            # Every joint is where a link that moves begins.
            joints = np.concatenate([[_LINK_LENGTH], ends[:-1]])
            levers = np.maximum(ends[:, None] - joints, 0.0)
            # A chain of springs from the root on in which each node yields as far as that of the stem does there.
            yields = (levers**2).sum(axis=1) / joint_stiffness
            stiffness += (1.0 / np.diff(yields, prepend=0.0)).tolist()
            chain = (0, *nodes.tolist())
            edges += itertools.pairwise(chain)
            stems.append(chain)
            masses.append([_LINK_MASS] * (len(ends) - 1) + [_LINK_MASS if stem.bears_fruit else _LEAF_MASS])
        fruits = tuple(_FRUIT_MASS if stem.bears_fruit else 0.0 for stem in self.parsed())
        bending = Bending(tuple(stems), tuple(map(tuple, masses)), fruits, joint_stiffness)
        rest = np.array(points)
        fixed = np.arange(len(rest)) == 0
        return (
            Obstacle(
                self.KIND,
                "the plant",
                rest,
                self.radius,
                Material(_LINK_MASS, 0.0, _NODE_DAMPING, self.contact_stiffness, self.friction),
                fixed,
                edges=np.array(edges, np.intp),
                edge_stiffness=np.array(stiffness),
                bending=bending,
            ),
        )


def _parsed(text: str) -> Stem:
    words = text.split()
    try:
        links, tilt, turn = int(words[0]), math.radians(float(words[1])), math.radians(float(words[2]))
        is_stem = 2 <= links <= _MOST_LINKS and 0.0 <= tilt <= math.pi and math.isfinite(turn)
        if words[3:] not in ([], [_FRUIT]) or not is_stem:
            raise ValueError
    except (ValueError, IndexError) as error:
        raise SettingsError(
            f"plant: stem '{text}': expected 2 to {_MOST_LINKS} links, 0 to 180 degrees from the vertical, degrees "
            f"about it, and '{_FRUIT}' or nothing"
        ) from error
    flat = math.sin(tilt)
    return Stem(links, np.array([flat * math.cos(turn), flat * math.sin(turn), math.cos(tilt)]), len(words) == 4)
