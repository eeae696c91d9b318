"""Settings that hold for every test; they are made before any module under test is imported."""

import os
import signal

import hypothesis
import pytest
from ros_domains import own_domain

from contact_reach_ros.resources import cache_directory

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# As in the nodes and the command line: the threads of two workers would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Half the time to compile, which is most of the time of these tests; programs compute the same to rounding, and large
# ones take a third longer. Processes that the tests start have it from here. Loops stay many functions (the planner
# would make them one), which at this level of optimisation compile in two thirds of the time.
_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024"
_QUICK = f"--xla_backend_optimization_level=1 --xla_cpu_use_fusion_emitters=false {_LOOPS}"
os.environ.setdefault("XLA_FLAGS", _QUICK)
# The tests' own programs are kept for the next run as well, where planners keep theirs.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache_directory() / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
# Nodes under test must not hear other robots, or another test run on this machine; each worker has a domain.
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ["ROS_DOMAIN_ID"] = str(own_domain())

# The same examples every time, and no deadline: what is tested does not depend on the machine's speed.
hypothesis.settings.register_profile("reproducible", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("reproducible")


def pytest_addoption(parser):
    parser.addoption("--quick", action="store_true", help="no slow tests, and a part of the fault matrix")


LONGEST = ("stacks", "arm", "benchmarks", "planning", "test", "examples", "nodes", "faults", "control")
"""Folders whose tests take minutes, in the order in which they are run: most others have the programs that `stacks`
compiles meanwhile."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """With several workers, the tests of a folder share one, and with it the fixtures and the compiled programs.

    The longest come first, so that no worker is left with them at the end. `stacks` starts stacks, one at a time.
    """
    order = {folder: place for place, folder in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.parent.name, len(order)))
    if config.getoption("--quick"):
        items[:] = [item for item in items if item.get_closest_marker("slow") is None]
    for item in items:
        item.add_marker(pytest.mark.xdist_group(item.path.parent.name))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish(session):
    """Notice where pytest-xdist does not see the groups, as with pytest 9.2: folders would be torn apart silently."""
    if getattr(session.config.option, "loadgroup", False):
        assert all("@" in item.nodeid for item in session.items), "pytest-xdist ignores groups with this pytest"


@pytest.fixture
def signal_handlers():
    """Puts the handlers of signals that end a process back in the end."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
