"""The compiled arithmetic: nothing is compiled while an arm waits, and it works where nothing can be kept."""

import os
import subprocess
import sys

import pytest

# In a process of its own, where no test has called a compiled function before.
TICKS = """
import numpy as np
from contact_reach_ros.control import kernels
from contact_reach_ros.control.controller import Controller, ControllerSettings
from contact_reach_ros.control.references import PoseKnots, PostureKnots
from contact_reach_ros.arms import load_arm

def compiled():
    functions = [value for value in vars(kernels).values() if hasattr(value, "nopython_signatures")]
    return sum(len(function.nopython_signatures) for function in functions)

ARM = load_arm()
controller = Controller(ARM, ControllerSettings())
before = compiled()
q, v = np.array(ARM.home), np.full(ARM.n, 0.1)
singular, fast = np.zeros(ARM.n), np.full(ARM.n, 1.4)
at_limit = q.copy()
at_limit[3] = ARM.upper[3] - 0.01
controller.start(q, v, 0)
position, rotation = controller.model.tip_pose(q)
controller.references.offer_poses(PoseKnots(1, (10**9,), position[None], rotation[None]), 1)
controller.references.offer_postures(PostureKnots(1, (10**9,), q[None]), 1)
for now_ns, state in enumerate(((q, v), (singular, v), (q, fast), (at_limit, v)), 2):
    torque = controller.tick(*state, now_ns, now_ns)
    assert np.isfinite(torque).all() and torque.any()
controller.stop("test")
controller.tick(q, v, 10, 10)
print(before, compiled(), kernels.tracking_torque.stats.cache_path)
"""
NOWHERE = "import numba.core.caching as caching; caching.CompileResultCacheImpl._locator_classes = []"


def run(code: str, **environment: str) -> list[str]:
    env = {**os.environ, **environment}
    result = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


@pytest.mark.parametrize(
    "kept", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["kept", "nowhere to keep it"]
)
def test_no_tick_compiles_anything(kept: bool) -> None:
    # Without a cache everything is compiled again, which takes a fraction of the time if nothing is optimised.
    before, after, where = run(TICKS) if kept else run(NOWHERE + TICKS, NUMBA_OPT="0")
    assert before == after != "0"
    assert (where != "None") == kept
