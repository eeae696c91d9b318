"""The arm as a value: what makes two of them equal, and what they answer."""

import copy
import dataclasses
import pickle

import numpy as np
import pytest
import yaml
from arm_simulation import ARM
from six_axis import SIX_AXIS

from contact_reach_ros.arm import tip_positions
from contact_reach_ros.arm.capsules import pair_distances, self_pairs
from contact_reach_ros.arm.table import table_of
from contact_reach_ros.arms import ARMS, is_shipped, load_arm
from contact_reach_ros.control.settings import ImpedanceSettings
from contact_reach_ros.control.stability import check_gains
from contact_reach_ros.errors import SettingsError
from contact_reach_ros.timing import PERIOD


def test_copies_are_equal_and_the_same_key():
    for copied in (copy.deepcopy(ARM), dataclasses.replace(ARM), pickle.loads(pickle.dumps(ARM))):
        assert copied == ARM and hash(copied) == hash(ARM) and copied.digest == ARM.digest


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "other"},
        {"tip_offset": (0.0, 0.0, 0.046)},
        {"tip_rotation": (0.0, 1.0, 0.0, 0.0)},
        {"joints": (dataclasses.replace(ARM.joints[0], upper=3.0), *ARM.joints[1:])},
        {"capsules": ARM.capsules[:-1]},
        {"inertia_sets": {"nominal": ARM.inertias()}},
        {"reach": 0.8},
        {"gravity": (0.0, 0.0, 9.81)},
        {"home": (0.1, *ARM.home[1:])},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_whatever_models_are_built_from_makes_another_arm(changes):
    other = dataclasses.replace(ARM, **changes)
    assert other != ARM and other.digest != ARM.digest


def test_the_digest_of_the_iiwa_is_that_in_bags():
    assert ARM.digest == "b9910d2d7c624b0e"


class TestLoadArm:
    @pytest.mark.parametrize("name", ["iiwa15", "", "../arms/iiwa14"])
    def test_an_unknown_name_is_refused_and_the_known_ones_are_listed(self, name):
        with pytest.raises(SettingsError, match=f"arm '{name}' is unknown; expected one of .*{', '.join(ARMS)}"):
            load_arm(name)

    @pytest.mark.parametrize("name", ARMS)
    def test_shipped_arms_are_named_as_their_files_and_have_a_posture_to_start_from(self, name):
        arm = load_arm(name)
        assert arm.name == name and is_shipped(arm) and not is_shipped(dataclasses.replace(arm, tip_frame="probe"))
        pairs = np.array(self_pairs(arm)).reshape(-1, 2)
        assert pair_distances(arm, np.array([arm.home]), pairs).min() > 0.0
        assert np.linalg.norm(tip_positions(arm, np.array([arm.home]))[0] - arm.shoulder) <= arm.reach
        check_gains(arm, ImpedanceSettings(), PERIOD)

    def test_an_arm_comes_from_a_file_too(self, tmp_path):
        file = tmp_path / "mine.yaml"
        file.write_text(yaml.dump(table_of(SIX_AXIS)))
        arm = load_arm(str(file))
        assert arm is load_arm(str(file)) and arm.joint_names == SIX_AXIS.joint_names
        home = np.array([arm.home])
        np.testing.assert_allclose(tip_positions(arm, home), tip_positions(SIX_AXIS, home), rtol=0, atol=1e-9)
        with pytest.raises(SettingsError, match=r"none.urdf: cannot be read"):
            load_arm(str(tmp_path / "none.urdf"))
