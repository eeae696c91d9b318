"""Plan once, without moving anything, and plot what the plan predicts.

Usage: python plan_once.py [PICTURE]

On the left the arm as it is and where the plan takes it, from the side; on the right how far each joint moves.
Needs matplotlib, of the extra `benchmarks`. Compiling the planner takes up to a minute the first time.
"""

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import contact_reach_ros as cr
from contact_reach_ros.arm import link_frames

picture = sys.argv[1] if len(sys.argv) > 1 else "plan.png"
arm = cr.load_arm("iiwa14")
scene = cr.load_scene("ball", arm=arm, seed=0)
stack = cr.Stack(scene)
plan = stack.plan(cr.Goal(scene.target))
print(f"{plan.steps} solver steps in {1000 * plan.solve_s:.0f} ms, cost {plan.cost:.3f}:")
for term, value in plan.cost_terms.items():
    print(f"  {term:15s} {value:7.3f}")
print(f"largest contact force expected: {plan.predicted_contact_forces.max():.1f} N")

figure, (side, joints) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
for q, color, label in ((stack.state.q, "lightgrey", "now"), (plan.predicted_q[-1], "tab:blue", "end of the plan")):
    origins = np.array([np.zeros(3), *link_frames(arm, q)[1]])
    side.plot(origins[:, 0], origins[:, 2], "o-", color=color, linewidth=3, markersize=4, label=label)
side.plot(*scene.target[[0, 2]], "k*", markersize=12, label="goal")
for obstacle in scene.obstacles:
    for center in obstacle.rest:
        side.add_patch(plt.Circle(center[[0, 2]], obstacle.radius, color="tab:orange", alpha=0.4, label=obstacle.kind))
side.set(xlabel="x in m", ylabel="z in m", aspect="equal")
side.legend()

times = plan.knot_duration_s * np.arange(len(plan.predicted_q))
for name, angle in zip(arm.joint_names, np.degrees(plan.predicted_q - plan.predicted_q[0]).T, strict=True):
    joints.plot(times, angle, "o-", label=name)
joints.set(xlabel="time from the effect of the plan in s", ylabel="motion of the joints in degrees")
joints.legend()
figure.savefig(picture)
print(f"wrote {picture}")
