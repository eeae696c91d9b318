"""The arm of a bag, and settings as messages carry them."""

import json
from types import SimpleNamespace

import pytest
from arm_simulation import ARM
from six_axis import SIX_AXIS

from contact_reach_ros.arm.table import table_of
from contact_reach_ros.arms import arm_settings
from contact_reach_ros.bags.recorded_arm import recorded_arm
from contact_reach_ros.errors import BagError
from contact_reach_ros.messages.values import read_settings
from contact_reach_ros.reexecution.settings import recorded_sections


class TestArm:
    def test_bags_that_name_none_are_of_the_first_arm(self):
        assert recorded_arm({"controller": {}}) is ARM
        assert recorded_arm({}) is ARM

    def test_name_and_digest_are_those_of_this_version(self):
        for digest in (ARM.digest, "a1afed95948d1e7c", "f4d510c0cfa2a199"):
            assert recorded_arm({"controller": {"robot": ARM.name, "robot digest": digest}}) is ARM

    def test_an_arm_that_was_changed_since_is_refused(self):
        with pytest.raises(BagError, match=f"had digest 0123, this version's has {ARM.digest}"):
            recorded_arm({"controller": {"robot": ARM.name, "robot digest": "0123"}})

    def test_an_arm_that_the_package_lacks_is_in_the_settings_themselves(self):
        settings = json.loads(json.dumps(arm_settings(SIX_AXIS)))
        arm = recorded_arm({"controller": settings})
        assert arm.joint_names == SIX_AXIS.joint_names and arm.home == SIX_AXIS.home and arm.n == 6
        assert set(arm_settings(ARM)) == {"robot", "robot digest"}
        with pytest.raises(BagError, match="settings of the controller: robot table: home has 1 values; expected 6"):
            recorded_arm({"controller": {"robot table": {**table_of(SIX_AXIS), "home": [0.0]}}})


def test_bags_from_before_the_slow_mean_was_limited_are_executed_as_they_were():
    old = recorded_sections("observer", {"safety.mean_states": 300}, "old")
    assert old["safety"].model_error_at_rest == 1000.0
    assert old["budget"].resolve(ARM).model_error == (320.0,) * ARM.n
    assert (old["commanded"].threshold_factor, old["commanded"].lost) == (1.0, 0)


def test_values_are_json_and_whatever_is_none_stays_text():
    values = {"a": 0.5, "b": [1, 2], "c": True, "d": None}
    entries = [SimpleNamespace(key=key, value=json.dumps(value)) for key, value in values.items()]
    entries.append(SimpleNamespace(key="e", value="plain text"))
    assert read_settings(SimpleNamespace(values=entries)) == {**values, "e": "plain text"}
