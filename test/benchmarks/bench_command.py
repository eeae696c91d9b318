"""Runs a benchmark's command line in the process of the tests."""

from typing import Any

import pytest

from benchmarks.output import run_command


def bench(module: Any, *arguments: Any) -> int:
    """Run `python -m benchmarks.MODULE` with these arguments, as text; returns its exit code."""
    with pytest.raises(SystemExit) as ended:
        run_command(lambda: module.main([str(argument) for argument in arguments]))
    assert isinstance(ended.value.code, int)
    return ended.value.code
