"""The contact budget's file."""

from pathlib import Path

import pytest
from arm_simulation import ARM

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import ContactBudget, load_budget


@pytest.fixture
def file(tmp_path) -> Path:
    return tmp_path / "budget.yaml"


def test_budget_of_the_package_says_what_the_code_says():
    assert load_budget() == ContactBudget()


def test_file_replaces_what_it_names(file):
    file.write_text("permitted_force: 4")
    budget = load_budget(file)
    assert budget.permitted_force == 4.0
    assert budget.resolve(ARM).torque_thresholds == ContactBudget().resolve(ARM).torque_thresholds
    assert load_budget(str(file)) == budget


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("permited_force: 4", "unknown key 'permited_force'; did you mean 'permitted_force'?"),
        ("permitted_force: -1", "permitted_force = -1: expected a number in [0, 140] N"),
        ("permitted_force: ten", "permitted_force = 'ten'"),
        ("torque_thresholds: [30, 30, 25, 25, 15, 10, 0]", "torque_thresholds = 0: expected"),
        ("", "holds NoneType; expected a mapping"),
        ("permitted_force: [", "not valid YAML"),
    ],
)
def test_file_and_key_are_named_when_it_is_refused(file, content, key):
    file.write_text(content)
    with pytest.raises(SettingsError) as raised:
        load_budget(file)
    assert str(raised.value).startswith(str(file))
    assert key in str(raised.value)


def test_thresholds_for_another_number_of_joints_are_refused_for_the_arm(file):
    file.write_text("torque_thresholds: [30, 30, 25]")
    with pytest.raises(SettingsError, match=r"torque_thresholds = \(30.0, 30.0, 25.0\): expected a list of 7 values"):
        load_budget(file).resolve(ARM)


def test_missing_file_is_named(file):
    with pytest.raises(SettingsError, match=f"{file}: cannot be read"):
        load_budget(file)
