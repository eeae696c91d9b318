"""Capsules around balls: exact where these are a capsule, around everything, and hardly larger than need be."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.capsule_fit import POOR, Fit, cover, fit_capsule

RIM = 24


def moved(points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of a frame that stands askew, as balls without a radius."""
    turn = Rotation.random(rng=np.random.default_rng(0)).as_matrix()
    return np.column_stack([points @ turn.T + (0.1, -0.2, 0.3), np.zeros(len(points))])


def cylinder(radius: float, length: float) -> np.ndarray:
    angles = np.linspace(0.0, 2.0 * np.pi, RIM, endpoint=False)
    x, y = radius * np.cos(angles), radius * np.sin(angles)
    return np.concatenate([np.column_stack([x, y, np.full(RIM, 0.5 * side * length)]) for side in (-1, 1)])


def box(*sides: float) -> np.ndarray:
    return 0.5 * np.array(sides) * np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])


def depths(fit: Fit, around: np.ndarray) -> np.ndarray:
    """How deep each ball is inside the capsule, m."""
    axis = fit.end - fit.start
    share = np.clip((around[:, :3] - fit.start) @ axis / (axis @ axis), 0.0, 1.0)
    return fit.radius - around[:, 3] - np.linalg.norm(around[:, :3] - fit.start - share[:, None] * axis, axis=1)


@pytest.mark.parametrize(
    ("points", "radius", "length"),
    [
        (cylinder(0.05, 0.4), 0.05, 0.4),
        (cylinder(0.1, 0.1), 0.1, 0.1),
        (box(0.1, 0.12, 0.5), 0.5 * math.hypot(0.1, 0.12), 0.5),
    ],
)
def test_the_capsule_holds_the_shape_and_is_small(points, radius, length):
    around = moved(points)
    fit = fit_capsule(around)
    assert depths(fit, around).min() >= -1e-9 and fit.volume_ratio > 1.0
    # Around the shape's own axis, with the ends no farther out than the corners need.
    wide = np.linspace(radius, 3.0 * radius, 400)
    straight = np.maximum(length - 2.0 * np.sqrt(wide**2 - radius**2), 0.0)
    volume = math.pi * fit.radius**2 * (np.linalg.norm(fit.end - fit.start) + 4.0 / 3.0 * fit.radius)
    assert volume <= 1.01 * (math.pi * wide**2 * (straight + 4.0 / 3.0 * wide)).min()


def random_balls(random: np.random.Generator) -> np.ndarray:
    """Balls of few different radii, some of them none, each of them nearly the same a second time."""
    count = random.integers(1, 9)
    balls = np.column_stack([random.uniform(-0.2, 0.2, (count, 3)), random.choice([0.0, 0.03, 0.1, 0.1 + 1e-9], count)])
    return np.concatenate([balls, balls + random.uniform(-1e-9, 1e-9, balls.shape) * [1, 1, 1, 0]])


@pytest.mark.parametrize("seed", range(20))
def test_balls_that_are_nearly_equal_are_all_inside(seed):
    balls = random_balls(np.random.default_rng(seed))
    assert depths(fit_capsule(balls), balls).min() >= -2e-5
    around = fit_capsule(balls, on_axis=True)
    assert depths(around, balls).min() >= -2e-5
    assert not any((*around.start[:2], *around.end[:2]))


@pytest.mark.parametrize("apart", [0.0, 2e-4, 9e-4, 1e-3 - 1e-16, 1e-3])
def test_two_balls_beside_each_other_are_inside(apart):
    """Whatever the direction: a capsule has a length of at least 1 mm."""
    for direction in np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(0).normal(size=(20, 3))]):
        second = np.array([0.1, 0.2, 0.3]) + apart * direction / np.linalg.norm(direction)
        balls = np.array([[0.1, 0.2, 0.3, 0.06], [*second, 0.06]])
        assert depths(fit_capsule(balls), balls).min() >= -2e-5


@pytest.mark.parametrize("length", [0.0588, 0.03, 0.0012])
def test_short_cylinders_are_inside(length):
    """As their rims are balls of no radius, the segment is as short as it may be."""
    turn = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    rim = np.stack([0.0602 * np.cos(turn), 0.0602 * np.sin(turn)], axis=1)
    points = np.vstack([np.column_stack([rim, np.full(64, z)]) for z in (-0.5 * length, 0.5 * length)])
    for frame in (np.eye(3), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]):
        balls = np.column_stack([points @ frame.T, np.zeros(len(points))])
        assert depths(fit_capsule(balls), balls).min() >= -2e-5


def test_a_sphere_and_a_capsule_stay_what_they_are_beside_smaller_things():
    ball, small = [0.1, 0.2, 0.3, 0.08], [0.1, 0.2, 0.32, 0.05]
    sphere = fit_capsule(np.array([ball, small, ball]))
    assert sphere.radius == pytest.approx(0.08, abs=1e-6) and sphere.volume_ratio < 1.05
    turned = moved(cylinder(0.07, 0.4))
    ends = turned.reshape(2, RIM, 4).mean(axis=1) + np.array([0.0, 0.0, 0.0, 0.07])
    capsule = fit_capsule(np.concatenate([ends, turned]))
    assert capsule.radius == pytest.approx(0.07, abs=1e-6)
    assert np.linalg.norm(capsule.end - capsule.start) == pytest.approx(0.4, abs=1e-6)


@pytest.mark.parametrize(
    ("shape", "most"),
    [
        (box(1.5, 1.0, 0.05), POOR),
        (box(0.8, 0.6, 0.3), POOR),
        (box(0.5, 0.5, 0.5), 2.8),
        (box(4.0, 4.0, 0.1), math.inf),
    ],
    ids=["table", "platform", "cube", "floor"],
)
def test_slices_of_a_plate_are_all_inside_its_capsules(shape, most):
    fits = cover(moved(shape))
    points = moved(np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 3)) * shape.max(axis=0))
    assert np.max([depths(fit, points) for fit in fits], axis=0).min() >= -1e-9
    assert max(fit.volume_ratio for fit in fits) < most
    assert sum(fit.volume for fit in fits) <= fit_capsule(moved(shape)).volume


def test_of_flat_shapes_no_capsule_is_a_good_fit():
    flat = box(0.1, 0.2, 0.0)
    fit = fit_capsule(moved(flat))
    assert math.isinf(fit.volume_ratio) and depths(fit, moved(flat)).min() >= -1e-9
