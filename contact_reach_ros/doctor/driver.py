"""Checks of the driver of a real arm before the stack is started: what its adapter would hear, and be heard by."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from contact_reach_ros.arm import Arm
from contact_reach_ros.arms import make_settings
from contact_reach_ros.bringup.settings import BringupOptions
from contact_reach_ros.doctor import stack
from contact_reach_ros.doctor.arm import JointRecord
from contact_reach_ros.doctor.findings import Finding, failed, graded
from contact_reach_ros.drives.effort import EffortTarget
from contact_reach_ros.drives.lbr import LbrTarget
from contact_reach_ros.drives.settings import ADAPTER_SECTIONS, FRANKA, FRANKA_STATES, LBR
from contact_reach_ros.messages import topics
from contact_reach_ros.ros.client import Client
from contact_reach_ros.ros.graph import as_offered
from contact_reach_ros.ros.inbox import qos_profile
from contact_reach_ros.ros.interfaces import ADAPTER, DOCTOR
from contact_reach_ros.ros.process import bare_node, in_namespace
from contact_reach_ros.settings import parameters_in


def listen(
    options: BringupOptions, arm: Arm, period: float, seconds: float, namespace: str = "/"
) -> tuple[dict[str, Finding], JointRecord]:
    """Listen to the driver for an adapter's kind; returns findings, and the joint states that came in the last seconds.

    The driver is asked for the order of its joints, and nothing is sent to it. `period`: of the joint states, s;
    `namespace`: of the adapter. Raises `SettingsError` if the parameter file is wrong, or a message package is not
    installed.
    """
    kind, file = options.adapter, options.parameter_file
    own = parameters_in(file, ADAPTER, namespace)
    chosen: Any = make_settings(own, ADAPTER_SECTIONS, arm, str(file))[kind]
    target: LbrTarget | EffortTarget
    heard: list[tuple[Any, int]] = []
    with bare_node(DOCTOR, [DOCTOR, *in_namespace(namespace)]) as node:
        client = Client(node)

        def take(state: Any) -> None:
            heard.append((state, client.inbox.received_ns))

        states = node.resolve_topic_name(FRANKA_STATES if kind == FRANKA else topics.JOINT_STATES.name)
        # Nothing is switched here.
        if kind == LBR:
            target = LbrTarget(node, arm, dataclasses.replace(chosen, component=""), period)
            target.listen(client.inbox, take, stack.ANYTHING)
        else:
            effort = chosen.effort if kind == FRANKA else dataclasses.replace(chosen, brakes=False)
            target = EffortTarget(node, arm, effort, carries=True)
            client.inbox.add(topics.JOINT_STATES._replace(name=states), take, stack.ANYTHING)
        client.spin(stack.SETTLED_S)
        client.until(lambda: target.look() or _fits(target), stack.SETTLED_S)
        heard.clear()
        # In short turns: KUKA's states are stamped when they are handled.
        client.until(lambda: False, seconds)
        commands = node.resolve_topic_name(target.topic.name)
        takers = stack.endpoints(node.get_subscriptions_info_by_topic(commands))
        givers = [] if kind == LBR else stack.endpoints(node.get_publishers_info_by_topic(states))
        client.close()
    adapter = stack.Endpoint(f"the {ADAPTER}", target.topic.type_name, as_offered(qos_profile(target.topic.qos)))
    deaf = stack.incompatible([adapter], takers)
    found = f"{commands} → {', '.join(taker.node for taker in takers) or 'nobody'}{deaf and '; ' + deaf}"
    fix = "activate the controller that takes the torques, and let it request no more than reliable, volatile"
    findings = {"driver": _driver(target), "commands": graded(found, fix, fail=bool(deaf or not takers))}
    if len(givers) > 1:
        found = f"{states}: {len(givers)} publishers, {', '.join(giver.node for giver in givers)}; expected one"
        findings["joint states"] = failed(found, f"let the others publish elsewhere: remap their topic {states}")
    return findings, _fri_record(heard, arm) if kind == LBR else stack.joint_record(heard, arm)


def _fri_record(heard: list[tuple[Any, int]], arm: Arm) -> JointRecord:
    """The joint states that an adapter would publish; FRI's have no names."""
    stamps, q, v, torque = (np.array([state[row] for state, _ in heard]) for row in range(4))
    received = np.array([received_ns for _, received_ns in heard])
    return JointRecord((arm.joint_names,), stamps, received, *(each.reshape(-1, arm.n) for each in (q, v, torque)))


def _driver(target: LbrTarget | EffortTarget) -> Finding:
    """Whether the adapter would pass commands on, as far as that shows before the first one."""
    if not _fits(target):
        return failed(
            target.problem, "do what it says (docs/adapter.md has a page for each driver), then run doctor again"
        )
    if isinstance(target, EffortTarget):
        return graded(f"takes the joints in the order {', '.join(target.order)}", "")
    later = "KUKA's stiffness, which must be 0, is measured before the first command"
    return graded(f"lbr_fri_ros2_stack {target.diagnosis()['driver']}; {later}", "")


def _fits(target: LbrTarget | EffortTarget) -> bool:
    return target.states.fits if isinstance(target, LbrTarget) else not target.problem
