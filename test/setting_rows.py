"""Rows of the tables that list settings in the documentation."""

from contact_reach_ros.settings import Setting, Value


def setting_row(name: str, entry: Setting) -> str:
    """The row of one value: name, default, what it accepts, meaning."""
    return f"| `{name}` | {shown(entry.default)} | {entry.accepts} | {entry.description} |"


def shown(value: Value) -> str:
    """A default in the words of the documentation."""
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return "null"
    if value == ():
        return "(empty)"
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{item:g}" for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value) or "(empty)"
