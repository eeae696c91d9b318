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
from contact_reach_ros.reexecution.settings import FIXED, recorded_sections
from contact_reach_ros.removed import PARAMETERS


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


@pytest.mark.parametrize("name", FIXED)
def test_settings_that_are_constants_now_must_have_been_recorded_with_their_values(name):
    (node,) = {node for node in ("controller", "observer") if name in PARAMETERS[node]}
    recorded = {name: FIXED[name], "state_rate": 500.0}
    assert recorded_sections(node, recorded, "old") == recorded_sections(node, {}, "old")
    other = not FIXED[name] if FIXED[name] is True else 0.9 * FIXED[name]
    with pytest.raises(BagError, match=f"bag 'old', settings of the {node}: {name} = {other}; expected {FIXED[name]}"):
        recorded_sections(node, {name: other}, "old")


def test_values_are_json_and_whatever_is_none_stays_text():
    values = {"a": 0.5, "b": [1, 2], "c": True, "d": None}
    entries = [SimpleNamespace(key=key, value=json.dumps(value)) for key, value in values.items()]
    entries.append(SimpleNamespace(key="e", value="plain text"))
    assert read_settings(SimpleNamespace(values=entries)) == {**values, "e": "plain text"}
