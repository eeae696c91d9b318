"""The names of the library: all can be imported from the package, none costs anything before it is used."""

import ast
from pathlib import Path

import pytest
from contact_reach_command import python

import contact_reach_ros

HEAVY = ("numpy", "scipy", "jax", "mujoco", "pinocchio", "numba", "rclpy", "matplotlib", "yaml")


def test_each_can_be_imported_and_type_checkers_see_the_same():
    names = contact_reach_ros.__all__
    for name in names:
        value = getattr(contact_reach_ros, name)
        if isinstance(value, type):
            assert value.__name__ == name and value.__doc__
        assert name in dir(contact_reach_ros)
    checked, _ = Path(contact_reach_ros.__file__).read_text().split("_NAMES = {")
    (block,) = (part for part in ast.parse(checked.rsplit("\n\n", 1)[0]).body if isinstance(part, ast.If))
    seen = [alias.asname or alias.name for line in block.body for alias in line.names]
    assert sorted(seen) == sorted(names)


def test_other_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="module 'contact_reach_ros' has no attribute 'Stak'"):
        contact_reach_ros.Stak  # noqa: B018


def test_importing_the_package_imports_nothing_that_takes_time():
    code = f"import sys, contact_reach_ros; print([name for name in {HEAVY} if name in sys.modules])"
    assert python(code) == "[]\n"


def test_no_process_of_the_stack_loads_scipy_to_start():
    """It would be a third of the start of most of them."""
    modules = ("nodes.observer", "nodes.driver", "nodes.recorder", "nodes.planner", "bringup.demo")
    imports = "; ".join(f"import contact_reach_ros.{module}" for module in modules)
    assert python(f"import sys; {imports}; print([name for name in sys.modules if name[:6] == 'scipy.'])") == "[]\n"


def test_controller_and_observer_need_neither_simulator_nor_planner():
    code = """
import sys
from contact_reach_ros import Controller, ControllerSettings, ContactBudget, Observer, ObserverSettings, load_arm
arm = load_arm()
Controller(arm, ControllerSettings()), Observer(arm, ObserverSettings(), ContactBudget())
print([name for name in ("jax", "mujoco", "rclpy", "matplotlib") if name in sys.modules])
"""
    assert python(code) == "[]\n"
