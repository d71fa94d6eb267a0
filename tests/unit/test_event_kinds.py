"""Test that the documentation lists exactly the kinds of event that the sources emit."""

import ast
from collections.abc import Iterator
from pathlib import Path

import softfinger
from softfinger.daemon.safety.limits import LIMITS
from softfinger.daemon.wire.event_kinds import KINDS

ROOT = Path(softfinger.__file__).parents[1]
LEVELS = ("info", "warning", "error")
WARNS = {"_warn": "warning"}  # functions that take the kind first, and their level


def written(expression: ast.expr) -> str:
    return expression.value if isinstance(expression, ast.Constant) else ""


def emitted(source: str) -> Iterator[tuple[str, str]]:
    """Yield the level and kind of each event that the source writes as (level, kind, text)."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and (level := WARNS.get(getattr(node.func, "attr", ""))):
            yield level, written(node.args[0])
        values = node.elts if isinstance(node, ast.Tuple) else getattr(node, "args", None)
        if isinstance(values, list) and len(values) == 3 and written(values[0]) in LEVELS:
            yield written(values[0]), written(values[1])


def test_events_are_found_in_calls_and_tuples():
    source = 'a.emit("info", "x", t); b = ("error", "y", t); self._warn("z", t); f("info", "x")'
    assert sorted(emitted(source)) == [("error", "y"), ("info", "x"), ("warning", "z")]


def test_every_kind_of_event_is_documented_with_its_levels():
    levels: dict[str, set[str]] = {
        row.name: set() for row in LIMITS if row.level in ("warn", "fault")
    }
    for row in LIMITS:
        if row.level != "limit":
            levels[row.name].add({"warn": "warning", "fault": "error"}[row.level])
    for folder in ("daemon", "tools/processes"):
        for file in (ROOT / folder).rglob("*.py"):
            for level, kind in emitted(file.read_text(encoding="utf-8")):
                if kind.islower():  # Skip constants from `safety.limits`.
                    levels.setdefault(kind, set()).add(level)
    levels["torque.off"].add("info")  # safety.torque_state uses a constant for the kind.
    assert {kind: set(each.levels.split(", ")) for kind, each in KINDS.items()} == levels


def test_every_warning_and_error_has_a_remedy():
    for kind, each in KINDS.items():
        texts = [each.cause, each.remedy] if each.levels != "info" else [each.cause]
        for text in texts:
            assert text.endswith("."), kind
            assert text[0].isupper() or text[0] == "`", kind
