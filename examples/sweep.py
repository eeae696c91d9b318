"""A sweep over scenes and seeds with one planner, which is compiled once, and a table at the end.

Usage: python sweep.py [--scenes ball free] [--seeds 3]

The same scene and seed give the same row on every run. A run takes some seconds; compiling the planner takes up to a
minute the first time.
"""

import argparse

import numpy as np

import contact_reach_ros as cr

parser = argparse.ArgumentParser()
parser.add_argument("--scenes", nargs="+", default=["free", "ball", "ball_mismatch", "wall"])
parser.add_argument("--seeds", type=int, default=3)
arguments = parser.parse_args()

arm = cr.load_arm("iiwa14")
scenes = [cr.load_scene(name, arm=arm, seed=seed) for name in arguments.scenes for seed in range(arguments.seeds)]
core = cr.make_planner(arm, max(cr.sphere_capacity(scene) for scene in scenes)).core
core.warm_up(print)

rows: list[tuple[cr.Scene, cr.Result]] = []
for scene in scenes:
    core.reseed(scene.seed)
    stack = cr.Stack(scene, planner=core, seed=scene.seed)
    result = stack.run(cr.Goal(scene.target))
    rows.append((scene, result))
    print(f"{scene.name} {scene.seed}: {'reached' if result.reached else result.stop_reason or 'out of time'}")

print(f"\n{'scene':14s} runs  reached  median time  largest contact")
for name in arguments.scenes:
    results = [result for scene, result in rows if scene.name == name]
    reached = [result.duration for result in results if result.reached]
    time = f"{np.median(reached):9.2f} s" if reached else "          –"
    force = max(result.max_contact_force for result in results)
    print(f"{name:14s} {len(results):4d}  {len(reached):7d}  {time}  {force:13.1f} N")
