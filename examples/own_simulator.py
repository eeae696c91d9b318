"""Your own simulator in place of the package's: planner, controller and observer around a plain MuJoCo loop.

Nothing here uses `Stack` or `SimulatedRobot`. A driver of a real arm does the same: it passes on joint states, applies
torques, and tells the planner where obstacles are. Compiling the planner takes up to a minute the first time.
"""

from xml.etree import ElementTree

import mujoco
import numpy as np

import contact_reach_ros as cr
from contact_reach_ros.arm.mjcf import build_mjcf

GOAL = cr.Goal([0.5, 0.25, 0.35])
BALL, RADIUS, STIFFNESS, DAMPING = np.array([0.36, 0.27, 0.48]), 0.1, 100.0, 30.0  # m, m, N/m, N s/m

# A ball on springs. Bits 1 and 2 of the contact types are the arm's and the obstacles'.
axes = ("1 0 0", "0 1 0", "0 0 1")
slides = "".join(f'<joint type="slide" axis="{each}" stiffness="{STIFFNESS}" damping="{DAMPING}"/>' for each in axes)
ball = ElementTree.fromstring(
    f'<body name="ball" pos="{BALL[0]} {BALL[1]} {BALL[2]}" gravcomp="1">{slides}'
    f'<geom type="sphere" size="{RADIUS}" mass="0.1" contype="2" conaffinity="1" solref="-1000 -20"/></body>'
)
arm = cr.load_arm("iiwa14")
model = mujoco.MjModel.from_xml_string(build_mjcf(arm, obstacles=[ball]))
data = mujoco.MjData(model)
data.qpos[: arm.n] = arm.home

planner = cr.make_planner(arm, capacity=1)
controller = cr.Controller(arm, cr.ControllerSettings())
observer = cr.Observer(arm, cr.ObserverSettings(), cr.ContactBudget())
planner.core.warm_up(print)
torque, pressed = None, 0.0
for step in range(20_000):
    now_ns = step * round(model.opt.timestep * 1e9)
    state = cr.JointState(now_ns, data.qpos[: arm.n].copy(), data.qvel[: arm.n].copy(), data.ctrl.copy())
    report = observer.update(state)
    controller.hear(report.verdict, now_ns)
    torque = controller.update(state, now_ns)
    if why := planner.objection(report.contact) or controller.stop_reason:
        planner.withdraw(why)
        controller.withdraw()
    center = BALL + data.qpos[arm.n :]
    planner.see(cr.Spheres(center[None], BALL[None], [RADIUS], [STIFFNESS], [DAMPING]))
    if step == 0:
        planner.request(state)  # goals start from a joint state
        planner.command(GOAL)
    request = planner.request(state)
    if request is not None:
        controller.follow(planner.solve(request).references())
    data.ctrl[:] = 0.0 if torque is None else torque  # nothing is sent before the observer vouches for the arm
    mujoco.mj_step(model, data)
    distance = np.linalg.norm(data.site("flange").xpos - GOAL.position)
    pressed = max(pressed, STIFFNESS * np.linalg.norm(center - BALL))
    if distance < GOAL.tolerance or not planner.has_goal:
        break
print(planner.goal_state.reason or f"{1000 * distance:.1f} mm from the goal after {data.time:.2f} s")
print(f"the ball's springs were loaded with {pressed:.1f} N at most")
