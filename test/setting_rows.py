"""Rows of the tables that list settings in the documentation."""

from contact_reach_ros.command_line import shown
from contact_reach_ros.settings import Setting


def setting_row(name: str, entry: Setting) -> str:
    """The row of one value: name, default, what it accepts, meaning."""
    return f"| `{name}` | {shown(entry.default)} | {entry.accepts} | {entry.description} |"
