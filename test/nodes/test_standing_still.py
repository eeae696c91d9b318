"""The driver in lockstep: where time stands still until somebody has given a goal."""

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from stack_helpers import ros
from std_msgs.msg import Header

from contact_reach_ros.arm.model import RobotModel
from contact_reach_ros.arms.iiwa14 import ARM
from contact_reach_ros.messages.conversions import to_time
from contact_reach_ros.messages.serialized import CommandWriter
from contact_reach_ros.nodes.driver import DriverNode
from contact_reach_ros.ros.inbox import Inbox
from contact_reach_ros.ros.lockstep import FOREVER_NS


def test_with_open_brakes_time_stands_still_until_the_planner_has_had_a_goal(monkeypatch):
    command, waited = CommandWriter(ARM.n).write(RobotModel(ARM).gravity_at(np.array(ARM.home))), []
    monkeypatch.setattr(Inbox, "poll", lambda _: driver._on_command(command))

    def wait(*_):
        for name in ("observer", "planner", "controller"):
            driver._lockstep.hear(Header(frame_id=name, stamp=to_time(FOREVER_NS)))
        driver._on_command(command)
        waited.append(driver.robot.plant.steps)
        if len(waited) == 5:
            driver._on_goal_state(DiagnosticStatus())

    monkeypatch.setattr(Inbox, "wait", wait)
    parameters = ("lockstep:=true", "waits_for_goal:=true", "scene:=free")
    with ros("--ros-args", *(part for parameter in parameters for part in ("-p", parameter))):
        driver = DriverNode()
        driver.running = True
        for _ in range(600):
            driver.turn()
        # Once for the first state, and then at the one with which the brakes are open.
        assert waited[0] == 0 and waited[1] > 400 and waited[1:] == 4 * [waited[1]]
        assert driver.robot.plant.steps == 600
