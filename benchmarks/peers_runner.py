"""The other projects' planners, run by the interpreter of their environment: `peers_runner.py NAME`.

Each line of the input is JSON: the settings of an episode, which has no answer, or a state, which is answered with a
plan and the CPU time that it took.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import judo
import mujoco
import numpy as np
from judo.controller import Controller, ControllerConfig
from judo.optimizers import CrossEntropyMethod, CrossEntropyMethodConfig
from judo.tasks import Task, TaskConfig
from mujoco.rollout import Rollout

# judo downloads the meshes of its own robots unless this folder is there; none of them is needed.
(judo.MODEL_PATH / "meshes").mkdir(exist_ok=True)

Settings = dict[str, Any]
Planner = Callable[[float, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From a time, s, qpos and qvel to times (N,), s, and references of the joints at them (N, n), rad."""


def soften(model: mujoco.MjModel, settings: Settings) -> None:
    """Give fixed spheres the stiffness that they were declared with, as the simulation does."""
    for body, weight in settings["inverse_weights"].items():
        model.body_invweight0[model.body(body).id, 0] = weight


def costs(model: mujoco.MjModel, settings: Settings, sensors: np.ndarray) -> np.ndarray:
    """What the planners minimise: mean over time (k,) from the readings (k, T, S) of the sensors."""

    def norm(sensor: str, origin: float | np.ndarray = 0.0) -> np.ndarray:
        first = model.sensor(sensor).adr[0]
        return np.linalg.norm(sensors[..., first : first + 3] - origin, axis=-1)

    force, speed = np.max([norm(name) for name in settings["force_sensors"]], axis=0), norm("tip_velocity")
    cost = settings["goal_weight"] * norm("tip", np.array(settings["target"]))
    cost += settings["contact_weight"] * force
    cost += settings["contact_limit_weight"] * np.maximum(force - settings["permitted_force"], 0.0)
    cost += settings["rest_weight"] * speed + settings["speed_weight"] * np.maximum(speed - settings["speed"], 0.0)
    return cost.mean(axis=1)


class Reach(Task[TaskConfig]):
    """The task as judo has it; references lead the arm by no more than `lead`."""

    config_t = TaskConfig

    def __init__(self, model_path: str, settings: Settings) -> None:
        self.settings, self.q = settings, np.array(settings["start"])
        super().__init__(model_path)
        soften(self.model, settings)

    @property
    def actuator_ctrlrange(self) -> np.ndarray:
        """(n, 2), rad, about the present posture."""
        return self.q[:, None] + self.settings["lead"] * np.array([-1.0, 1.0])

    def optimizer_warm_start(self) -> np.ndarray:
        """The present posture (n,), rad."""
        return self.q

    def reward(self, states: np.ndarray, sensors: np.ndarray, controls: np.ndarray, system_metadata: Any = None) -> Any:
        """The cost, negative."""
        return -costs(self.model, self.settings, sensors)


def judo_cem(file: str, settings: Settings) -> Planner:
    """Judo's controller with its cross-entropy method and its rollouts."""
    task, (least, largest) = Reach(file, settings), settings["cem_sigma"]
    size = {"num_rollouts": settings["candidates"], "num_nodes": settings["knots"], "num_elites": settings["elites"]}
    optimizer = CrossEntropyMethod(CrossEntropyMethodConfig(sigma_min=least, sigma_max=largest, **size), task.nu)
    controller = Controller(ControllerConfig(horizon=settings["horizon"]), task, optimizer)

    def plan(now: float, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        task.q, controller.time, controller.current_state = qpos[: task.nu], now, np.concatenate([qpos, qvel])
        controller.update_action()
        return controller.times, controller.nominal_knots

    return plan


def predictive_sampling(file: str, settings: Settings) -> Planner:
    """The best of noisy copies of the last plan, with plain `mujoco.rollout`."""
    model = mujoco.MjModel.from_xml_path(file)
    soften(model, settings)
    data, rollout = mujoco.MjData(model), Rollout(nthread=1)
    knot_times = np.linspace(0.0, settings["horizon"], settings["knots"])
    step_times = np.arange(round(settings["horizon"] / model.opt.timestep)) * model.opt.timestep
    weights = np.transpose([np.interp(step_times, knot_times, unit) for unit in np.eye(settings["knots"])])
    times, best = knot_times, np.tile(settings["start"], (settings["knots"], 1))

    def plan(now: float, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal times, best
        q, lead = qpos[: model.nu], settings["lead"]
        nominal = np.transpose([np.interp(now + knot_times, times, column) for column in best.T])
        noise = settings["sampling_sigma"] * np.random.randn(settings["candidates"], *nominal.shape)
        noise[0] = 0.0
        knots = np.clip(nominal + noise, q - lead, q + lead)
        _, sensors = rollout.rollout(model, data, np.concatenate([[now], qpos, qvel]), weights @ knots)
        times, best = now + knot_times, knots[np.argmin(costs(model, settings, sensors))]
        return times, best

    return plan


def main(make: Callable[[str, Settings], Planner]) -> None:
    """Answer the lines of the input until it ends."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "scene.xml")
        for line in sys.stdin:
            message = json.loads(line)
            if "mjcf" in message:
                file.write_text(message["mjcf"])
                np.random.seed(message["seed"])
                plan, (nq, nv) = make(str(file), message), message["coordinates"]
                continue
            begin = time.process_time()
            times, knots = plan(message["time"], np.array(message["qpos"][:nq]), np.array(message["qvel"][:nv]))
            cpu = time.process_time() - begin
            print(json.dumps({"times": times.tolist(), "knots": knots.tolist(), "cpu_s": cpu}), flush=True)


if __name__ == "__main__":
    main({"judo": judo_cem, "rollout": predictive_sampling}[sys.argv[1]])
