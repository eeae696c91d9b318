"""A node that prints in which namespace and with which settings it was made, and then waits: `telling.py NODE ...`."""

import importlib
import json
import signal
import sys

from contact_reach_ros.executables import end_at_signals
from contact_reach_ros.ros import process


def tell(node):
    """Stands for the serving of the node."""
    print(f"told {json.dumps([node.get_namespace(), node.NAME, node.reported_settings()])}", flush=True)
    end_at_signals()
    signal.pause()
    return 0


if __name__ == "__main__":
    process._serve = tell
    name = sys.argv.pop(1)
    module = importlib.import_module(f"contact_reach_ros.nodes.{name}")
    sys.exit(process.run(getattr(module, f"{name.title()}Node"), sys.argv))
