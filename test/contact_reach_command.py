"""Runs `contact-reach` in the process of the tests."""

from typing import Any

import pytest

from contact_reach_ros.cli import main


def contact_reach(*arguments: Any) -> int:
    """Run the command line with these arguments, as text; returns its exit code."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code
