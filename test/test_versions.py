"""The NumPy of this package is newer than the one that ROS 2 Jazzy is built with on Ubuntu 24.04."""

import os
import subprocess
import sys
import zipfile

import pytest
from message_packages import message_packages

SYSTEM_NUMPY = "1.26.4"
EXCHANGE = """
import numpy as np
from lbr_fri_idl.msg import LBRState
from rclpy.serialization import deserialize_message, serialize_message
sent = LBRState(measured_torque=np.arange(7.0))
print(deserialize_message(serialize_message(sent), LBRState).measured_torque.tolist(), np.__version__)
"""


@pytest.mark.slow
def test_messages_compiled_against_the_systems_numpy_carry_arrays_of_this_one(tmp_path):
    options = ["-q", "--no-deps", "--only-binary=:all:", "-d", tmp_path]
    pip = [sys.executable, "-m", "pip", "download", *options, f"numpy=={SYSTEM_NUMPY}"]
    if subprocess.run(pip, capture_output=True).returncode:
        pytest.skip(f"NumPy {SYSTEM_NUMPY} cannot be downloaded for this Python")
    (wheel,) = tmp_path.glob("numpy-*.whl")
    zipfile.ZipFile(wheel).extractall(tmp_path)
    folders = message_packages(tmp_path, tmp_path / "numpy" / "core" / "include")
    if not folders:
        pytest.skip("the packages are installed, compiled by others")
    env = {**os.environ, "PYTHONPATH": folders[0]}
    answer = subprocess.run([sys.executable, "-c", EXCHANGE], env=env, capture_output=True, text=True)
    assert answer.stdout.startswith("[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0] 2."), answer.stderr
