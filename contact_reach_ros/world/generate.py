"""Concrete scenes from a scene file and a seed."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms import load_arm
from contact_reach_ros.arrays import Array
from contact_reach_ros.errors import ContactReachError, InputError, SceneError
from contact_reach_ros.world.checks import check_placement, check_reach, conflict
from contact_reach_ros.world.collision import check_goal
from contact_reach_ros.world.files import read_scene
from contact_reach_ros.world.fitting import fitted
from contact_reach_ros.world.free_path import free_path
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.obstacle import bodies
from contact_reach_ros.world.scene import MismatchSettings, Scene, SceneFile

_TARGET_TRIES = 200
_FOAM = 1
"""Keeps the random numbers of the mismatch independent of those of the places."""


def load_scene(name: str, arm: Arm | None = None, seed: int = 0, target: ArrayLike | None = None) -> Scene:
    """Load a scene of the package, or of a YAML file, and make it concrete.

    Parameters
    ----------
    name
        Name of a scene in config/scenes, or the path of a YAML file.
    arm
        Arm for which target and obstacles are placed; None for the iiwa 14.
    seed
        The same seed gives the same scene.
    target
        Position of the tip (3,), m, base frame, which replaces the file's or a random one.

    Raises
    ------
    SceneError
        As `read_scene` and `make_scene`, and if an argument has the wrong type or value.
    """
    if not (arm is None or isinstance(arm, Arm)):
        raise SceneError(f"arm = {arm!r}: expected an Arm, from load_arm(name)")
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise SceneError(f"seed = {seed!r}: expected an integer from 0 on")
    wanted = None if target is None else np.asarray(target, dtype=float)
    if wanted is not None and not (wanted.shape == (3,) and np.isfinite(wanted).all()):
        raise SceneError(f"target = {target!r}: expected three finite numbers x, y, z in m")
    return make_scene(read_scene(name), arm or load_arm(), seed, wanted)


def make_scene(file: SceneFile, arm: Arm, seed: int, target: Array | None = None) -> Scene:
    """Draw a target and place the obstacles so that the arm's free path meets them, unless the file places them.

    Parameters
    ----------
    file
        From `read_scene`.
    arm
        Arm that the scene is made for, and that is simulated in it.
    seed
        The same seed gives the same scene. Only what the file leaves open is drawn from the seed.
    target
        Flange position (3,), m, which replaces the file's or a random one.

    Raises
    ------
    SceneError
        If a given target cannot be reached or is inside an obstacle, an obstacle lies in the arm at the start, or no
        target or no place for the obstacle was found; the message says what to change.
    SettingsError
        If the start is not within the limits of the arm's joints, or the arm has no such inertia set.
    """
    file = fitted(file, arm)
    try:
        check_placement(file, arm)
    except ContactReachError as error:
        where = file.source or f"scene '{file.name}'"
        raise type(error)(f"{where}: {error}") from error
    random = np.random.default_rng(seed)
    model = RobotModel(arm)
    start = file.target.start_of(arm)
    origin, rotation = model.tip_pose(start)
    given = file.target.position if target is None else target
    wanted = None if given is None else np.asarray(given, float)
    path = None
    if wanted is not None:
        check_reach(arm, wanted)
        try:
            check_goal(arm, Target(wanted, rotation), file.environment, start)
        except InputError as error:
            raise SceneError(f"scene '{file.name}': {error}") from error
        path = free_path(model, start, wanted)
        placed = " and ".join(section.NAME for section in file.obstacles if section.center is None)
        if path is None and placed:
            raise SceneError(
                f"scene '{file.name}': the {placed} cannot be placed on the arm's path: from the start it does not get "
                f"to the target {np.round(wanted, 3).tolist()} m on a straight line with the orientation held; choose "
                "another target, or say in a scene file where the obstacle is"
            )
        path = start[None] if path is None else path
    tries = min([_TARGET_TRIES, *(section.TARGET_TRIES for section in file.obstacles)])
    reason = ""
    for _ in range(tries):
        drawn = random.uniform(file.target.minimum, file.target.maximum) if wanted is None else wanted
        if wanted is None:
            is_far = np.linalg.norm(drawn - origin) >= file.target.min_distance
            path = free_path(model, start, drawn) if is_far else None
        if path is None:
            continue
        bare = Scene(file.name, arm, seed, start, drawn, environment=file.environment)
        scene = _with_obstacles(bare, file, path, random)
        if scene is None:
            continue
        reason = conflict(scene)
        if not reason:
            return _mismatched(scene, file.mismatch)
        if wanted is not None and (not file.obstacles or any(each.center is not None for each in file.obstacles)):
            raise SceneError(f"scene '{file.name}': {reason}")
    raise SceneError(f"scene '{file.name}', seed {seed}: {_nothing_found(file, tries, wanted is None, reason)}")


def _nothing_found(file: SceneFile, tries: int, is_drawn: bool, reason: str) -> str:
    """What was searched for, and what to change; `reason` is why the last scene was refused, if one was."""
    names = " and ".join(section.NAME for section in file.obstacles)
    what = f"target with {names} on the arm's path" if names else "target"
    remedies = ["widen the target's box" if is_drawn else "choose another target"]
    remedies += [section.limits for section in file.obstacles if section.center is None and section.limits]
    last = f" (the last: {reason})" if reason else ""
    return f"no {what} found in {tries} tries{last}; {', or '.join(remedies)}"


def _mismatched(scene: Scene, mismatch: MismatchSettings) -> Scene:
    """Draw the obstacles' mismatch apart from the rest, so that it changes nothing else in the scene."""
    random = np.random.default_rng((scene.seed, _FOAM))
    scale = random.uniform(1.0 - mismatch.foam_variation, 1.0 + mismatch.foam_variation)
    scale *= mismatch.foam_factor ** random.uniform(-1.0, 1.0)
    offsets = np.zeros((0, 3))
    if mismatch.placement_error:
        offsets = random.normal(size=(len(scene.obstacles), 3))
        lengths = mismatch.placement_error * random.uniform(size=(len(scene.obstacles), 1))
        offsets *= lengths / np.linalg.norm(offsets, axis=1, keepdims=True)
    changed = dataclasses.replace(scene, mismatch=mismatch, foam_scale=float(scale), offsets=offsets)
    for obstacle, offset in zip(changed.true_obstacles, offsets, strict=False):
        # One that would begin in the arm is seen where it is.
        offset *= not conflict(dataclasses.replace(scene, obstacles=(obstacle,)))
    return changed


def _with_obstacles(scene: Scene, file: SceneFile, path: Array, random: np.random.Generator) -> Scene | None:
    """Add the obstacles, where the file says or on the arm's free path (N, n); None if nothing fits."""
    centers: list[Array] = []
    for section in file.obstacles:
        given = section.center
        center = section.place(scene.arm, path, random) if given is None else np.array(given)
        if center is None:
            return None
        centers.append(center)
    return dataclasses.replace(scene, obstacles=bodies(file.obstacles, centers))
