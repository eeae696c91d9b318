"""Quality of service between rclpy and bags: what publishers offer, what a recorder requests, what a replay offers."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from contact_reach_ros.bags.topics import INFINITE_NS, OfferedQos
from contact_reach_ros.messages import topics
from contact_reach_ros.units import NANOSECONDS

HISTORY_DEPTH = topics.KEPT_STREAM.depth
"""Messages per topic that wait in the middleware while the recorder is held up: all that publishers keep, or 4 s."""


def acceptable_qos(publishers: Sequence[TopicEndpointInfo]) -> QoSProfile:
    """Request the strictest quality of service that every publisher offers, with a deep queue."""
    offered = [publisher.qos_profile for publisher in publishers]
    reliable = all(profile.reliability == ReliabilityPolicy.RELIABLE for profile in offered)
    latched = all(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for profile in offered)
    return QoSProfile(
        depth=HISTORY_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def asks_too_much(qos: QoSProfile, publishers: Sequence[TopicEndpointInfo]) -> bool:
    """Whether a subscriber that requests this receives nothing from one of the publishers."""
    acceptable = acceptable_qos(publishers)
    loses_reliability = acceptable.reliability != qos.reliability == ReliabilityPolicy.RELIABLE
    return loses_reliability or acceptable.durability != qos.durability == DurabilityPolicy.TRANSIENT_LOCAL


def offered_qos(profile: QoSProfile) -> OfferedQos:
    """Convert what a publisher offers for a bag."""
    return OfferedQos(
        history=profile.history.short_key,
        depth=profile.depth,
        reliability=profile.reliability.short_key,
        durability=profile.durability.short_key,
        deadline_ns=profile.deadline.nanoseconds,
        lifespan_ns=profile.lifespan.nanoseconds,
        liveliness=profile.liveliness.short_key,
        liveliness_lease_ns=profile.liveliness_lease_duration.nanoseconds,
        avoid_ros_namespace_conventions=profile.avoid_ros_namespace_conventions,
    )


def publisher_qos(name: str, offered: Sequence[OfferedQos]) -> QoSProfile:
    """Quality of service that reaches everybody whom the recorded publishers reached: the best that any offered.

    Discovery, from which a recorder has it, does not report depths. Then the depth is that of the stack's topic, or one
    message for a latched topic and a deep queue for any other.
    """
    if not offered:
        return QoSProfile(depth=topics.STREAM.depth)
    reliable = any(profile.reliability != "best_effort" for profile in offered)
    latched = any(profile.durability == "transient_local" for profile in offered)
    first = offered[0]
    by_hand = first.liveliness == "manual_by_topic"
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if any(p.history == "keep_all" for p in offered) else HistoryPolicy.KEEP_LAST,
        depth=max(profile.depth for profile in offered) or _usual_depth(name, latched),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        deadline=_duration(first.deadline_ns),
        lifespan=_duration(first.lifespan_ns),
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if by_hand else LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=_duration(first.liveliness_lease_ns),
        avoid_ros_namespace_conventions=first.avoid_ros_namespace_conventions,
    )


def _usual_depth(name: str, latched: bool) -> int:
    known = topics.find(name)
    if known is not None:
        return known.qos.depth
    return topics.LATCHED.depth if latched else topics.STREAM.depth


def _duration(nanoseconds: int) -> Duration:
    # rmw takes zero for no limit, and older files have it, too.
    return Duration() if nanoseconds >= INFINITE_NS - NANOSECONDS else Duration(nanoseconds=nanoseconds)
