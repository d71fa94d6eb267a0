"""The pages of the site that are made at its build: from the code, and from the project's folder.

MkDocs calls `on_files` and `on_page_markdown` (``hooks`` in mkdocs.yml); `PAGES` is all there is.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def _from(name: str) -> Callable[[], str]:
    """The page is a file of the project's folder."""
    return lambda: (ROOT / name).read_text(encoding="utf-8")


def _program(name: str) -> Callable[[], str]:
    """The page shows a program of the project's folder."""
    return lambda: f"# {Path(name).stem}\n\n```python\n{_from(name)()}```\n"


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _head(*cells: str) -> str:
    return _row(*cells) + "|---" * len(cells) + "|\n"


# --- settings -------------------------------------------------------------------------------------


_SETTINGS = """\
# Settings

A profile is a TOML file that names what differs from these defaults, the built-in simulated hand.
Any key may be set for one run, as `--set loop.rate=1000`. SI units; pairs are [left, right].
Unknown keys, wrong types and numbers out of range are errors, all in one report.
`softfinger config reference SECTION` prints a section in the terminal, and
`softfinger config show hil > my.toml` begins a profile of your own.
"""


def configuration() -> str:
    """Every section and key, from the classes of the settings and the comments in them."""
    from softfinger.daemon.profile import settings

    source = inspect.getsource(settings)
    comments = {
        node.name: _comments(source.splitlines(), node)
        for node in ast.parse(source).body
        if isinstance(node, ast.ClassDef)
    }
    parts = [_SETTINGS]
    for section, field in settings.Settings.model_fields.items():
        model: Any = field.annotation
        schema = model.model_json_schema()["properties"] if model.model_fields else {}
        parts.append(
            f"\n## `[{section}]`\n\n{inspect.cleandoc(model.__doc__).replace('``', '`')}\n\n"
        )
        if schema:
            parts.append(_head("key", "default", "may be", "meaning, unit"))
        for key, default in model.model_fields.items():
            value = json.dumps(default.default, ensure_ascii=False)
            allowed = _allowed(settings, section, key, schema[key])
            meaning = comments[model.__name__].get(key, "")
            parts.append(_row(f"`{key}`", f"`{value}`", allowed, meaning))
    return "".join(parts)


def _comments(lines: list[str], node: ast.ClassDef) -> dict[str, str]:
    """What stands behind each field of a class."""
    found = {}
    for each in node.body:
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name):
            rest = lines[(each.end_lineno or 1) - 1].encode()[each.end_col_offset :].decode()
            found[each.target.id] = rest.strip().removeprefix("#").strip()
    return found


def _allowed(settings: Any, section: str, key: str, schema: dict[str, Any]) -> str:
    """The values that a key takes, in words."""
    names = {
        "servos.backend": settings.SERVOS,
        "tactile.backend": settings.TACTILE,
        "simulation.object_shape": settings.SHAPES,
    }.get(f"{section}.{key}")
    if names is not None:
        return ", ".join(f"`{name}`" for name in names) + ", or a [plugin](plugins.md)'s"
    return _words(schema)


def _words(schema: dict[str, Any]) -> str:
    if "prefixItems" in schema:
        return f"pair: {_words(schema['prefixItems'][0])}"
    if "items" in schema:
        return f"list: {_words(schema['items'])}"
    if "enum" in schema:
        return ", ".join(f"`{json.dumps(value)}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{json.dumps(schema['const'])}`"
    ends = [
        ("≥", "minimum"),
        (">", "exclusiveMinimum"),
        ("≤", "maximum"),
        ("<", "exclusiveMaximum"),
    ]
    bounds = [f"{sign} {schema[end]:.7g}" for sign, end in ends if end in schema]
    kinds = {"number": "", "integer": "whole", "boolean": "`true`, `false`", "string": "text"}
    return ", ".join(filter(None, [kinds[schema["type"]], *bounds]))


# --- the stream -----------------------------------------------------------------------------------


def stream() -> str:
    """Every topic and field, from the schema."""
    from softfinger.daemon.wire.schema_docs import page

    return page()


PAGES: dict[str, Callable[[], str]] = {
    "index.md": _from("README.md"),
    "contributing.md": _from("CONTRIBUTING.md"),
    "changelog.md": _from("CHANGELOG.md"),
    "example.md": _program("tools/examples/grasp_and_turn.py"),
    "configuration.md": configuration,
    "stream.md": stream,
}
# Where a link to a file of the project's folder leads to on the site.
_LINKS = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "daemon/wire/STREAM.md": "stream.md",
    "config/sim.toml": "configuration.md",
    "tools/examples/grasp_and_turn.py": "example.md",
    "daemon/tactile/cobs.py": "contributing.md#a-tactile-board",
}


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that no file in docs/ holds."""
    from mkdocs.structure.files import File

    for name, make in PAGES.items():
        files.append(File.generated(config, name, content=make()))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links as a reader of the repository follows them, made the site's."""

    def link(found: re.Match[str]) -> str:
        target = found[1].removeprefix("../").removeprefix("docs/")
        return f"]({_LINKS.get(target, target)}{found[2]})"

    return re.sub(r"\]\(((?!https?:)[^)#]+)(#[^)]*|)\)", link, markdown)
