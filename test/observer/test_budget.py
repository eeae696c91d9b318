"""The contact budget's file."""

import pytest
from arm_simulation import ARM

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.observer.budget import ContactBudget, load_budget


def test_the_packages_file_says_what_the_code_says_and_another_replaces_what_it_names(tmp_path):
    assert load_budget() == ContactBudget()
    file = tmp_path / "budget.yaml"
    file.write_text("permitted_force: 4")
    assert load_budget(str(file)) == ContactBudget(permitted_force=4.0)


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ("permited_force: 4", "unknown key 'permited_force'"),
        ("handover_time: 0.3", "'handover_time' was removed in 0.3.0: leave it out; it is fixed at 0.3 s"),
        ("permitted_force: -1", "permitted_force = -1: expected"),
        ("torque_thresholds: [30, 30, 25, 25, 15, 10, 0]", "torque_thresholds = 0: expected"),
    ],
)
def test_file_and_key_are_named_when_it_is_refused(tmp_path, content, key):
    file = tmp_path / "budget.yaml"
    file.write_text(content)
    with pytest.raises(SettingsError, match=f"^{file}: {key}"):
        load_budget(file)


def test_thresholds_for_another_number_of_joints_are_refused_for_the_arm():
    with pytest.raises(SettingsError, match=r"torque_thresholds = .*: expected a list of 7 values"):
        ContactBudget(torque_thresholds=(30.0, 30.0, 25.0)).resolve(ARM)
