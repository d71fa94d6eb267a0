"""Imports run one way, without circles; names of classes, and the root of exceptions."""

import ast
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import softfinger

ROOT = Path(softfinger.__file__).parents[1]
ORDER = ("kinematics", "daemon", "tools")  # each imports itself and those before it
PAGE = ROOT / "docs" / "architecture.md"
BUILT_IN = {"Exception", "ValueError", "RuntimeError", "OSError", "TimeoutError"}


@cache
def modules() -> dict[str, Path]:
    """Every module's name below softfinger and its file."""
    files = (file for top in ORDER for file in (ROOT / top).rglob("*.py"))
    return {
        ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
        for file in files
    }


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_bytes())


def imported(file: Path) -> Iterator[str]:
    """Modules of ours that ``file`` imports, at its top or within a function, but for types."""
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
            # `from a.b import c`: c is a module, or something in b.
            found = {name, name.rpartition(".")[0]} & modules().keys()
            if found:
                yield max(found, key=len)


@cache
def imports() -> dict[str, set[str]]:
    """What each module imports."""
    return {name: {*imported(file)} - {name} for name, file in modules().items()}


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """A circle in what imports what, or none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def rooms(top: str) -> dict[str, set[str]]:
    """What each room of ``top`` imports of its sister rooms; a module beside them is one itself."""
    graph: dict[str, set[str]] = {}
    for name, others in imports().items():
        if name.startswith(f"{top}."):
            room = graph.setdefault(name.split(".")[1], set())
            room |= {each.split(".")[1] for each in others if each.startswith(f"{top}.")}
    return {room: others - {room} for room, others in graph.items()}


def table_of_rooms() -> list[str]:
    """The rows of the table of rooms in the architecture's page, top down."""
    _, _, after = PAGE.read_text(encoding="utf-8").partition("| room |")
    return [line for line in after.partition("\n\n")[0].splitlines() if line.startswith("| `")]


def test_circles_and_imports_are_found():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set[str]()}
    assert set(circle(graph)) == {"a", "b", "c"}
    assert len(modules()) > 100
    assert "kinematics.compiled.kernel" in imports()["kinematics.contact.lookup"]


def test_tools_use_the_daemon_and_both_use_kinematics():
    for name, others in imports().items():
        allowed = ORDER[: ORDER.index(name.split(".")[0]) + 1]
        wrong = [each for each in others if each.split(".")[0] not in allowed]
        assert not wrong, f"{name} imports {', '.join(sorted(wrong))}"


def test_no_files_import_in_a_circle():
    assert circle(imports()) == []


def test_no_rooms_import_in_a_circle():
    for top in ORDER:
        assert circle(rooms(top)) == [], top


def test_the_daemons_rooms_import_downwards_in_the_table_of_the_architecture():
    rows = (re.findall(r"`daemon/(\w+)", line.split("|")[1]) for line in table_of_rooms())
    place = {room: row for row, names in enumerate(rows) for room in names}
    graph = rooms("daemon")
    assert place.keys() == graph.keys()
    for room, others in graph.items():
        wrong = sorted(each for each in others if place[each] <= place[room])
        assert not wrong, f"daemon/{room} imports {', '.join(wrong)}, not below it in the table"


def test_clients_and_gateway_know_neither_loop_nor_profile():
    graph = rooms("daemon")
    assert not {"loop", "profile"} & (graph["client"] | graph["gateway"])


def test_each_class_has_a_name_of_its_own():
    names = Counter(
        node.name
        for file in modules().values()
        for node in parsed(file).body
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_every_exception_derives_from_the_root():
    alone = [
        f"{file}: {node.name}"
        for file in modules().values()
        for node in ast.walk(parsed(file))
        if isinstance(node, ast.ClassDef) and node.bases
        if {base.id for base in node.bases if isinstance(base, ast.Name)} <= BUILT_IN
        and all(isinstance(base, ast.Name) for base in node.bases)
    ]
    assert alone == []
