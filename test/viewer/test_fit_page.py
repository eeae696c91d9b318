"""The page that shows capsules over the collision geometry."""

import numpy as np
from arm_simulation import ARM

from contact_reach_ros.arm.capsules import shape_radii, shape_segments, shapes
from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arm.urdf_reader import read_arm
from contact_reach_ros.viewer.access import serve
from contact_reach_ros.viewer.fit import fit_meshes, show_fit


def test_geometry_is_drawn_inside_of_the_capsules_of_its_link(tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(build_urdf(ARM))
    arm, _, _, geometry = read_arm(file)
    shown, capsules = fit_meshes(arm, geometry)
    assert {link for link, _ in shown} >= set(ARM.link_names[1:])
    assert len(capsules) == len(shapes(arm))
    starts, ends = shape_segments(arm, np.array([arm.home]))
    for number, (name, capsule) in enumerate(capsules):
        start, axis, radius = starts[0, number], ends[0, number] - starts[0, number], shape_radii(arm)[number]

        def away(points, start=start, axis=axis):
            share = np.clip((points - start) @ axis / (axis @ axis), 0.0, 1.0)
            return np.linalg.norm(points - start - share[:, None] * axis, axis=1)

        np.testing.assert_allclose(away(capsule.vertices), radius, rtol=0.02)
        inside = [mesh.vertices for link, mesh in shown if link == name]
        # The lattice of a cylinder stands out of the capsule between its spheres by a hundredth of the radius.
        assert away(np.concatenate(inside)).max() < 1.02 * radius
    server = serve(0, "test")
    try:
        show_fit(server, arm, geometry)
    finally:
        server.stop()
