"""Spheres: which ones are refused, and what becomes of too many and too few."""

import tracemalloc

import numpy as np
import pytest
from arm_simulation import ARM, HOME, rotation_about

from contact_reach_ros.errors import InputError
from contact_reach_ros.planning.obstacles import ObstacleReader
from contact_reach_ros.world.collision import clearances
from contact_reach_ros.world.goal import Target
from contact_reach_ros.world.spheres import Spheres


def row_of_spheres(order: list[int], **changes: np.ndarray) -> Spheres:
    """Along the x axis in front of the arm, number 0 nearest, each displaced by 10 mm."""
    count = len(order)
    center = np.column_stack([0.9 + 0.3 * np.array(order), np.zeros(count), np.full(count, 0.5)])
    values = {"radius": np.full(count, 0.1), "stiffness": np.full(count, 200.0), "damping": np.full(count, 20.0)}
    return Spheres(**({"center": center, "rest": center + 0.01} | values | changes))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("center", np.zeros((1, 3)), "sphere center: expected shape"),
        ("radius", np.array([0.1, 0.0]), "sphere radius: expected positive"),
        ("edges", np.array([[0, 2]]), "sphere edge_stiffness: expected shape"),
    ],
)
def test_spheres_that_make_no_sense_are_refused(name, value, message):
    with pytest.raises(InputError, match=message):
        row_of_spheres([0, 1], **{name: value})


def test_joined_spheres_need_one_spring_among_them():
    held, one = np.array([100.0, 0.0, 0.0]), np.ones(1)
    row_of_spheres([0, 1, 2], stiffness=held, edges=np.array([[0, 1], [1, 2]]), edge_stiffness=np.ones(2))
    with pytest.raises(InputError, match="nothing holds sphere 2"):
        row_of_spheres([0, 1, 2], stiffness=held, edges=np.array([[0, 1]]), edge_stiffness=one)
    with pytest.raises(InputError, match="sphere edges: expected indices from 0 to 2, got 0 to 3"):
        row_of_spheres([0, 1, 2], stiffness=held, edges=np.array([[0, 3]]), edge_stiffness=one)


def test_nearest_spheres_are_kept_the_others_counted_and_missing_ones_out_of_reach():
    obstacles = ObstacleReader(ARM, 2).read(HOME, row_of_spheres([3, 0, 4, 1, 2]))
    np.testing.assert_allclose(sorted(obstacles.center[0, :, 0]), [0.9, 1.2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(obstacles.rest - obstacles.center, 0.01, rtol=0, atol=1e-6)
    obstacles = ObstacleReader(ARM, 3).read(HOME, row_of_spheres([0]))
    assert obstacles.center.shape == (3, 3, 1)
    assert (np.linalg.norm(obstacles.center[:, 1:, 0], axis=0) > 50.0).all()


def test_a_capacity_below_zero_is_refused():
    with pytest.raises(InputError, match="a capacity of -1 spheres; expected 0"):
        ObstacleReader(ARM, -1)


def test_the_angle_from_a_goal_is_that_of_what_counts():
    about, across = rotation_about((0, 0, 1), 0.7), rotation_about((0, 1, 0), 0.4)
    whole, axis = Target(np.ones(3), np.eye(3)), Target(np.ones(3), np.eye(3), only_axis=True)
    assert whole.angle(about) == pytest.approx(0.7)
    assert axis.angle(across @ about) == pytest.approx(0.4)
    assert axis.angle(rotation_about((1, 0, 0), np.pi)) == pytest.approx(np.pi)
    assert Target(np.ones(3)).angle(across) == 0.0


def test_a_cloud_of_many_points_is_read_without_matrices_of_its_size():
    center = np.random.default_rng(0).uniform(-1.0, 1.0, (20_000, 3))
    size = np.ones(len(center))
    cloud = Spheres(center, center, 0.01 * size, 100.0 * size, 5.0 * size)
    tracemalloc.start()
    obstacles = ObstacleReader(ARM, 12).read(HOME, cloud)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1000 * len(center)
    nearest = np.sort(np.argsort(clearances(ARM, HOME, cloud))[:12])
    np.testing.assert_allclose(obstacles.center[:, :, 0].T, center[nearest], atol=1e-6)
