"""`contact-reach arm check`: what there is, what was assumed, and a table."""

import re

from arm_simulation import ARM
from contact_reach_command import contact_reach

from contact_reach_ros.arm.urdf import build_urdf
from contact_reach_ros.arms import load_arm


def test_a_urdf_is_checked_and_written_as_a_table(tmp_path, capsys):
    (tmp_path / "arm.urdf").write_text(build_urdf(ARM))
    table = tmp_path / "table.yaml"
    assert contact_reach("arm", "check", tmp_path / "arm.urdf", "--table", table) == 0
    said = capsys.readouterr().out
    for expected in (
        "7 joints from lbr_link_0 to lbr_link_ee",
        "gravity 9.81 m/s² along -z of lbr_link_0",
        "task: pose, the most that its 7 joints can hold (6 of 6 rows)",
        "assumed: home",
    ):
        assert expected in said.replace("\n", " ")
    assert load_arm(str(table)).joint_names == ARM.joint_names


def test_what_is_refused_ends_with_the_message(tmp_path, capsys):
    (tmp_path / "arm.urdf").write_text(build_urdf(ARM).replace("revolute", "prismatic", 1))
    assert contact_reach("arm", "check", tmp_path / "arm.urdf") == 2
    assert "is of type prismatic" in capsys.readouterr().err


def test_what_is_doubtful_is_printed_and_logged(tmp_path, capsys, caplog):
    file = tmp_path / "arm.urdf"
    file.write_text(re.sub(r'mass value="[^"]*"', 'mass value="0.05"', build_urdf(ARM)))
    assert contact_reach("arm", "check", file) == 0
    assert "doubtful: inertias: the moving links weigh 0.35 kg" in capsys.readouterr().out
    load_arm(str(file))
    assert "the moving links weigh 0.35 kg" in caplog.text
