"""What processes on stand-ins for drivers need."""

import os
from pathlib import Path

import pytest
from message_packages import message_packages


@pytest.fixture(scope="session")
def packages():
    """Environment variables with which processes import the drivers' message packages, and the tests' modules."""
    folders = (*message_packages(), str(Path(__file__).parents[1]))
    return {"PYTHONPATH": os.pathsep.join((*folders, *filter(None, [os.environ.get("PYTHONPATH")])))}
