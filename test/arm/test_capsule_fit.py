"""Capsules around collision shapes: exact where the shape is one, around everything, and hardly larger than need be."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from contact_reach_ros.arm.capsule_fit import Fit, fit_capsule
from contact_reach_ros.arm.collision_shapes import shape_balls
from contact_reach_ros.arm.urdf_tree import Shape

NOWHERE = np.eye(4)


def balls(kind: str, *size: float, place: np.ndarray = NOWHERE, file: str = "", urdf: Path = Path()) -> np.ndarray:
    return shape_balls(Shape(place, kind, size, file), urdf, {}, "link")


def depths(fit: Fit, around: np.ndarray) -> np.ndarray:
    """How deep each ball is inside the capsule, m."""
    axis = fit.end - fit.start
    share = np.clip((around[:, :3] - fit.start) @ axis / (axis @ axis), 0.0, 1.0)
    return fit.radius - around[:, 3] - np.linalg.norm(around[:, :3] - fit.start - share[:, None] * axis, axis=1)


def moved(seed: int) -> np.ndarray:
    place = np.eye(4)
    place[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    place[:3, 3] = (0.1, -0.2, 0.3)
    return place


def test_a_capsule_is_itself():
    place = moved(0)
    fit = fit_capsule(balls("capsule", 0.05, 0.2, place=place))
    ends = sorted([fit.start.tolist(), fit.end.tolist()])
    expected = sorted((place[:3, 3] + side * 0.1 * place[:3, 2]).tolist() for side in (-1, 1))
    np.testing.assert_allclose(ends, expected, rtol=0, atol=1e-12)
    assert fit.radius == 0.05 and fit.overhang < 0.01 and fit.volume_ratio == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("shape", [("cylinder", 0.05, 0.4), ("box", 0.1, 0.12, 0.5), ("cylinder", 0.1, 0.1)])
def test_the_capsule_holds_the_shape_and_is_small(shape):
    around = balls(*shape, place=moved(1))
    fit = fit_capsule(around)
    assert depths(fit, around).min() >= -1e-9
    # Around the shape's own axis, with the ends no farther out than the corners need.
    if shape[0] == "cylinder":
        radius, length = shape[1] / math.cos(math.pi / 24), shape[2]
    else:
        radius, length = 0.5 * math.hypot(*shape[1:3]), shape[3]
    wide = np.linspace(radius, 3.0 * radius, 400)
    straight = np.maximum(length - 2.0 * np.sqrt(wide**2 - radius**2), 0.0)
    assert fit.volume <= 1.01 * (math.pi * wide**2 * (straight + 4.0 / 3.0 * wide)).min()
    assert fit.volume_ratio > 1.0 and 0.0 < fit.overhang < fit.radius


def test_meshes_are_found_beside_the_urdf_and_in_packages_above_it(tmp_path):
    mesh = trimesh.creation.cylinder(radius=0.05, height=0.3)
    (tmp_path / "arm_description" / "meshes").mkdir(parents=True)
    (tmp_path / "arm_description" / "urdf").mkdir()
    mesh.export(tmp_path / "arm_description" / "meshes" / "link.stl")
    urdf = tmp_path / "arm_description" / "urdf" / "arm.urdf"
    found = [
        balls("mesh", 1.0, 1.0, 1.0, file=name, urdf=urdf)
        for name in ("../meshes/link.stl", "package://arm_description/meshes/link.stl")
    ]
    np.testing.assert_array_equal(*found)
    half = balls("mesh", 0.5, 0.5, 0.5, file="../meshes/link.stl", urdf=urdf)
    assert fit_capsule(half).radius == pytest.approx(0.5 * fit_capsule(found[0]).radius, rel=0.02)
