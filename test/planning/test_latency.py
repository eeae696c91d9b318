"""The time that a plan is begun before its effect follows the slowest of the last plans, within bounds."""

from contact_reach_ros.planning.planner import LatencyEstimate

MS = 1_000_000


def test_it_is_the_slowest_of_the_last_plans_but_never_less_than_wanted() -> None:
    latency = LatencyEstimate(40 * MS)
    assert latency() == 40 * MS
    latency.add(30 * MS)
    assert latency() == 40 * MS
    latency.add(90 * MS)
    latency.add(50 * MS)
    assert latency() == 90 * MS
    for _ in range(7):
        latency.add(50 * MS)
    assert latency() == 50 * MS
