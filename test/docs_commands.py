"""The commands in the documentation: what a fenced block without a language holds, line by line."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "bags/README.md", "benchmarks/*.md", *(f"{folder}/*.md" for folder in ("docs", "msg_docs")))
PROGRAM = ("contact-reach", ".venv/bin/contact-reach")
NODE = re.compile(r"\.venv/bin/(?!contact-reach)(\w+)")


class Command(NamedTuple):
    """One command of a page."""

    page: str
    line: str
    """As a shell takes it, without its comment."""

    @property
    def words(self) -> list[str]:
        """Program and arguments, without variables that are set for it."""
        words = shlex.split(self.line)
        while re.match(r"[A-Z_]+=", words[0]):
            words = words[1:]
        return words


def commands() -> list[Command]:
    """All commands, page by page in their order."""
    pages = sorted(page for pattern in PAGES for page in ROOT.glob(pattern))
    return [Command(str(page.relative_to(ROOT)), line) for page in pages for line in _lines(page)]


def _lines(page: Path) -> list[str]:
    lines = []
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.DOTALL | re.MULTILINE):
        if language:
            continue
        joined = re.sub(r"\\\n\s*", " ", block)
        # A loop is one command.
        joined = re.sub(r"^for .*?^done$", lambda loop: "; ".join(loop[0].split("\n")), joined, flags=re.S | re.M)
        lines += [re.sub(r"\s+# .*", "", line) for line in joined.splitlines() if line.strip()]
    return lines
