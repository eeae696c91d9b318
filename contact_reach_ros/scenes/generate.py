"""Concrete scenes from a scene file and a seed."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from contact_reach_ros.arm import Arm, Array, checked_array, link_frames
from contact_reach_ros.arm.capsules import moving, shape_name, shape_segments
from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arm.mount import SceneFrame, scene_frame, standing
from contact_reach_ros.arms import load_arm
from contact_reach_ros.errors import ContactReachError, InputError, SceneError, SettingsError
from contact_reach_ros.scenes.fitting import fitted
from contact_reach_ros.scenes.placing import free_path, on_hand, on_middle, place
from contact_reach_ros.world.collision import check_goal, check_hand, nearest, overlap_depths
from contact_reach_ros.world.goal import FREE, Goal, Target
from contact_reach_ros.world.obstacle import Obstacle, WallSettings, bodies
from contact_reach_ros.world.scene import MismatchSettings, Scene
from contact_reach_ros.world.scene_file import SceneFile, read_scene

_TARGET_TRIES, _TARGET_TRIES_WITH_WALLS = 200, 20
"""Numbers of targets that are tried: few with walls, because the search for their place takes long."""
_TOLERANCE = 1e-9
"""Depth up to which nothing counts as overlapping, m."""
_FOAM = 1
"""Keeps the random numbers of the mismatch independent of those of the places."""


def load_scene(name: str, arm: Arm | str | None = None, seed: int = 0, target: ArrayLike | None = None) -> Scene:
    """Load a scene of the package, or of a YAML file, and make it concrete.

    Parameters
    ----------
    name
        Name of a scene in config/scenes, or the path of a YAML file.
    arm
        Arm for which target and obstacles are placed, or its name or file; None for the iiwa 14.
    seed
        The same seed gives the same scene.
    target
        Position of the tip (3,), m, base frame, which replaces the file's or a random one.

    Raises
    ------
    SceneError
        As `read_scene` and `make_scene`, and if the seed is no integer from 0 on.
    """
    if not isinstance(seed, int | np.integer) or seed < 0:
        raise SceneError(f"seed = {seed!r}: expected an integer from 0 on")
    arm = arm if isinstance(arm, Arm) else load_arm() if arm is None else load_arm(arm)
    return make_scene(read_scene(str(name)), arm, seed, target)


def parse_target(text: str) -> Array | None:
    """Parse a position (3,) in m from 'x y z'; None for an empty text.

    Raises
    ------
    SceneError
        If it is not three finite numbers.
    """
    if not text.strip():
        return None
    try:
        return checked_array("target", [float(word) for word in text.split()], (3,))
    except (InputError, ValueError) as error:
        raise SceneError(f"target '{text}': expected three finite numbers 'x y z' in m") from error


def make_scene(file: SceneFile, arm: Arm, seed: int, target: ArrayLike | None = None) -> Scene:
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
    arm = file.equipped(arm)
    own, frame = standing(arm) if file.target.reach else arm, scene_frame(arm)
    try:
        made = fitted(file, arm)
        if own is arm:
            return _mismatched(_drawn(made, arm, seed, target), file.mismatch)
        given = None if target is None else frame.inward(checked_array("target", target, (3,)))
        return _mismatched(_moved(_drawn(made, own, seed, given), arm, frame), file.mismatch)
    except ContactReachError as error:
        kind = SettingsError if isinstance(error, SettingsError) else SceneError
        place = f"{np.round(frame.origin, 3).tolist()} m in {arm.base_frame}, z up"
        where = "" if own is arm else f" (places are in the arm's scene frame, at {place})"
        # What is wrong with a given target is not the file's.
        instead = "" if target is None else f" (with the target {np.array(target).tolist()} in place of the scene's)"
        raise kind(f"{file.source or file.name}: {error}{instead}{where}") from error


def _moved(scene: Scene, arm: Arm, frame: SceneFrame) -> Scene:
    """A scene that was made in an arm's scene frame, in its base frame."""
    return dataclasses.replace(
        scene,
        arm=arm,
        target=frame.outward(scene.target),
        obstacles=tuple(dataclasses.replace(each, rest=frame.outward(each.rest)) for each in scene.obstacles),
        environment=tuple(body.moved(frame.rotation, frame.origin) for body in scene.environment),
    )


def _drawn(file: SceneFile, arm: Arm, seed: int, target: ArrayLike | None) -> Scene:
    arm.inertias(file.mismatch.inertia_set)
    start, random = file.target.start_of(arm), np.random.default_rng(seed)
    file = dataclasses.replace(file, obstacles=tuple(section.drawn(random) for section in file.obstacles))
    _check_placed(file, arm, start)
    given = file.target.position if target is None else target
    placed = [section for section in file.obstacles if section.center is not None]
    goals = np.concatenate([np.zeros((0, 3)), *(section.goals(np.array(section.center)) for section in placed)])
    if given is None and len(goals):
        given = random.choice(goals)
    tries = _TARGET_TRIES
    if any(isinstance(section, WallSettings) for section in file.obstacles):
        tries = min(tries, _TARGET_TRIES_WITH_WALLS)
    if given is not None and all(section.center is not None for section in file.obstacles):
        tries = 1
    reason, missed = "", Counter[str]()
    for wanted, path in _targets(file, RobotModel(arm), given, tries, random, missed):
        centers = []
        for section in file.obstacles:
            center = place(section, arm, path, random)
            if center is None:
                break
            centers.append(center)
        else:
            obstacles = bodies(file.obstacles, centers)
            scene = _scene(file, arm, seed, start, wanted, obstacles)
            reason = conflict(scene)
            if not reason:
                return scene
    if tries == 1:
        raise SceneError(reason)
    names = " and ".join(f"the {section.KIND}" for section in file.obstacles)
    last = f" (the last: {reason})" if reason else ""
    last += "".join(f"; {count} times {why}" for why, count in missed.most_common(1))
    raise SceneError(
        f"seed {seed}: no target{names and f' with {names} on the path'} found in {tries} tries{last}; "
        f"{'widen the box of the target' if given is None else 'choose another target'}, relax the limits of the "
        "obstacles, or give them a center"
    )


def _check_placed(file: SceneFile, arm: Arm, start: Array) -> None:
    """Refuse what no seed makes possible; raises `SceneError`."""
    placed = [section for section in file.obstacles if section.center is not None]
    if len(placed) < len(file.obstacles) and not (on_middle(arm).any() and on_hand(arm).any()):
        raise SceneError(
            f"obstacles are placed by the capsules of middle links and hand, and arm '{arm.name}' lacks them on one of "
            "these; give each obstacle a center"
        )
    # Without a target of its own, the scene is checked only at the start.
    target = np.full(3, np.nan) if file.target.position is None else np.array(file.target.position)
    obstacles = bodies(placed, [np.array(section.center) for section in placed])
    if reason := conflict(_scene(file, arm, 0, start, target, obstacles)):
        raise SceneError(reason)


def _scene(file: SceneFile, arm: Arm, seed: int, start: Array, target: Array, obstacles: tuple[Obstacle, ...]) -> Scene:
    orientation, environment = file.target.orientation, file.environment
    return Scene(file.name, arm, seed, start, target, obstacles, environment=environment, orientation=orientation)


def _targets(
    file: SceneFile,
    model: RobotModel,
    given: ArrayLike | None,
    tries: int,
    random: np.random.Generator,
    missed: Counter[str],
) -> Iterator[tuple[Array, Array]]:
    """Targets (3,), m, with the arm's free path (N, n), rad, to each: a given one again and again, or random ones.

    `missed` counts why random ones are left out. Raises `SceneError` or `InputError` if the arm cannot reach the given
    target.
    """
    start = file.target.start_of(model.arm)
    origin, rotation = model.tip_pose(start)
    if given is None:
        for _ in range(tries):
            drawn = random.uniform(file.target.minimum, file.target.maximum)
            if np.linalg.norm(drawn - origin) < file.target.min_distance:
                missed[f"one is less than {file.target.min_distance:.3g} m from the start"] += 1
                continue
            try:
                path = free_path(model, start, drawn)
            except SceneError as error:
                missed[str(error)] += 1
            else:
                yield drawn, path
        return
    goal = Goal(given, file.target.orientation).resolve(model.arm, rotation)
    check_goal(model.arm, goal, file.environment, start)
    placed = " and ".join(section.KIND for section in file.obstacles if section.center is None)
    try:
        path = free_path(model, start, goal.position)
    except SceneError as error:
        if placed:
            raise SceneError(
                f"the {placed} cannot be placed on the arm's path: from the start it does not get to the target "
                f"{np.round(goal.position, 3).tolist()} m on a straight line with the orientation held, as {error}; "
                "choose another target, or say in a scene file where the obstacle is"
            ) from error
        path = start[None]
    for _ in range(tries):
        yield goal.position, path


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


def conflict(scene: Scene) -> str:
    """Why a scene is impossible, with the numbers; empty if it is possible.

    An obstacle lies in the arm or its base at the start, or the arm in a rigid body or itself; the flange would be
    inside an obstacle at the target; or the hand, in the orientation of the start, would be inside a rigid body or a
    fixed node there. A target of NaN conflicts with nothing.
    """
    reasons = (_conflict_with(obstacle, scene) for obstacle in scene.obstacles)
    return _rigid_conflict(scene) or next(filter(None, reasons), "")


def _rigid_conflict(scene: Scene) -> str:
    """How the arm lies in a rigid body or itself at the start, or the hand does at the target; empty if it does not."""
    arm = scene.arm
    for pair in nearest(arm, scene.start[None], scene.environment):
        if pair.distance < -_TOLERANCE:
            return f"at the start {pair}; move that body in section environment, or change target.start"
    if not np.isfinite(scene.target).all():
        return ""
    try:
        rotation = None if scene.orientation == FREE else link_frames(arm, scene.start)[0][-1]
        check_hand(arm, Target(scene.target, rotation).of_task(arm.task), scene.environment)
    except InputError as error:
        return str(error)
    return ""


def _conflict_with(obstacle: Obstacle, scene: Scene) -> str:
    """How an obstacle lies in the arm or base at the start, or where the flange is to go; empty if it does not."""
    arm, radius, remedy = scene.arm, obstacle.radius, f"move {obstacle.kind}.center, or change"
    starts, ends = (points[0] for points in shape_segments(arm, scene.start[None]))
    outline = obstacle.outline
    depths = overlap_depths(arm, starts, ends, outline, radius)
    shape, index = np.unravel_index(depths.argmax(), depths.shape)
    if depths[shape, index] > _TOLERANCE:
        return (
            f"at the start {shape_name(arm, int(shape))} lies {1000 * depths[shape, index]:.1f} mm deep in "
            f"{_sphere(obstacle, outline[index])}; {remedy} target.start"
        )
    name = f"target {np.round(scene.target, 3).tolist()} m"
    inside = radius - np.linalg.norm(outline - scene.target, axis=1)
    index = inside.argmax()
    if inside[index] > _TOLERANCE:
        return (
            f"{name} lies {1000 * inside[index]:.1f} mm inside {_sphere(obstacle, outline[index])}; {remedy} the target"
        )
    if scene.orientation == FREE:
        return ""
    shift = scene.target - link_frames(arm, scene.start)[1][-1]
    moved = overlap_depths(arm, starts[moving(arm)] + shift, ends[moving(arm)] + shift, obstacle.rest, radius)
    in_hand: Array = np.where(obstacle.fixed, moved[on_hand(arm)].max(axis=0, initial=-np.inf), -np.inf)
    index = in_hand.argmax()
    if in_hand[index] > _TOLERANCE:
        return (
            f"{name}: there the hand lies {1000 * in_hand[index]:.1f} mm deep in "
            f"{_sphere(obstacle, obstacle.rest[index])}, which is fixed; {remedy} the target"
        )
    return ""


def _sphere(obstacle: Obstacle, place: Array) -> str:
    """Describe the sphere at a place (3,), m, in words."""
    return f"{obstacle.name} (at {np.round(place, 3).tolist()} m, radius {obstacle.radius:g} m)"
