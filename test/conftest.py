"""Settings that hold for every test; they are made before any module under test is imported."""

import os

import hypothesis

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Nodes under test must not hear other robots, or another test run on this machine.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

# The same examples every time, and no deadline: what is tested does not depend on the machine's speed.
hypothesis.settings.register_profile("reproducible", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("reproducible")


def pytest_addoption(parser):
    parser.addoption("--write-faults", action="store_true", help="write what test/faults finds to docs/faults.md")
