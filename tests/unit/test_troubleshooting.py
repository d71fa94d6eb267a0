"""What docs/troubleshooting.md quotes is what the program says: each message is in its sources."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"(?m)^\| ([^|]*) \|.*\|.*\|$")


def texts() -> set[str]:
    """Every text in the sources, with … for the values in it."""
    found = set()
    for path in [
        *ROOT.glob("daemon/**/*.py"),
        *ROOT.glob("tools/**/*.py"),
        *ROOT.glob("kinematics/**/*.py"),
    ]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = node.values
                found.add("".join(p.value if isinstance(p, ast.Constant) else "…" for p in parts))  # type: ignore[misc]
    return found


def test_every_message_is_the_programs_own() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    quoted = [text for row in ROW.findall(page) for text in re.findall(r"`([^`]+)`", row)]
    assert len(quoted) > 45
    known = "\n".join(texts())
    unknown = []
    for message in quoted:
        words = r"[^\n]*".join(map(re.escape, filter(None, re.split(r" ?… ?", message.strip()))))
        if not re.search(words, known):
            unknown.append(message)
    assert unknown == []
