"""The closed loop, step by step: one step of 1 ms controls, observes, plans if a plan is due, and moves the robot.

`Stack.run` is this loop; write it yourself to watch, log or interfere. Compiling the planner takes up to a minute the
first time.
"""

import numpy as np

import contact_reach_ros as cr

TIMEOUT = 20.0
scene = cr.load_scene("ball", arm=cr.load_arm("iiwa14"), seed=3)
stack = cr.Stack(scene, seed=3)
stack.warm_up()  # compiles the planner
stack.settle()  # the brakes open, and the controller gets full authority
stack.command(cr.Goal(scene.target))

print("  time  distance  contact  ext. torque  plan  solve time")
plan, distance = None, np.inf
for step in range(round(TIMEOUT / 0.001)):
    tick = stack.step()
    plan = tick.plan or plan
    distance = float(np.linalg.norm(stack.tip_position - scene.target))
    done = distance < 0.01 or stack.stop_reason or stack.failure
    if plan is not None and tick.report is not None and (step % 200 == 0 or done):
        print(
            f"{step / 1000:5.1f} s  {1000 * distance:5.0f} mm  {stack.robot.contact_forces().max():5.1f} N"
            f"  {np.abs(tick.report.residual).max():8.1f} Nm  {plan.number:4d}  {1000 * plan.solve_s:7.0f} ms"
        )
    if done:
        break

print(stack.stop_reason or stack.failure or f"{1000 * distance:.1f} mm from the goal after {step / 1000:.2f} s")
