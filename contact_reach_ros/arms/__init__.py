"""The arms that come with the package, one table each."""

from __future__ import annotations

import functools
import importlib
import pkgutil

from contact_reach_ros.arm.arm import Arm
from contact_reach_ros.errors import SettingsError

DEFAULT_ARM = "iiwa14"
ARMS = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))
"""Names that `load_arm` takes: those of the modules in this folder."""


@functools.cache
def load_arm(name: str = DEFAULT_ARM) -> Arm:
    """Load an arm by name; each call returns the same object.

    Raises
    ------
    SettingsError
        If there is no such arm; the message lists the available ones.
    """
    if name not in ARMS:
        raise SettingsError(f"arm '{name}' is unknown; expected one of {', '.join(ARMS)}")
    arm: Arm = importlib.import_module(f"{__name__}.{name}").ARM
    return arm
