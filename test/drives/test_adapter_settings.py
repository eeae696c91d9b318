"""What the adapter's settings refuse."""

import pytest

from contact_reach_ros.drives.settings import EffortSettings, FrankaSettings, LbrSettings
from contact_reach_ros.errors import SettingsError


@pytest.mark.parametrize("name", ["", "/", "my controller", "a//b", "lbr/", "1st"])
@pytest.mark.parametrize("made", [EffortSettings, FrankaSettings, LbrSettings])
def test_names_that_ros_would_not_take_are_refused(made, name):
    key = "driver" if made is LbrSettings else "controller"
    with pytest.raises(SettingsError, match=rf"{key} = '{name}': expected a name of letters, digits and _"):
        made(**{key: name})


def test_names_may_be_those_of_a_namespace():
    assert EffortSettings("/left/effort_controller").controller == "/left/effort_controller"
