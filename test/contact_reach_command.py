"""Runs command lines in the process of the tests, and programs in processes of their own."""

import subprocess
import sys
from typing import Any

import pytest

from benchmarks.output import run_command
from contact_reach_ros.cli import main


def contact_reach(*arguments: Any) -> int:
    """Run `contact-reach` with these arguments, as text; returns its exit code."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    assert isinstance(ended.value.code, int)
    return ended.value.code


def bench(module: Any, *arguments: Any) -> int:
    """Run `python -m benchmarks.MODULE` with these arguments, as text; returns its exit code."""
    with pytest.raises(SystemExit) as ended:
        run_command(lambda: module.main([str(argument) for argument in arguments]))
    assert isinstance(ended.value.code, int)
    return ended.value.code


def python(program: str, *arguments: str, **options: Any) -> str:
    """What a Python program prints; `options` are those of `subprocess.run`."""
    command = [sys.executable, "-c", program, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, **options)
    assert result.returncode == 0, f"{result.stdout}\n{result.stderr}"
    return result.stdout
