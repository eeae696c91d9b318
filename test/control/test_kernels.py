"""Nothing is compiled while an arm waits."""

from contact_reach_command import python

# In a process of its own, where no test has called a compiled function before.
TICKS = """
import numpy as np
from contact_reach_ros.arm import JointState
from contact_reach_ros.control import kernels
from contact_reach_ros.control.controller import Controller
from contact_reach_ros.control.settings import ControllerSettings
from contact_reach_ros.control.references import References
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
controller.follow(References(1, (10**9,), position[None], rotation[None], q[None]))
for now_ns, state in enumerate(((q, v), (singular, v), (q, fast), (at_limit, v)), 2):
    torque = controller.update(JointState(now_ns, *state, None), now_ns)
    assert np.isfinite(torque).all() and torque.any()
controller.stop("test")
controller.update(JointState(10, q, v, None), 10)
print(before, compiled())
"""


def test_no_tick_compiles_anything() -> None:
    before, after = python(TICKS).split()
    assert before == after != "0"
