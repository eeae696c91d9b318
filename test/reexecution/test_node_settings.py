"""Recorded settings are those of this version, or nothing is re-executed with them."""

from functools import partial
from pathlib import Path

import pytest
import yaml

from contact_reach_ros.bags.reader import BagReader
from contact_reach_ros.errors import BagError, SettingsError
from contact_reach_ros.presets import SECTIONS as DECLARED
from contact_reach_ros.reexecution.inputs import RecordedInputs
from contact_reach_ros.reexecution.loops import reexecute
from contact_reach_ros.reexecution.plans import RecordedPlans
from contact_reach_ros.reexecution.settings import SECTIONS, ChangedSettings, recorded_sections
from contact_reach_ros.resources import share_directory

SAMPLE = share_directory() / "bags" / "sample"
RUNS = {node: partial(reexecute, node) for node in ("controller", "observer")} | {"planner": RecordedPlans}
SECTIONS_OF_NODES = [(node, prefix) for node, sections in SECTIONS.items() for prefix in sections]


def full(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name


@pytest.fixture
def sample() -> RecordedInputs:
    return RecordedInputs(BagReader(SAMPLE))


def test_every_section_that_a_node_declares_is_known() -> None:
    for node, sections in SECTIONS.items():
        assert DECLARED[node].items() <= sections.items()


@pytest.mark.parametrize(("node", "prefix"), SECTIONS_OF_NODES)
def test_an_unknown_setting_is_named(sample: RecordedInputs, node: str, prefix: str) -> None:
    sample.settings[node][full(prefix, "no_such_thing")] = 1.0
    with pytest.raises(
        BagError, match=f"settings of the {node}: unknown key '{full(prefix, 'no_such_thing')}'.*version"
    ):
        RUNS[node](sample)


@pytest.mark.parametrize("node", SECTIONS)
def test_a_value_that_is_not_accepted_is_named(sample: RecordedInputs, node: str) -> None:
    prefix = {"controller": "limits", "observer": "safety", "planner": ""}[node]
    name = next(entry.name for entry in SECTIONS[node][prefix].declared() if entry.kind in (int, float))
    sample.settings[node][full(prefix, name)] = "much"
    with pytest.raises(BagError, match=f"settings of the {node}: {name} = 'much'"):
        RUNS[node](sample)


class TestChanges:
    def write(self, file: Path, **nodes: dict) -> ChangedSettings:
        file.write_text(yaml.safe_dump({name: {"ros__parameters": content} for name, content in nodes.items()}))
        return ChangedSettings(file)

    def test_only_what_the_file_names_changes(self, tmp_path: Path) -> None:
        recorded = recorded_sections("planner", {"period": 0.05}, "bag")
        changes = self.write(tmp_path / "changes.yaml", planner={"max_spheres": 3, "planning": {"horizon": 2}})
        made = changes.apply("planner", recorded)
        assert (made[""].period, made[""].max_spheres, made["planning"].horizon) == (0.05, 3, 2)
        assert made["impedance"] == recorded["impedance"]

    @pytest.mark.parametrize(
        ("node", "content", "name"),
        [
            ("controller", {"limits": {"torque_shar": 0.5}}, "limits.torque_shar"),
            ("observer", {"torque_sorce": "measured"}, "torque_sorce"),
            ("planner", {"max_sphere": 1}, "max_sphere"),
            ("model", {"inertias": "nominal"}, "inertias"),
        ],
    )
    def test_an_unknown_parameter_is_named(self, tmp_path: Path, node: str, content: dict, name: str) -> None:
        with pytest.raises(SettingsError, match=f"{node}: unknown key '{name}'"):
            self.write(tmp_path / "changes.yaml", **{node: content})

    def test_the_planner_plans_for_the_settings_that_the_controller_has(self, tmp_path: Path) -> None:
        content = {"impedance": {"task_damping": 90.0}, "supervision": {"max_position_error": 0.2}}
        changes = self.write(tmp_path / "changes.yaml", controller=content)
        for node in ("controller", "planner"):
            made = changes.apply(node, recorded_sections(node, {}, "bag"))
            assert (made["impedance"].task_damping, made["supervision"].max_position_error) == (90.0, 0.2)
