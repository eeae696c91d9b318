"""Everything that the last version had and this one has not is refused with what to do instead."""

import re

import pytest
import yaml
from contact_reach_command import contact_reach

from contact_reach_ros import removed
from contact_reach_ros.arms import known_parameters, load_arm
from contact_reach_ros.errors import ContactReachError, SettingsError
from contact_reach_ros.presets import SECTIONS, check_parameters
from contact_reach_ros.settings import check_values
from contact_reach_ros.world.scene_file import read_scene


@pytest.mark.parametrize("node", removed.PARAMETERS)
def test_parameters(tmp_path, node):
    known = known_parameters(SECTIONS[node], load_arm())
    for name, sentence in removed.PARAMETERS[node].items():
        expected = re.escape(f"'{name}' was removed in 0.3.0: {sentence}")
        with pytest.raises(SettingsError, match=f"^argument: {expected}$"):
            check_values({name: 1.0}, known, "argument")
    file = tmp_path / "old.yaml"
    file.write_text(yaml.safe_dump({node: {"ros__parameters": {name: 1.0}}}))
    with pytest.raises(SettingsError, match=f"^{file}: {node}: {expected}$"):
        check_parameters(file)


@pytest.mark.parametrize("key", removed.SCENE_KEYS)
def test_keys_of_scenes(tmp_path, key):
    file = tmp_path / "old.yaml"
    file.write_text(yaml.safe_dump({"base": "free", "ball": {key: 0.1}}))
    with pytest.raises(ContactReachError, match=f"'{key}' was removed in 0.3.0: "):
        read_scene(str(file))


@pytest.mark.parametrize("command", removed.COMMANDS)
def test_commands(capsys, command):
    assert contact_reach(*command.split(), "argument") == 2
    assert capsys.readouterr().err == f"contact-reach: '{command}' was removed in 0.3.0: {removed.COMMANDS[command]}\n"


def test_options_count_wherever_they_stand_and_other_words_do_not():
    assert removed.removed_command(["report", "bags/sample", "--csv=tables"])
    assert not removed.removed_command(["bench", "--json", "faults"])
    assert not removed.removed_command([])
