"""Write a new bag of the net: `python test/net/net_bags.py NAME RECORDED` keeps what is executed again.

RECORDED is made, for `real_time`, by `contact-reach demo --scene ball --seed 2 --goal 0.51 0.025 0.175` beside four
programs that keep all cores busy, so that states are lost.
"""

import sys
from pathlib import Path

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.bags.topics import RecordedTopic
from contact_reach_ros.bags.writer import BagWriter

BAGS = Path(__file__).with_name("bags")
LONGEST_NS = 4_500_000_000
"""Time from the first joint state that is kept, so that a bag stays small, ns."""
KEPT = (
    *("/settings", "/goal_pose", "/reference/pose", "/reference/posture", "/safety_state", "/joint_states"),
    *("/effort_controller/commands", "/external_torque", "/intake/controller", "/intake/observer"),
)


def keep(recorded: Path, directory: Path) -> None:
    """Write the messages of the topics that controller and observer are executed again with."""
    reader = BagReader(recorded)
    with BagWriter(directory, [RecordedTopic(name, reader.topics[name].type) for name in KEPT]) as bag:
        end_ns = None
        for raw in reader.raw_messages(KEPT):
            if end_ns is None and raw.topic == "/joint_states":
                end_ns = raw.log_time_ns + LONGEST_NS
            if end_ns is not None and raw.log_time_ns > end_ns:
                break
            bag.write(raw.topic, raw.data, raw.log_time_ns, raw.publish_time_ns, raw.sequence)


if __name__ == "__main__":
    keep(Path(sys.argv[2]), BAGS / sys.argv[1])
