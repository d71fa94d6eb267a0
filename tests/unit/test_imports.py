"""Test import directions, import cycles, class names, and the base class of exceptions."""

import ast
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import softfinger

ROOT = Path(softfinger.__file__).parents[1]
# Each package may import itself and the packages before it.
ORDER = ("kinematics", "daemon", "tools")
PAGE = ROOT / "docs" / "architecture.md"
BUILT_IN = {"Exception", "ValueError", "RuntimeError", "OSError", "TimeoutError"}


@cache
def modules() -> dict[str, Path]:
    """Return the name and file of every module of softfinger."""
    files = (file for top in ORDER for file in (ROOT / top).rglob("*.py"))
    return {
        ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
        for file in files
    }


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_bytes())


def imported(file: Path) -> Iterator[str]:
    """Return the softfinger modules that ``file`` imports, except for type annotations."""
    waiting: list[ast.AST] = [parsed(file)]
    while waiting:
        node = waiting.pop()
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            waiting.extend(ast.iter_child_nodes(node))
        if isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{each.name}" for each in node.names]
        elif isinstance(node, ast.Import):
            names = [each.name for each in node.names]
        else:
            continue
        for name in (each.removeprefix("softfinger.") for each in names):
            # In `from a.b import c`, c is a module or a member of b.
            found = {name, name.rpartition(".")[0]} & modules().keys()
            if found:
                yield max(found, key=len)


@cache
def imports() -> dict[str, set[str]]:
    """Return the imports of each module."""
    return {name: {*imported(file)} - {name} for name, file in modules().items()}


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Return an import cycle, if there is one."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def packages(top: str) -> dict[str, set[str]]:
    """Return the imports between the subpackages of ``top``.

    A module directly in ``top`` counts as a subpackage.
    """
    graph: dict[str, set[str]] = {}
    for name, others in imports().items():
        if name.startswith(f"{top}."):
            package = graph.setdefault(name.split(".")[1], set())
            package |= {each.split(".")[1] for each in others if each.startswith(f"{top}.")}
    return {package: others - {package} for package, others in graph.items()}


def table_of_rooms() -> list[str]:
    """Return the rows of the table of packages on the architecture page."""
    _, _, after = PAGE.read_text(encoding="utf-8").partition("| package |")
    return [line for line in after.partition("\n\n")[0].splitlines() if line.startswith("| `")]


def test_cycles_and_imports_are_found():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set[str]()}
    assert set(circle(graph)) == {"a", "b", "c"}
    assert len(modules()) > 100
    assert "kinematics.compiled.kernel" in imports()["kinematics.contact.lookup"]


def test_tools_import_the_daemon_and_both_import_kinematics():
    for name, others in imports().items():
        allowed = ORDER[: ORDER.index(name.split(".")[0]) + 1]
        wrong = [each for each in others if each.split(".")[0] not in allowed]
        assert not wrong, f"{name} imports {', '.join(sorted(wrong))}"


def test_modules_have_no_import_cycles():
    assert circle(imports()) == []


def test_rooms_have_no_import_cycles():
    for top in ORDER:
        assert circle(packages(top)) == [], top


def test_daemon_rooms_import_downwards_in_the_architecture_table():
    rows = (re.findall(r"`daemon/(\w+)", line.split("|")[1]) for line in table_of_rooms())
    place = {package: row for row, names in enumerate(rows) for package in names}
    graph = packages("daemon")
    assert place.keys() == graph.keys()
    for package, others in graph.items():
        wrong = sorted(each for each in others if place[each] <= place[package])
        assert not wrong, (
            f"daemon/{package} imports {', '.join(wrong)}, but may import only lower packages"
        )


def test_clients_and_gateway_import_neither_loop_nor_profile():
    graph = packages("daemon")
    assert not {"loop", "profile"} & (graph["client"] | graph["gateway"])


def test_class_names_are_unique():
    names = Counter(
        node.name
        for file in modules().values()
        for node in parsed(file).body
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_every_exception_derives_from_the_base_class():
    alone = [
        f"{file}: {node.name}"
        for file in modules().values()
        for node in ast.walk(parsed(file))
        if isinstance(node, ast.ClassDef) and node.bases
        if {base.id for base in node.bases if isinstance(base, ast.Name)} <= BUILT_IN
        and all(isinstance(base, ast.Name) for base in node.bases)
    ]
    assert alone == []
