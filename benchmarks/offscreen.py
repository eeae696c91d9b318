"""Renders views with MuJoCo's OpenGL renderer, in a child process.

MuJoCo chooses its OpenGL backend when it is imported, and a broken driver may crash the process: therefore a child
process renders, with its own `MUJOCO_GL`. Run as a program, this module reads pickled views from its standard input and
writes their pictures to the file that is its argument.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.view import View, frame
from contact_reach_ros.drawing.shapes import Capsule, Mesh, Shape, Sphere
from contact_reach_ros.errors import RenderingError

Picture = NDArray[np.uint8]

_PACKAGES = {"egl": "libegl1", "osmesa": "libosmesa6"}
"""Packages of the OpenGL libraries in Debian and Ubuntu."""
BACKENDS = tuple(_PACKAGES)
"""Values of `MUJOCO_GL` that need no display."""

_UNAVAILABLE = 3
"""Exit status of the child if OpenGL is unavailable."""
_TIMEOUT = 300.0
"""Time for rendering all views, s, since a driver may hang."""
_LIGHT = np.array([0.25, -0.4, 0.88]) / np.linalg.norm([0.25, -0.4, 0.88])
"""Unit vector towards the light, base frame."""


_BALL = Sphere(np.zeros(3), 0.1, (1.0, 1.0, 1.0, 1.0))
_TRIAL = View([_BALL], frame([_BALL], 16, 16))


def find_backend() -> str:
    """The first of `BACKENDS` that renders a small picture on this machine.

    Raises `RenderingError` if none works; the message names the reason and what to install.
    """
    refusals = []
    for backend in BACKENDS:
        try:
            render([_TRIAL], backend)
        except RenderingError as error:
            refusals.append(str(error))
        else:
            return backend
    raise RenderingError("; ".join(refusals))


def render(views: Sequence[View], backend: str) -> list[Picture]:
    """Render views by one of `BACKENDS`, to pictures (height, width, 3).

    Raises `RenderingError` if this OpenGL does not work here; the message names the reason and what to install.
    """
    source = Path(__file__).parents[1]
    paths = [str(source), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "MUJOCO_GL": backend, "PYTHONPATH": os.pathsep.join(paths)}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pictures.npz"
        try:
            child = subprocess.run(
                [sys.executable, "-m", __name__, str(file)],
                input=pickle.dumps(list(views)),
                capture_output=True,
                env=environment,
                timeout=_TIMEOUT,
            )
        except subprocess.TimeoutExpired:
            raise RenderingError(f"renderer '{backend}' did not finish within {_TIMEOUT:g} s") from None
        output = child.stderr.decode(errors="replace").strip()
        # If the driver crashes, a signal ends the child.
        if child.returncode == _UNAVAILABLE or child.returncode < 0:
            reason = output.splitlines()[-1] if output else f"exit status {child.returncode}"
            raise RenderingError(
                f"renderer '{backend}' does not work on this machine ({reason}): install its OpenGL library, in Debian "
                f"and Ubuntu the package {_PACKAGES[backend]}"
            )
        if child.returncode != 0:
            raise RuntimeError(f"the process that renders failed:\n{output}")
        with np.load(file) as pictures:
            return [pictures[f"arr_{index}"] for index in range(len(views))]


def _draw(view: View) -> Picture:
    import mujoco

    camera = view.camera
    spec = mujoco.MjSpec()
    settings = spec.visual
    settings.global_.offwidth, settings.global_.offheight = camera.width, camera.height
    settings.quality.offsamples = 4
    settings.quality.shadowsize = 4096
    settings.headlight.ambient = [0.5] * 3
    settings.headlight.diffuse = [0.25] * 3
    settings.headlight.specular = [0.0] * 3
    settings.map.znear, settings.map.zfar = 0.01, 50.0
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[1.0] * 3,
        rgb2=[1.0] * 3,
        width=8,
        height=48,
    )
    world = spec.worldbody
    world.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=3.0 * _LIGHT,
        dir=-_LIGHT,
        diffuse=[0.3] * 3,
        specular=[0.15] * 3,
        castshadow=True,
    )
    orientation = np.empty(4)
    mujoco.mju_mat2Quat(orientation, camera.axes.T.ravel())
    world.add_camera(name="camera", pos=camera.eye, quat=orientation, fovy=np.degrees(camera.field_of_view))
    shapes = [*view.shapes, *([] if view.floor is None else [view.floor])]
    for number, shape in enumerate(shapes):
        _add(spec, f"shape_{number}", shape)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, camera.height, camera.width, max_geom=len(shapes) + 10) as renderer:
        renderer.update_scene(data, "camera")
        return renderer.render().copy()


def _add(spec: mujoco.MjSpec, name: str, shape: Shape) -> None:  # type: ignore[name-defined] # noqa: F821
    import mujoco

    common = {"rgba": shape.colour, "contype": 0, "conaffinity": 0}
    if isinstance(shape, Sphere):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=shape.center, size=[shape.radius, 0.0, 0.0], **common
        )
    elif isinstance(shape, Mesh):
        _add_mesh(spec, name, shape)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **common)
    else:
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE if isinstance(shape, Capsule) else mujoco.mjtGeom.mjGEOM_CYLINDER
        ends = np.concatenate([shape.start, shape.end])
        spec.worldbody.add_geom(type=kind, fromto=ends, size=[shape.radius, 0.0, 0.0], **common)


def _add_mesh(spec: mujoco.MjSpec, name: str, mesh: Mesh) -> None:  # type: ignore[name-defined] # noqa: F821
    import mujoco

    spec.add_mesh(
        name=name,
        uservert=mesh.vertices.ravel(),
        userface=mesh.faces.ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )


def _main(file: str) -> None:
    try:
        import mujoco

        mujoco.GLContext(8, 8).free()
    except Exception as error:  # whatever it is, the parent tries another backend and reports why
        print(f"{type(error).__name__}: {error}", file=sys.stderr)
        sys.exit(_UNAVAILABLE)
    views = pickle.load(sys.stdin.buffer)
    np.savez(file, *(_draw(view) for view in views))


if __name__ == "__main__":
    _main(sys.argv[1])
