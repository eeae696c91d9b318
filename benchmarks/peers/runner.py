"""The other projects' planners, run by the interpreter of their environment: `runner.py METHOD`.

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

Plan = tuple[np.ndarray, np.ndarray]
"""Times (N,), s, and references of the joints at them (N, n), rad."""


class Cost:
    """What both planners minimise, from the sensors of the model."""

    def __init__(self, model: mujoco.MjModel, settings: dict[str, Any]) -> None:
        self._settings = settings
        self._target = np.array(settings["target"])
        self._tip, self._velocity = (model.sensor(name).adr[0] for name in ("tip", "tip_velocity"))
        self._forces = [model.sensor(name).adr[0] for name in settings["force_sensors"]]

    def __call__(self, sensors: np.ndarray) -> np.ndarray:
        """Mean over time (k,) of readings (k, T, S)."""

        def norm(first: int, origin: float | np.ndarray = 0.0) -> np.ndarray:
            return np.linalg.norm(sensors[..., first : first + 3] - origin, axis=-1)

        given = self._settings
        force = np.max([norm(each) for each in self._forces], axis=0)
        cost = given["goal_weight"] * norm(self._tip, self._target) + given["contact_weight"] * force
        cost += given["contact_limit_weight"] * np.maximum(force - given["permitted_force"], 0.0)
        speed = norm(self._velocity)
        cost += given["rest_weight"] * speed + given["speed_weight"] * np.maximum(speed - given["speed"], 0.0)
        return cost.mean(axis=1)


class Reach(Task[TaskConfig]):
    """The task as judo has it; references lead the arm by no more than `lead`."""

    config_t = TaskConfig

    def __init__(self, model_path: str, settings: dict[str, Any]) -> None:
        self.settings, self.q = settings, np.array(settings["start"])
        super().__init__(model_path)
        _soften(self.model, settings)
        self.cost = Cost(self.model, settings)

    @property
    def actuator_ctrlrange(self) -> np.ndarray:
        """(n, 2), rad, about the present posture."""
        return self.q[:, None] + self.settings["lead"] * np.array([-1.0, 1.0])

    def optimizer_warm_start(self) -> np.ndarray:
        """The present posture (n,), rad."""
        return self.q

    def reward(self, states: np.ndarray, sensors: np.ndarray, controls: np.ndarray, system_metadata: Any = None) -> Any:
        """The cost, negative."""
        return -self.cost(sensors)


def judo_cem(file: str, settings: dict[str, Any]) -> Callable[[float, np.ndarray, np.ndarray], Plan]:
    """Judo's controller with its cross-entropy method and its rollouts."""
    task = Reach(file, settings)
    optimizer = CrossEntropyMethod(
        CrossEntropyMethodConfig(
            num_rollouts=settings["candidates"],
            num_nodes=settings["knots"],
            sigma_min=settings["cem_sigma"][0],
            sigma_max=settings["cem_sigma"][1],
            num_elites=settings["elites"],
        ),
        task.nu,
    )
    controller = Controller(ControllerConfig(horizon=settings["horizon"]), task, optimizer)

    def plan(now: float, qpos: np.ndarray, qvel: np.ndarray) -> Plan:
        task.q = qpos[: task.nu]
        controller.time = now
        controller.current_state = np.concatenate([qpos, qvel])
        controller.update_action()
        return controller.times, controller.nominal_knots

    return plan


def predictive_sampling(file: str, settings: dict[str, Any]) -> Callable[[float, np.ndarray, np.ndarray], Plan]:
    """The best of noisy copies of the last plan, with plain `mujoco.rollout`."""
    model = mujoco.MjModel.from_xml_path(file)
    _soften(model, settings)
    data, rollout, cost = mujoco.MjData(model), Rollout(nthread=1), Cost(model, settings)
    knot_times = np.linspace(0.0, settings["horizon"], settings["knots"])
    step_times = np.arange(0.0, settings["horizon"] - 1e-9, model.opt.timestep)
    weights = np.array([np.interp(step_times, knot_times, unit) for unit in np.eye(settings["knots"])]).T
    times, best = knot_times, np.tile(settings["start"], (settings["knots"], 1))

    def plan(now: float, qpos: np.ndarray, qvel: np.ndarray) -> Plan:
        nonlocal times, best
        q = qpos[: model.nu]
        nominal = np.array([np.interp(now + knot_times, times, column) for column in best.T]).T
        noise = settings["sampling_sigma"] * np.random.randn(settings["candidates"], *nominal.shape)
        noise[0] = 0.0
        knots = np.clip(nominal + noise, q - settings["lead"], q + settings["lead"])
        _, sensors = rollout.rollout(model, data, np.concatenate([[now], qpos, qvel]), weights @ knots)
        times, best = now + knot_times, knots[np.argmin(cost(sensors))]
        return times, best

    return plan


def _soften(model: mujoco.MjModel, settings: dict[str, Any]) -> None:
    """Give fixed spheres the stiffness that they were declared with, as the simulation does."""
    for body, weight in settings["inverse_weights"].items():
        model.body_invweight0[model.body(body).id, 0] = weight


def main(make: Callable[[str, dict[str, Any]], Callable[[float, np.ndarray, np.ndarray], Plan]]) -> None:
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
