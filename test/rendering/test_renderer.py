"""Pictures show the arm where it is, whatever makes them."""

import numpy as np
import pytest

from contact_reach_ros.errors import RenderingError
from contact_reach_ros.rendering.camera import frame
from contact_reach_ros.rendering.offscreen import BACKENDS
from contact_reach_ros.rendering.parts import arm_shapes, floor
from contact_reach_ros.rendering.renderer import RENDERERS, render
from contact_reach_ros.rendering.shapes import corners
from contact_reach_ros.rendering.view import Ghost, View
from contact_reach_ros.robot import iiwa14

HOME = np.array(iiwa14.HOME_POSITION)
TURNED = HOME + np.array([1.0, 0, 0, 0, 0, 0, 0])
CAMERA = frame([*arm_shapes(HOME), *arm_shapes(TURNED)], 160, 120)


def changed(first, second):
    return np.abs(first.astype(int) - second).max(axis=2) > 20


@pytest.mark.parametrize("renderer", [name for name in RENDERERS if name != "auto"])
def test_the_arm_is_seen_and_moves_with_its_joints(renderer):
    shapes = [[], arm_shapes(HOME), arm_shapes(TURNED)]
    views = [View(each, CAMERA, floor()) for each in shapes]
    views.append(View(arm_shapes(HOME), CAMERA, floor(), [Ghost(arm_shapes(TURNED), 0.5)]))
    try:
        rendering = render(views, renderer)
    except RenderingError as error:
        assert renderer in BACKENDS and renderer in str(error)
        pytest.skip(str(error))
    assert rendering.renderer == renderer
    empty, home, turned, ghost = rendering.pictures
    assert empty.shape == (120, 160, 3)
    assert changed(empty, home).mean() > 0.05
    assert changed(home, turned).mean() > 0.03
    # Where only the ghost is, all but what the solid arm puts in shadow.
    alone = changed(empty, turned) & ~changed(empty, home)
    expected = 0.5 * empty[alone] + 0.5 * turned[alone]
    assert np.median(np.abs(ghost[alone] - expected)) < 3


def test_without_opengl_the_picture_is_drawn(monkeypatch):
    def broken(views, backend):
        raise RenderingError(f"no {backend}")

    monkeypatch.setattr("contact_reach_ros.rendering.renderer.render_offscreen", broken)
    rendering = render([View(arm_shapes(HOME), CAMERA)])
    assert rendering.renderer == "matplotlib"
    assert rendering.refusals == ("no egl", "no osmesa")
    with pytest.raises(RenderingError, match="no egl"):
        render([View(arm_shapes(HOME), CAMERA)], "egl")


def test_an_unknown_renderer_is_refused_with_those_there_are():
    with pytest.raises(RenderingError, match=r"'opengl' is unknown.*egl.*matplotlib"):
        render([], "opengl")


@pytest.mark.parametrize("direction", [(0.75, -1.0, 0.5), (-1.0, 0.2, 0.1)])
def test_the_camera_sees_all_shapes_and_comes_as_near_as_it_can(direction):
    shapes = arm_shapes(HOME)
    camera = frame(shapes, 300, 200, direction, margin=0.0)
    pixels, depths = camera.project(np.concatenate([corners(shape) for shape in shapes]))
    share = pixels / [300, 200]
    assert (depths > 0).all()
    assert share.min() > -1e-9 and share.max() < 1 + 1e-9
    assert np.ptp(share, axis=0).max() == pytest.approx(1.0)
