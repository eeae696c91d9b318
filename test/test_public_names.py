"""The names of the library: all can be imported from the package, none costs anything before it is used."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import contact_reach_ros

HEAVY = ("numpy", "scipy", "jax", "mujoco", "pinocchio", "numba", "rclpy", "matplotlib", "yaml")


def run(code: str) -> str:
    """What a fresh process prints."""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr
    return found.stdout.strip()


@pytest.mark.parametrize("name", contact_reach_ros.__all__)
def test_each_can_be_imported_and_is_defined_where_the_package_looks_for_it(name):
    value = getattr(contact_reach_ros, name)
    assert getattr(contact_reach_ros, name) is value
    if isinstance(value, type):
        assert value.__name__ == name and value.__doc__
    assert name in dir(contact_reach_ros)


def test_they_are_listed_once_and_what_type_checkers_see_is_what_there_is():
    names = contact_reach_ros.__all__
    assert len(set(names)) == len(names)
    source = Path(contact_reach_ros.__file__).read_text()
    checked, _ = source.split("_WHERE = {")
    imported = re.findall(r"^    from \S+ import (.+)$", checked, re.MULTILINE)
    seen = {name.split(" as ")[-1] for line in imported for name in line.split(", ")}
    assert seen == set(names)


@pytest.mark.parametrize("name", ["Stak", "stack_", "numpy", "_where"])
def test_other_names_are_attribute_errors(name):
    with pytest.raises(AttributeError, match=f"module 'contact_reach_ros' has no attribute '{name}'"):
        getattr(contact_reach_ros, name)
    assert not hasattr(contact_reach_ros, name)


def test_importing_the_package_imports_nothing_that_takes_time():
    printed = run(f"import sys, contact_reach_ros; print([name for name in {HEAVY} if name in sys.modules])")
    assert printed == "[]"


def test_importing_the_package_takes_milliseconds():
    code = """
import sys, time
begin = time.process_time()
import contact_reach_ros
print(time.process_time() - begin)
"""
    assert min(float(run(code)) for _ in range(3)) < 0.05


def test_controller_and_observer_need_neither_simulator_nor_planner():
    code = """
import sys
from contact_reach_ros import Controller, ControllerSettings, ContactBudget, Observer, ObserverSettings, load_arm
arm = load_arm()
Controller(arm, ControllerSettings()), Observer(arm, ObserverSettings(), ContactBudget())
print([name for name in ("jax", "mujoco", "rclpy", "matplotlib") if name in sys.modules])
"""
    assert run(code) == "[]"


def test_a_wrong_import_says_what_is_missing():
    with pytest.raises(ImportError, match="Stak"):
        from contact_reach_ros import Stak  # noqa: F401
