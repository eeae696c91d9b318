"""Arm and settings of a bag are those of this version, or nothing is re-executed with them."""

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from arm_simulation import ARM
from six_axis import SIX_AXIS

from contact_reach_ros.arm.table import table_of
from contact_reach_ros.arms import arm_settings
from contact_reach_ros.bags.signals import recorded_arm
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.presets import SECTIONS as DECLARED
from contact_reach_ros.reexecution.inputs import SECTIONS, changed_sections, recorded_sections


class TestArm:
    def test_bags_that_name_none_are_of_the_first_arm(self):
        assert recorded_arm({"controller": {}}) is ARM
        assert recorded_arm({}) is ARM

    def test_name_and_digest_are_those_of_this_version_or_it_is_refused(self):
        for digest in (ARM.digest, "fb09104480dee5b5", "a1afed95948d1e7c", "f4d510c0cfa2a199"):
            assert recorded_arm({"controller": {"robot": ARM.name, "robot digest": digest}}) is ARM
        with pytest.raises(BagError, match=f"had digest 0123, this version's has {ARM.digest}"):
            recorded_arm({"controller": {"robot": ARM.name, "robot digest": "0123"}})

    def test_an_arm_that_the_package_lacks_is_in_the_settings_themselves(self):
        settings = json.loads(json.dumps(arm_settings(SIX_AXIS)))
        arm = recorded_arm({"controller": settings})
        assert arm.joint_names == SIX_AXIS.joint_names and arm.home == SIX_AXIS.home and arm.n == 6
        assert set(arm_settings(ARM)) == {"robot", "robot digest"}
        with pytest.raises(BagError, match="settings of the controller: robot table: home has 1 values; expected 6"):
            recorded_arm({"controller": {"robot table": {**table_of(SIX_AXIS), "home": [0.0]}}})


class TestRecorded:
    @pytest.mark.parametrize("node", SECTIONS)
    def test_every_section_that_a_node_declares_is_known(self, node: str) -> None:
        assert DECLARED[node].items() <= SECTIONS[node].items()

    @pytest.mark.parametrize("node", SECTIONS)
    def test_an_unknown_setting_and_a_value_that_is_not_accepted_are_named(self, node: str) -> None:
        for prefix, kind in SECTIONS[node].items():
            entry = next(entry for entry in kind.declared() if entry.kind in (int, float, bool, str, tuple))
            own = f"{prefix}." if prefix else ""
            for name, value in ((f"{own}no_such_thing", 1.0), (f"{own}{entry.name}", {})):
                with pytest.raises(BagError, match=f"'old', settings of the {node}.*({entry.name}|no_such).*version"):
                    recorded_sections(node, {name: value}, ARM, "old")

    def test_settings_that_are_constants_now_are_left_out(self) -> None:
        recorded = {"supervision.start_ramp": 0.5, "safety.mean_time": 300, "state_rate": 500.0}
        assert recorded_sections("controller", recorded, ARM, "old") == recorded_sections("controller", {}, ARM, "old")


class TestChanged:
    def change(self, node: str, file: Path, **nodes: dict[str, Any]) -> dict[str, Any]:
        file.write_text(yaml.safe_dump({name: {"ros__parameters": content} for name, content in nodes.items()}))
        recorded = {"limits.torque_share": 0.5} if node == "controller" else {}
        return changed_sections(node, {**recorded, "momentum.gain": 30.0}, ARM, file)

    def test_only_what_the_file_names_changes(self, tmp_path: Path) -> None:
        """The controller watches itself with the observer's settings."""
        changes = {"controller": {"limits": {"torque_share": 0.4}}, "observer": {"safety": {"debounce": 9}}}
        made = {node: self.change(node, tmp_path / "other.yaml", **changes) for node in changes}
        assert made["controller"]["limits"].torque_share == 0.4
        for sections in made.values():
            assert (sections["safety"].debounce, sections["momentum"].gain) == (9, 30.0)
            assert sections["safety"].contact_debounce == 2

    @pytest.mark.parametrize(
        ("node", "content", "message"),
        [
            ("controller", {"limits": {"torque_shar": 0.5}}, "controller: unknown key 'limits.torque_shar'"),
            ("observer", {"momentum": {"gain": 0.0}}, "observer: momentum.gain"),
            ("observer", {"contact_budget": "none.yaml"}, "none.yaml: cannot be read"),
            ("model", {"inertia_set": "alternative"}, "unknown node 'model'"),
            ("planner", {"period": 0.1}, "has nothing for controller or observer"),
        ],
    )
    def test_what_cannot_be_used_is_named(
        self, tmp_path: Path, node: str, content: dict[str, Any], message: str
    ) -> None:
        with pytest.raises(SettingsError, match=message):
            self.change("observer", tmp_path / "other.yaml", **{node: content})
