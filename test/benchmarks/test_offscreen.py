"""Pictures show the arm where it is, with each OpenGL library."""

import sys

import numpy as np
import pytest

from benchmarks.offscreen import BACKENDS, find_backend, render
from benchmarks.view import View, arm_shapes, floor, frame
from contact_reach_ros.arms import load_arm
from contact_reach_ros.drawing.shapes import corners
from contact_reach_ros.errors import RenderingError

ARM = load_arm()
HOME = np.array(ARM.home)
WITH_TOOL = HOME + np.array([1.0, 0, 0, 0, 0, 0, 0])
CAMERA = frame([*arm_shapes(ARM, HOME), *arm_shapes(ARM, WITH_TOOL)], 160, 120)


def changed(first, second):
    return np.abs(first.astype(int) - second).max(axis=2) > 20


@pytest.mark.parametrize("renderer", BACKENDS)
def test_the_arm_is_seen_and_moves_with_its_joints(renderer):
    shapes = [[], arm_shapes(ARM, HOME), arm_shapes(ARM, WITH_TOOL)]
    views = [View(each, CAMERA, floor()) for each in shapes]
    try:
        empty, home, turned = render(views, renderer)
    except RenderingError as error:
        assert f"'{renderer}'" in str(error)
        pytest.skip(str(error))
    assert empty.shape == (120, 160, 3)
    assert changed(empty, home).mean() > 0.05
    assert changed(home, turned).mean() > 0.03


def test_the_first_backend_that_works_is_taken(monkeypatch):
    def only_osmesa(views, backend):
        if backend != "osmesa":
            raise RenderingError(f"no {backend}")
        return []

    monkeypatch.setattr("benchmarks.offscreen.render", only_osmesa)
    assert find_backend() == "osmesa"


def test_without_opengl_one_learns_what_to_install(monkeypatch, tmp_path):
    python = tmp_path / "python"
    python.write_text("#!/bin/sh\necho 'ImportError: no such library' >&2\nexit 3\n")
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    with pytest.raises(RenderingError, match=r"'egl'.*no such library.*libegl1; .*'osmesa'.*libosmesa6"):
        find_backend()


@pytest.mark.parametrize("direction", [(0.75, -1.0, 0.5), (-1.0, 0.2, 0.1)])
def test_the_camera_sees_all_shapes_and_comes_as_near_as_it_can(direction):
    shapes = arm_shapes(ARM, HOME)
    camera = frame(shapes, 300, 200, direction, margin=0.0)
    pixels, depths = camera.project(np.concatenate([corners(shape) for shape in shapes]))
    share = pixels / [300, 200]
    assert (depths > 0).all()
    assert share.min() > -1e-9 and share.max() < 1 + 1e-9
    assert np.ptp(share, axis=0).max() == pytest.approx(1.0)
