"""Episodes of which pictures can be made: with the obstacles and the contacts at each tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from contact_reach_ros.baselines.method import Method
from contact_reach_ros.experiments.episode import EpisodeOptions, EpisodeResult, run_episode
from contact_reach_ros.plant.plant import TICK, Contacts, Plant
from contact_reach_ros.scenes.scene import Scene
from contact_reach_ros.scenes.spheres import rest_positions

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WatchedEpisode:
    """An episode, from the moment the goal was given.

    Attributes
    ----------
    scene
        That it took place in.
    result
        Of `run_episode`.
    obstacles
        (n, K, 3) where the obstacles are after each tick of the result, m, in the order of `rest_positions`.
    contacts
        (n) contacts with the arm after each tick.
    """

    scene: Scene
    result: EpisodeResult
    obstacles: Array
    contacts: list[Contacts]

    @property
    def last_obstacles(self) -> Array:
        """(K, 3) where the obstacles are at the end, m."""
        return self.obstacles[-1] if len(self.obstacles) else rest_positions(self.scene)

    @property
    def peak_force(self) -> float:
        """Largest contact force on one body, N."""
        return float(self.result.contact_forces.max(initial=0.0))


def watch_episode(scene: Scene, method: Method, options: EpisodeOptions) -> WatchedEpisode:
    """Run an episode as `run_episode` does and keep what pictures need."""
    settle_ticks = round(options.settle / TICK)
    obstacles: list[Array] = []
    contacts: list[Contacts] = []

    def watch(tick: int, plant: Plant) -> None:
        # The result does not hold the time before the goal was given either.
        if tick >= settle_ticks:
            obstacles.append(plant.obstacle_positions())
            contacts.append(plant.contacts())

    result = run_episode(scene, method, options, watch)
    moved = np.reshape(obstacles, (len(obstacles), *rest_positions(scene).shape))
    return WatchedEpisode(scene, result, moved, contacts)
