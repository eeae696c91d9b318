"""Closed-loop episodes whose course is known: four scenes, two seeds each."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import contact_reach_ros as cr
from contact_reach_ros.stack import Result, Tick

SCENES = ("free", "ball", "wall", "ball_mismatch")
SEEDS = (0, 1)
RECORDED = Path(__file__).with_name("episodes.npz")
"""The episodes as they were; `python test/net/episodes.py` writes this file."""
STRIDE = 10
"""Ticks from one kept sample to the next."""
TIMEOUT = 6.0
PLANNING = cr.PlanningSettings(population=32, max_steps=3, deadline=0.0)
"""Few candidates: what is compared is the arithmetic, not the quality of plans."""


class Episode(NamedTuple):
    """One run."""

    result: Result
    torques: NDArray
    """Commands every `STRIDE` ticks, (t, n), N m."""
    tip: NDArray
    """Tip positions every `STRIDE` ticks, (t, 3), m, base frame."""
    hash: str
    """Of all joint positions and commands of all ticks, bit for bit."""


def run_episode(scene_name: str, seed: int) -> Episode:
    """Run the stack to the scene's target and keep what happened."""
    scene = cr.load_scene(scene_name, seed=seed)
    stack = cr.Stack(scene, planning=PLANNING, seed=seed)
    digest = hashlib.sha256()
    samples: list[tuple[NDArray, NDArray]] = []
    torque = np.zeros(stack.arm.n)
    ticks = 0

    def watch(tick: Tick) -> None:
        nonlocal torque, ticks
        torque = torque if tick.torque is None else tick.torque
        digest.update(np.concatenate([tick.state.q, torque]).tobytes())
        if ticks % STRIDE == 0:
            samples.append((torque, stack.tip_position))
        ticks += 1

    result = stack.run(cr.Goal(scene.target), TIMEOUT, watch)
    torques, tip = (np.array(column) for column in zip(*samples, strict=True))
    return Episode(result, torques, tip, digest.hexdigest())


def main() -> None:
    """Write `RECORDED` from the package as it is."""
    arrays: dict[str, NDArray] = {}
    for scene in SCENES:
        for seed in SEEDS:
            episode = run_episode(scene, seed)
            key = f"{scene}_{seed}"
            arrays[f"{key}/tip"] = episode.tip.astype(np.float32)
            arrays[f"{key}/torques"] = episode.torques.astype(np.float32)
            arrays[f"{key}/hash"] = np.array(episode.hash)
            arrays[f"{key}/duration"] = np.array(episode.result.duration)
            arrays[f"{key}/force"] = np.array(episode.result.max_contact_force)
            print(key, episode.result)
    np.savez_compressed(RECORDED, **arrays)


if __name__ == "__main__":
    import conftest  # noqa: F401  the compiler flags of the tests

    main()
