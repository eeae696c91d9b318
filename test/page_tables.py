"""Tables of pages that are made by tests."""

from __future__ import annotations


def replaced(text: str, heading: str, table: str) -> str:
    """The page with the table after a heading replaced; what stands before it and after it stays."""
    lines = text.splitlines()
    start = lines.index(heading) + 1
    end = next((at for at in range(start, len(lines)) if lines[at].startswith("#")), len(lines))
    is_made = [line.startswith("|") for line in lines[start:end]]
    first = start + is_made.index(True) if True in is_made else end
    last = start + len(is_made) - is_made[::-1].index(True) if True in is_made else end
    return "\n".join([*lines[:first], *table.rstrip("\n").split("\n"), *lines[last:]]) + "\n"
