"""What version 0.3.0 removed, each with one sentence that says what to do; the next version drops this table."""

from __future__ import annotations

from collections.abc import Mapping

VERSION = "0.3.0"

_FAULTS = "inject faults in Python, in a checkout of the repository, see docs/faults.md; kill -STOP freezes a node"
_CHECKOUT = "run it in a checkout of the repository: make bench NAME="
_MEASURED_ONCE = "its results are in benchmarks/README.md"
_MEASURED = "leave it out: it belonged to torque_source: commanded, which is gone"
_NOT_TUNED = "leave it out; it is fixed at "
_SPEED = "leave it out: limits.body_speed limits every point of the arm, and no joint is driven beyond 0.7 of its limit"

PARAMETERS: Mapping[str, Mapping[str, str]] = {
    "driver": {
        "faults": _FAULTS,
        "lockstep": "set use_sim_time: true instead",
        "waits_for": "leave it out: in simulated time the driver waits for every node that promises",
        "sensors.position_noise": _NOT_TUNED + "1e-5 rad, and mismatch.noise_scale of a scene multiplies it",
        "sensors.position_resolution": _NOT_TUNED + "1e-5 rad",
        "sensors.velocity_noise": _NOT_TUNED + "1e-3 rad/s, and mismatch.noise_scale of a scene multiplies it",
        "sensors.torque_noise": _NOT_TUNED + "0.05 Nm, and mismatch.noise_scale of a scene multiplies it",
        "joints.viscous_friction": _NOT_TUNED + "0.3 Nm s/rad, and mismatch.friction_scale of a scene multiplies it",
        "joints.coulomb_friction": _NOT_TUNED + "0.2 Nm, and mismatch.friction_scale of a scene multiplies it",
        "joints.hold_damping": _NOT_TUNED + "30 Nm s/rad",
        "joints.brake_torque": _NOT_TUNED + "150 Nm",
        "watchdog.open_after": _NOT_TUNED + "0.5 s",
        "watchdog.hold_after": _NOT_TUNED + "0.02 s",
        "watchdog.stop_after": _NOT_TUNED + "0.1 s",
    },
    "controller": {
        "impedance.singularity_floor": _NOT_TUNED + "0.03 1/kg",
        "limits.joint_limit_torque_share": _NOT_TUNED + "0.5",
        "limits.joint_limit_margin": _NOT_TUNED + "0.04 rad; narrow the position limits in the arm's file instead",
        "limits.joint_limit_damping": _NOT_TUNED + "10 Nm s/rad of the strongest joint",
        "limits.null_velocity_share": _SPEED,
        "limits.velocity_limit_share": _SPEED,
        "limits.velocity_limit_rate": _SPEED,
        "supervision.start_ramp": _NOT_TUNED + "0.5 s",
        "supervision.hold_blend": "leave it out: a hold begins at once, where the arm is",
        "supervision.max_plan_lead": _NOT_TUNED + "1 s",
        "supervision.max_plan_duration": _NOT_TUNED + "1 s",
        "supervision.watch_rate": "leave it out: the own watch takes every state; watch_itself: false ends it",
        "supervision.observer_patience": "leave it out: a silent observer stops the arm after 0.25 s",
        "supervision.observer_timeout": _NOT_TUNED + "0.25 s",
        "supervision.reset_velocity": _NOT_TUNED + "0.05 rad/s",
        "supervision.correct_stop": "leave it out: a stop holds what a hand-over accepts, and no estimate enters it",
        "supervision.stop_damping": "leave it out: it follows from the mass matrix",
        "supervision.velocity_share": "lower the velocity limits in the arm's file instead",
        "supervision.velocity_debounce": _NOT_TUNED + "3 ms",
        "supervision.stop_speed_gain": "leave it out: a stop takes energy out of the arm, whatever it carries",
        "supervision.stop_creep": "leave it out: a stop holds what a hand-over accepts",
        "supervision.rest_within": _NOT_TUNED + "1 s; drive_brakes: false holds for as long as it takes",
        "supervision.brake_after": _NOT_TUNED + "0.3 s at rest; drive_brakes: false holds for as long as it takes",
    },
    "observer": {
        "safety.contact_release": _NOT_TUNED + "0.8",
        "safety.release_debounce": _NOT_TUNED + "50 ms",
        "safety.handover_debounce": _NOT_TUNED + "30 ms",
        "safety.mean_time": _NOT_TUNED + "300 ms",
        "safety.model_error_per_rad": "leave it out: what counts as an error of the model follows from the posture",
        "safety.model_error_at_rest": _NOT_TUNED + "10 % of contact_thresholds",
        "safety.reset_share": "leave it out: a reset has the limits of a hand-over, handover_thresholds",
        "safety.reset_velocity": _NOT_TUNED + "0.05 rad/s",
        "momentum.coulomb_speed": _NOT_TUNED + "0.02 rad/s",
        "plausibility.frozen_time": _NOT_TUNED + "30 ms",
        "plausibility.frozen_torque_time": _NOT_TUNED + "200 ms",
        "torque_source": "leave it out: joint_states must carry measured torques in effort",
        "commanded.threshold_factor": _MEASURED,
        "commanded.handover_time": _MEASURED,
        "commanded.lost": _MEASURED,
    },
    "planner": {
        "planning.cpus": "leave it out: plans use one core (cpus, the CPUs that the node may run on, stays)",
        "planning.least_population": "set planning.population to as many candidates as the device has memory for",
        "planning.contact_patience_share": "leave it out: the weight of contact recovers as soon as a plan expects "
        "more than the permitted force",
        "unexpected_contact.radius": "leave it out: it belonged to the reaction replan, which is gone",
        "planning.contact_measure": "leave it out: the largest force on a link counts",
        "planning.detour_weight": _NOT_TUNED + "0.5; planning.detour_patience: 0 means no detours",
        "planning.joint_limit_weight": _NOT_TUNED + "160 1/rad²",
        "planning.joint_limit_margin": _NOT_TUNED + "0.025 rad",
        "planning.joint_speed_weight": _NOT_TUNED + "0.3 s²/rad²",
        "planning.clearance_margin": _NOT_TUNED + "0.02 m",
        "planning.clearance_weight": _NOT_TUNED + "1000 1/m²",
        "planning.terminal_weight": "leave it out, or add a cost term of your own, see docs/extending.md",
        "planning.contact_squared_weight": "leave it out, or add a cost term of your own, see docs/extending.md",
        "planning.contact_stiffness": _NOT_TUNED + "1000 N/m; sphere_stiffness is the spring behind it",
        "planning.collision_tolerance": _NOT_TUNED + "0.002 m",
        "planning.reference_posture": "leave it out: law (6) pulls to the arm's own reference posture",
        "planning.rotation_bound": _NOT_TUNED + "0.2 rad; planning.translation_bound and speed_scale set the speed",
        "planning.posture_bound": _NOT_TUNED + "0.2 rad; planning.translation_bound and speed_scale set the speed",
        "planning.gradient_steps": _NOT_TUNED + "10 for the solver gradient",
        "planning.elite": "leave it out: it is a quarter of planning.population",
        "planning.boundary_penalty": "leave it out: sampling: paper has the penalty of line 9, bounds has none",
        "planning.sigma": _NOT_TUNED + "0.15 of the bounds",
        "planning.boundary_weight": _NOT_TUNED + "0.3",
        "planning.stagnation_tolerance": _NOT_TUNED + "1e-4",
        "planning.stagnation_steps": _NOT_TUNED + "3",
        "unexpected_contact.patience": _NOT_TUNED + "0.01 s",
        "unexpected_contact.least_force": _NOT_TUNED + "5 N",
        "unexpected_contact.retreat": "leave it out: reaction: give way, the default, lets the arm yield where it is",
        "planning.line_search_points": "leave it out: as many values of β are tried as planning.population says",
        "planning.solver": "leave it out, or pass solver to make_planner; benchmarks.solver compares them",
        "planning.null_space": "leave it out: plans move the redundant joints; the method reference_posture of the "
        "benchmarks has law (6)",
        "planning.backend": "leave it out: plans take two to three times as long where XLA compiles all of the cost",
        "planning.seed": "leave it out: it is 0; the library has Stack(seed=...), and reseed of its core",
        "planning.device": "set the environment variable JAX_PLATFORMS to cpu or cuda instead",
        "sphere_damping": _NOT_TUNED + "30 N s/m",
        "node_damping": _NOT_TUNED + "5 N s/m",
        "node_stiffness": "leave it out: only edges hold the nodes that can move; see edge_stiffness",
        "goal_timeout": "leave it out: whoever sends a goal decides how long to wait for it",
        "goal_tolerance": _NOT_TUNED + "0.01 m; Goal(tolerance=...) in the library",
        "settle_time": _NOT_TUNED + "0.2 s",
        "goal_angle_tolerance": _NOT_TUNED + "0.05 rad; Goal(angle_tolerance=...) in the library",
        "rest_speed": _NOT_TUNED + "0.01 m/s; Goal(rest_speed=...) in the library",
    },
    "adapter": {
        "hold_after": _NOT_TUNED + "0.02 s, or two periods of the joint states where they are longer",
        "stop_after": _NOT_TUNED + "0.1 s",
        "on_silence": "leave it out: harmless torques always damp",
        "torque_rate": "leave it out: it is the controller's default, and 1000 Nm/s with kind: franka",
        "resume_ramp": _NOT_TUNED + "0.5 s",
        "stop_damping": "leave it out: it follows from the mass matrix",
        "effort.manager": "leave it out: it is controller_manager in the namespace of effort.controller",
        "franka.ask_joints": "leave it out: the order of joints is always asked for",
        "franka.brakes": "leave it out: the arm holds itself",
        "franka.manager": "leave it out: it is controller_manager in the namespace of franka.controller",
        "franka.reflexes": "remap the service instead: -r service_server/set_full_collision_behavior:=...",
        "franka.reflex_torques": "leave it out, or set the reflexes by hand and set_reflexes: false",
        "franka.reflex_force": "leave it out, or set the reflexes by hand and set_reflexes: false",
        "franka.reflex_moment": "leave it out, or set the reflexes by hand and set_reflexes: false",
    },
    "viewer": {
        "dark": "append ?darkMode to the page's address",
        "shadows": "leave it out: shadows are always drawn",
        "rate": _NOT_TUNED + "30 Hz",
        "bags": "leave it out: a page shows the running stack, or the bag that the parameter bag names",
    },
    "recorder": {
        "topics": "leave it out: every topic of the stack is recorded; ros2 bag record records others",
        "storage.compression": "leave it out: bags are compressed with zstd",
        "storage.split_mb": "leave it out: a bag has one file; ros2 bag convert splits",
        "storage.split_s": "leave it out: a bag has one file; ros2 bag convert splits",
        "storage.min_free_mb": _NOT_TUNED + "500 MB",
        "lockstep": "set use_sim_time: true instead",
    },
    "bringup": {
        "seed": "set seed of the driver: in its section of the parameter file, or --set driver:seed=N",
        "target": 'set target of the driver: --set "driver:target=X Y Z"',
    },
}
"""Parameters by node and full name."""

SCENE_KEYS: Mapping[str, str] = {
    "min_overlap": _NOT_TUNED + "0.02 m for balls and 0.04 m for walls",
    "max_overlap": _NOT_TUNED + "0.05 m for balls and 0.15 m for walls",
    "hand_clearance": _NOT_TUNED + "0.02 m",
    "start_clearance": _NOT_TUNED + "0.01 m",
    "max_hand_overlap": _NOT_TUNED + "0.02 m",
    "min_squeeze": _NOT_TUNED + "0.005 m",
    "target_clearance": _NOT_TUNED + "0.06 m",
    "hardening": _NOT_TUNED + "0.3",
    "anchor_stiffness": _NOT_TUNED + "0",
    "planner_stiffness_scale": "leave it out, and set edge_stiffness of the planner",
    "id": "leave it out: obstacles are numbered from 0",
}
"""Keys of obstacles in scene files."""

BUDGET_KEYS: Mapping[str, str] = {
    "handover_time": _NOT_TUNED + "0.3 s",
    "model_error": "leave it out: what counts as an error of the model follows from the arm's posture",
}
"""Keys of the contact budget."""

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
    "bench control": "leave control out: bench times the controller in the running stack",
    "bench --ticks": "leave it out: bench times the controller in the running stack",
    "bag repair": "damaged bags are read as they are; ros2 bag reindex makes metadata.yaml, mcap recover the index",
    "report --csv": "read the bag itself, an mcap file, with ros2 bag or Foxglove; --json writes the numbers",
    "report --with": "run contact-reach reexecute BAG --with FILE",
    "demo --timeout": "leave it out: a goal has 30 s of the robot's clock",
    "up --robot": "use --arm",
    "up --seed": "use --set driver:seed=N",
    "up --target": 'use --set "driver:target=X Y Z"',
    "identify --without": "identify the arm without its tool with --links first, start the stack with the file that "
    "this writes, then identify the tool",
    "bench --scene": "leave it out: the scene is always ball",
    "arm --view": "arm check prints how much larger each capsule is than its link; RViz shows the URDF",
    "view --bags": "leave it out: the page offers the neighbours of the bag, or the folder bags",
    "view --dark": "append ?darkMode to the page's address",
}
"""Commands of `contact-reach` by their first words, and options by command and name."""

_SENTENCES = {
    name: sentence for named in (SCENE_KEYS, BUDGET_KEYS, *PARAMETERS.values()) for name, sentence in named.items()
}


def removed_parameter(name: str) -> str:
    """Why this full name of a parameter or key of a scene is gone, and what to do; empty if it is not."""
    return _refusal(name, _SENTENCES.get(name, ""))


def removed_command(words: list[str]) -> str:
    """Why `contact-reach` does not take these arguments any more, and what to do; empty if it does, or never did."""
    options = [word.partition("=")[0] for word in words if word.startswith("--")]
    names = [*words[:1], " ".join(words[:2]), *(f"{words[0]} {option}" for option in options)]
    return next((_refusal(name, COMMANDS[name]) for name in names if name in COMMANDS), "")


def _refusal(name: str, sentence: str) -> str:
    return f"'{name}' was removed in {VERSION}: {sentence}" if sentence else ""
