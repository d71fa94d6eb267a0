"""All exceptions have one root."""

from __future__ import annotations

import ast
from pathlib import Path

import softfinger

_PACKAGE = Path(softfinger.__file__).parent
_BUILT_IN = {"Exception", "ValueError", "RuntimeError", "OSError", "TimeoutError"}


def test_every_exception_derives_from_the_root() -> None:
    alone = [
        f"{path}: {node.name}"
        for room in ("daemon", "kinematics", "tools")
        for path in (_PACKAGE / room).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef) and node.bases
        if {base.id for base in node.bases if isinstance(base, ast.Name)} <= _BUILT_IN
        and all(isinstance(base, ast.Name) for base in node.bases)
    ]
    assert alone == []
