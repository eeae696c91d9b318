"""Actions of the page's users on the stack."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

from contact_reach_ros.arrays import Array

Value = bool | int | float | str


class Parameter(NamedTuple):
    """A node's parameter, as declared.

    Attributes
    ----------
    name
        Name with its prefix.
    value
        Present value.
    description
        Description with its unit.
    minimum, maximum
        Limits; None for no limit.
    """

    name: str
    value: Value
    description: str
    minimum: float | None
    maximum: float | None


class Actions(Protocol):
    """Actions on the running stack. All may take seconds; most return their outcome as a line for the page."""

    def send_goal(self, position: Array) -> str:
        """Command a flange position (3,), m."""

    def stop(self) -> str:
        """Stop the arm."""

    def reset(self) -> str:
        """Release all stops."""

    def restart(self, scene: str, seed: int) -> str:
        """Restart the simulated stack with a scene and seed."""

    def nodes(self) -> Sequence[str]:
        """Names of the nodes whose parameters can be shown."""

    def parameters(self, node: str) -> Sequence[Parameter]:
        """The parameters of a node; raises `ContactReachError` if it does not answer."""

    def apply(self, node: str, values: Mapping[str, Value]) -> str:
        """Change parameters of a node and restart the stack."""
