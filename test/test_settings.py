"""Typed settings: kinds, ranges, and messages that name what is wrong and what is expected."""

import array
import dataclasses
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from contact_reach_ros.errors import SettingsError
from contact_reach_ros.settings import Settings, read_yaml, setting, unknown_key


@dataclasses.dataclass(frozen=True)
class Everything(Settings):
    """One value of each kind."""

    switch: bool = setting(True, "a switch")
    count: int = setting(3, "a count", minimum=1, maximum=10)
    gain: float = setting(0.5, "a gain", unit="1/s", minimum=0.0)
    limit: float = setting(1.0, "a limit", unit="m", maximum=2.0)
    name: str = setting("abc", "a name")
    mode: str = setting("slow", "a mode", choices=("slow", "fast"))
    corner: tuple[float, ...] = setting((1.0, 2.0, 3.0), "a corner", unit="m", minimum=-5.0, maximum=5.0)
    place: tuple[float, ...] | None = setting(None, "a place, if any", unit="m", maximum=5.0, optional_length=2)


def make(**values) -> Everything:
    return Everything.from_mapping(values, "settings.yaml")


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "switch": st.booleans(),
            "count": st.integers(1, 10),
            "gain": st.floats(0, allow_infinity=False),
            "limit": st.floats(max_value=2.0, allow_infinity=False),
            "name": st.text(),
            "mode": st.sampled_from(["slow", "fast"]),
            "corner": st.lists(st.floats(-5, 5), min_size=3, max_size=3),
            "place": st.none() | st.lists(st.floats(-5, 5), min_size=2, max_size=2),
        },
    )
)
def test_values_within_the_declarations_are_taken_as_they_are(values):
    taken = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    assert vars(make(**values)) == {**vars(Everything()), **taken}


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("switch", 1, "true or false"),
        ("count", True, "an integer in [1, 10]"),
        ("count", 11, "an integer in [1, 10]"),
        ("gain", -1e-9, "a number in [0, inf] 1/s"),
        ("gain", math.nan, "a number in [0, inf] 1/s"),
        ("gain", 10**400, "a number in [0, inf] 1/s"),
        ("gain", "0.5", "a number in [0, inf] 1/s"),
        ("limit", 2.1, "a number in [-inf, 2] m"),
        ("name", 5, "a string"),
        ("mode", "medium", "one of slow, fast"),
        ("place", [1.0], "null, or a list of 2 values, each a number in [-inf, 5] m"),
        ("corner", (1.0, 2.0), "a list of 3 values, each a number in [-5, 5] m"),
        ("corner", "123", "a list of 3 values, each a number in [-5, 5] m"),
    ],
)
def test_other_values_are_refused_and_named(key, value, expected):
    with pytest.raises(SettingsError) as raised:
        make(**{key: value})
    assert str(raised.value) == f"settings.yaml: {key} = {value!r}: expected {expected}"


def test_wrong_element_of_a_list_is_named():
    with pytest.raises(SettingsError, match=r"^settings\.yaml: corner = 6\.0: expected a list of 3 values"):
        make(corner=[0.0, 6.0, 0.0])


def test_integers_and_arrays_become_floats_and_tuples_where_these_are_declared():
    # ROS parameters come as arrays.
    settings = make(gain=2, corner=array.array("i", [1, 2, 3]))
    assert settings.corner == (1.0, 2.0, 3.0)
    assert {type(value) for value in (settings.gain, *settings.corner)} == {float}


def test_values_given_in_code_are_checked_alike_and_cannot_be_changed():
    with pytest.raises(SettingsError, match=r"^Everything\.count = 11: expected an integer in \[1, 10\]$"):
        dataclasses.replace(Everything(), count=11)
    with pytest.raises(dataclasses.FrozenInstanceError):
        Everything().count = 4


def test_unknown_key_names_the_nearest_one_or_all():
    with pytest.raises(SettingsError, match=r"^settings.yaml: unknown key 'cuont'; did you mean 'count'\?$"):
        make(cuont=4)
    assert unknown_key("xyzzy", ["beta", "alpha"], "file") == "file: unknown key 'xyzzy'; known keys: alpha, beta"


@dataclasses.dataclass(frozen=True)
class PerJoint(Settings):
    """Values for each joint of an arm, and one that has nothing to do with it."""

    thresholds: tuple[float, ...] = setting(None, "thresholds", unit="Nm", minimum=0.5, maximum=10.0, per_joint=True)
    friction: tuple[float, ...] = setting(None, "friction", minimum=0.0, per_joint=True)
    gain: float = setting(0.5, "a gain")


class ThreeJoints:
    """An arm as far as settings know one."""

    def default(self, name: str) -> tuple[float, ...]:
        return {"thresholds": (1.0, 2.0, 3.0)}.get(name, (0.0, 0.0, 0.0))


class TestPerJoint:
    """Lists with one value for each joint, whose length and default are the arm's."""

    def test_the_arms_own_values_stand_in_for_those_that_are_not_given(self):
        assert PerJoint().thresholds is None
        resolved = PerJoint(friction=[4, 5, 6], gain=2.0).resolve(ThreeJoints())
        assert resolved == PerJoint(thresholds=(1.0, 2.0, 3.0), friction=(4.0, 5.0, 6.0), gain=2.0)
        assert resolved.resolve(ThreeJoints()) == resolved

    def test_another_number_of_values_than_joints_is_refused_when_the_arm_is_known(self):
        with pytest.raises(SettingsError, match=r"^PerJoint\.friction = .*: expected a list of 3 values"):
            PerJoint(friction=[1.0, 1.0]).resolve(ThreeJoints())

    def test_each_value_is_checked_at_once(self):
        expected = re.escape("expected a list with one value for each joint, each a number in [0.5, 10] Nm")
        with pytest.raises(SettingsError, match=f"^file: thresholds = 0.4: {expected}$"):
            PerJoint.from_mapping({"thresholds": [1.0, 0.4, 1.0]}, "file")


def test_yaml_files_hold_mappings_numbers_as_ros_reads_them_and_the_lists_of_launch(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("a: 1e-3\nb: {c: !!python/tuple [1, 2]}\n")
    assert read_yaml(file) == {"a": 0.001, "b": {"c": [1, 2]}}


@pytest.mark.parametrize("content", [b"", b"- 1", b"a: [1", b"a: \xff", b"a: !!python/object/apply:os.getcwd []", None])
def test_other_content_is_refused_and_the_file_named(tmp_path, content):
    file = tmp_path / "a.yaml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(SettingsError, match=f"^{file}: (holds|is empty|not valid YAML|cannot be read)"):
        read_yaml(file)
