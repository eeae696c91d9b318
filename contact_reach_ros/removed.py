"""What version 0.3.0 removed, each with one sentence that says what to do; the next version drops this table."""

from __future__ import annotations

import sys
from collections.abc import Mapping

VERSION = "0.3.0"

_FAULTS = (
    "inject faults in Python with SimulatedRobot(scene, faults=[...]), see docs/faults.md; kill -STOP freezes a node"
)
_CHECKOUT = "run it in a checkout of the repository: make bench NAME="
_MEASURED_ONCE = "its results are in benchmarks/README.md"
_NOT_TUNED = "leave it out; it is fixed at "

PARAMETERS: Mapping[str, Mapping[str, str]] = {
    "driver": {
        "faults": _FAULTS,
        "sensors.position_noise": _NOT_TUNED + "1e-5 rad, and mismatch.noise_scale of a scene multiplies it",
        "sensors.position_resolution": _NOT_TUNED + "1e-5 rad",
        "sensors.velocity_noise": _NOT_TUNED + "1e-3 rad/s, and mismatch.noise_scale of a scene multiplies it",
        "sensors.torque_noise": _NOT_TUNED + "0.05 Nm, and mismatch.noise_scale of a scene multiplies it",
        "joints.hold_damping": _NOT_TUNED + "30 Nm s/rad",
        "joints.brake_torque": _NOT_TUNED + "150 Nm",
        "watchdog.open_after": _NOT_TUNED + "0.5 s",
    },
    "controller": {
        "impedance.singularity_floor": _NOT_TUNED + "0.03 1/kg",
        "limits.joint_limit_torque_share": _NOT_TUNED + "0.5; joint_limit_margin says where the repulsion begins",
        "limits.joint_limit_damping": _NOT_TUNED + "10 Nm s/rad of the strongest joint",
        "limits.null_velocity_share": _NOT_TUNED + "0.3",
        "limits.velocity_limit_share": _NOT_TUNED + "0.9",
        "limits.velocity_limit_rate": _NOT_TUNED + "100 1/s",
        "supervision.start_ramp": _NOT_TUNED + "0.5 s",
        "supervision.hold_blend": _NOT_TUNED + "0.3 s",
        "supervision.max_plan_lead": _NOT_TUNED + "1 s",
        "supervision.max_plan_duration": _NOT_TUNED + "1 s",
        "supervision.watch_rate": _NOT_TUNED + "250 Hz; watch_itself: false ends the controller's own watch",
        "supervision.observer_patience": _NOT_TUNED + "0.5 s; observer_timeout holds without an own watch",
        "supervision.correct_stop": _NOT_TUNED + "true",
        "supervision.velocity_share": "lower the velocity limits in the arm's file instead",
        "supervision.velocity_debounce": _NOT_TUNED + "3 ms",
        "supervision.stop_speed_gain": _NOT_TUNED + "0.5 rad/s",
        "supervision.stop_creep": _NOT_TUNED + "0.01 rad",
        "supervision.rest_within": _NOT_TUNED + "0.5 s; drive_brakes: false damps for as long as it takes",
        "supervision.brake_after": _NOT_TUNED + "2 s; drive_brakes: false damps for as long as it takes",
    },
    "observer": {
        "safety.contact_release": _NOT_TUNED + "0.6",
        "safety.release_debounce": _NOT_TUNED + "50 ms",
        "safety.handover_debounce": _NOT_TUNED + "30 ms",
        "safety.mean_time": _NOT_TUNED + "300 ms",
        "safety.model_error_per_rad": _NOT_TUNED + "1 1/rad; scale model_error of the contact budget instead",
        "safety.model_error_at_rest": _NOT_TUNED + "0.3; scale contact_thresholds of the contact budget instead",
        "safety.reset_share": _NOT_TUNED + "0.5",
        "plausibility.frozen_time": _NOT_TUNED + "30 ms",
        "plausibility.frozen_torque_time": _NOT_TUNED + "200 ms",
    },
    "planner": {
        "planning.cpus": "leave it out: plans use one core (cpus, the CPUs that the node may run on, stays)",
        "planning.least_population": "set planning.population to as many candidates as the device has memory for",
        "planning.contact_patience_share": "leave it out: the weight of contact recovers as soon as a plan expects "
        "more than the permitted force",
        "unexpected_contact.radius": "leave it out: it belonged to the reaction replan, which is gone",
    },
    "adapter": {
        "on_silence": "leave it out: harmless torques always damp",
        "torque_rate": "leave it out: it is the controller's default, and 1000 Nm/s with kind: franka",
        "resume_ramp": _NOT_TUNED + "0.5 s",
        "effort.manager": "remap the service instead: -r controller_manager/switch_controller:=...",
        "franka.manager": "remap the service instead: -r controller_manager/switch_controller:=...",
        "franka.reflexes": "remap the service instead: -r service_server/set_full_collision_behavior:=...",
        "franka.reflex_torques": "leave it out, or set the reflexes by hand and set_reflexes: false",
        "franka.reflex_force": "leave it out, or set the reflexes by hand and set_reflexes: false",
        "franka.reflex_moment": "leave it out, or set the reflexes by hand and set_reflexes: false",
    },
    "viewer": {
        "dark": "append ?darkMode to the page's address",
        "shadows": "leave it out: shadows are always drawn",
    },
}
"""Parameters by node and full name."""

COMMANDS: Mapping[str, str] = {
    "tool": "a running stack keeps its tool. Stop the arm (contact-reach stop) and let the brakes close, end the "
    "stack, put the section 'tool' under '/**: ros__parameters:' in the parameter file, and start it again with this "
    "file; see docs/real_robot.md",
    **{
        f"bench {name}": _CHECKOUT + name
        for name in (
            *("table1", "fig5", "clutter", "setting", "solver", "planner"),
            *("model", "foam", "observer", "stops", "smoothness", "faults"),
        )
    },
    "bench bags": "contact-reach bag info counts the lost messages of a recording",
    "bench floor": _MEASURED_ONCE,
    "bench page": "run `make -C benchmarks` in a checkout of the repository",
    "bench --ticks": "leave it out: bench times the controller in the running stack",
    "report --csv": "read the bag itself, an mcap file, with ros2 bag or Foxglove; --json writes the numbers",
    "report --with": "run contact-reach reexecute BAG --with FILE",
    "view --dark": "append ?darkMode to the page's address",
}
"""Commands of `contact-reach` by their first words, and options by command and name."""

EXECUTABLES: Mapping[str, str] = {"faults": _FAULTS}
"""Executables of `ros2 run`."""

_SENTENCES = {name: sentence for parameters in PARAMETERS.values() for name, sentence in parameters.items()}


def removed_parameter(name: str) -> str:
    """Why a node has no parameter of this full name any more, and what to do; empty if it never had."""
    return _refusal(name, _SENTENCES.get(name, ""))


def removed_command(words: list[str]) -> str:
    """Why `contact-reach` does not take these arguments any more, and what to do; empty if it does, or never did."""
    options = [word.partition("=")[0] for word in words if word.startswith("--")]
    names = [*words[:1], " ".join(words[:2]), *(f"{words[0]} {option}" for option in options)]
    return next((_refusal(name, COMMANDS[name]) for name in names if name in COMMANDS), "")


def removed_executable() -> None:
    """Entry point of the executables that are gone: end with exit code 2 and what to do instead."""
    name = sys.argv[0].rpartition("/")[2]
    print(_refusal(name, EXECUTABLES[name]), file=sys.stderr)
    sys.exit(2)


def _refusal(name: str, sentence: str) -> str:
    return f"'{name}' was removed in {VERSION}: {sentence}" if sentence else ""
