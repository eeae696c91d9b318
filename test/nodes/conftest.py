"""What tests of single nodes share."""

import importlib

import pytest
from message_packages import message_packages

from contact_reach_ros.drives import effort, franka, lbr


@pytest.fixture(scope="module")
def packages():
    """The drivers' message packages, from which the modules of their drives take their types."""
    folders = message_packages()
    with pytest.MonkeyPatch.context() as patched:
        for folder in folders:
            patched.syspath_prepend(folder)
        for module, package, names in (
            (lbr, "lbr_fri_idl.msg", ("LBRState", "LBRTorqueCommand")),
            (lbr, "controller_manager_msgs.srv", ("SetHardwareComponentState",)),
            (effort, "controller_manager_msgs.srv", ("ListControllers", "SwitchController")),
            (franka, "franka_msgs.srv", ("SetFullCollisionBehavior",)),
        ):
            for name in names:
                patched.setattr(module, name, getattr(importlib.import_module(package), name))
        yield
