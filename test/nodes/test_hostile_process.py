"""Names that no file can have end a process with a message that quotes them."""

import subprocess

import pytest
from stack_helpers import environment, module

LONG_NAME = "a" * 300


@pytest.mark.parametrize(
    "command",
    [
        [*module("nodes.driver"), "--ros-args", "-p", f"scene:={LONG_NAME}"],
        [*module("nodes.recorder"), "--ros-args", "-p", f"bag:={LONG_NAME}"],
        [*module("bringup.bringup"), "--ros-args", "-p", f"parameters:={LONG_NAME}"],
    ],
    ids=["scene", "bag", "parameters"],
)
def test_a_name_that_no_file_can_have_is_refused(command):
    result = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60)
    assert result.returncode not in (0, -9)
    assert LONG_NAME[:20] in result.stderr
    assert "Traceback" not in result.stderr
