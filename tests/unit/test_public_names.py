"""Test that public names are exported and fully documented, and that the site lists them."""

import ast
import dataclasses
import importlib
import inspect
import re
from enum import Enum
from pathlib import Path
from typing import Any

import pytest

import softfinger
from softfinger import testing
from softfinger.daemon.wire.fields import TOPICS, members

ROOT = Path(softfinger.__file__).parents[1]
NAMES = [name for name in softfinger.__all__ if name != "__version__"]
CODE = [ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("tools/examples/*.py")]
IMPORT = re.compile(r"(?m)^ *from (softfinger[\w.]*) import ([\w, ]+)$")


def fields(cls: type) -> list[str]:
    if dataclasses.is_dataclass(cls):
        return [each.name for each in dataclasses.fields(cls) if each.init and each.repr]
    return list(getattr(cls, "_fields", ()))


RECORDS = [name for name in NAMES if fields(getattr(softfinger, name)) and name != "Material"]


def listed(text: str) -> dict[str, str]:
    """Return the names and descriptions in a docstring's Attributes and Parameters sections."""
    found = {}
    for section in re.findall(
        r"(?ms)^(?:Attributes|Parameters)\n-+\n(.*?)(?=^\w[^\n]*\n---|\Z)", text
    ):
        for names, told in re.findall(r"(?m)^(\w[^\n:]*)(?: : \w+)?\n((?:    .*\n?)+)", section):
            found |= dict.fromkeys(names.split(", "), told)
    return found


def test_the_three_lists_of_names_are_the_same():
    tree = ast.parse(Path(softfinger.__file__).read_text(encoding="utf-8"))
    (block,) = (each for each in tree.body if isinstance(each, ast.If))
    imports = {
        alias.name: node.module.removeprefix("softfinger.")
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert imports == softfinger._MODULES
    assert set(NAMES) == {*imports, "SoftfingerError"}
    assert softfinger.__all__ == sorted(softfinger.__all__)


def test_every_record_of_the_stream_is_public():
    waiting: list[Any] = [topic.record for topic in TOPICS.values()]
    while waiting:
        record = waiting.pop()
        assert getattr(softfinger, record.__name__) is record
        waiting += [each.type for each in members(record) if dataclasses.is_dataclass(each.type)]


@pytest.mark.parametrize("name", RECORDS)
def test_every_field_of_a_record_is_documented(name):
    cls = getattr(softfinger, name)
    told = listed(inspect.getdoc(cls) or "")
    assert [each for each in fields(cls) if not told.get(each, "").strip()] == []


def test_fields_tell_their_units():
    for topic in TOPICS.values():
        told = listed(inspect.getdoc(topic.record) or "")
        for each in members(topic.record):
            assert told[each.name].strip()
            assert not each.unit or told[each.name].rstrip().endswith(f"[{each.unit}]")
    told = listed(inspect.getdoc(softfinger.FingerState) or "")
    assert told["d"].strip() == "maximum displacement of the tip [m]"


@pytest.mark.parametrize("name", NAMES)
def test_every_public_name_and_method_is_documented(name):
    found = getattr(softfinger, name)
    assert inspect.getdoc(found)
    if isinstance(found, type) and not issubclass(found, Enum | Exception):
        methods = (each for each in dir(found) if not each.startswith("_"))
        members = {each: inspect.getattr_static(found, each) for each in methods}
        documented = (property, classmethod, staticmethod, type(lambda: 0))
        wanting = [
            each
            for each, member in members.items()
            if isinstance(member, documented) and not inspect.getdoc(getattr(found, each))
        ]
        assert wanting == []


@pytest.mark.parametrize("name", [name for name in testing.__all__ if name[0].isupper()])
def test_every_parameter_of_a_test_hand_is_documented(name):
    cls = getattr(testing, name)
    told = re.findall(r"(?m)^(\w[\w, ]*) : ", inspect.getdoc(cls) or "")
    assert {*inspect.signature(cls).parameters} <= {n for each in told for n in each.split(", ")}


def imported() -> list[tuple[str, str]]:
    """Return a pair of submodule and name for each name that the pages import."""
    pairs = {
        (module, name.strip())
        for path in CODE
        for module, names in IMPORT.findall(path.read_text(encoding="utf-8"))
        for name in names.split(",")
    }
    return sorted(
        pairs | {(f"softfinger.{module}", n) for n, module in softfinger._MODULES.items()}
    )


@pytest.mark.parametrize(("module", "name"), imported())
def test_a_module_that_people_import_from_says_what_is_public(module, name):
    pytest.importorskip("mujoco" if module == "softfinger.mujoco" else "numpy")
    pytest.importorskip("gymnasium" if module.startswith("softfinger.gym") else "numpy")
    found = importlib.import_module(module)
    table = softfinger._PUBLIC.get(module.removeprefix("softfinger."), "").split()
    public = getattr(found, "__all__", table)
    assert name in public
    assert [each for each in public if not hasattr(found, each)] == []


def test_the_site_finds_inherited_methods_and_fields():
    griffe = pytest.importorskip("griffe")
    extension = griffe.load_extensions(str(ROOT / "docs" / "field_docs.py"))
    loader = griffe.GriffeLoader(search_paths=[ROOT], extensions=extension)
    package = loader.load("softfinger")
    loader.resolve_aliases(implicit=False, external=False)
    for cls in ("Hand", "AsyncHand"):
        methods = {each for each in package[cls].all_members if not each.startswith("_")}
        assert {each for each in dir(getattr(softfinger, cls)) if each[0] != "_"} <= methods
        grasp = package[cls].all_members["grasp"]
        assert str(grasp.returns) == "None"
        assert grasp.docstring.value.startswith("Close the fingers and grip with ``force`` [N]")
    told = package["HandState"].docstring.value
    assert told == inspect.getdoc(softfinger.HandState)
    assert "mode : str\n    disarmed, armed" in told
    assert "LATE\n    The command was too old" in package["Reason"].docstring.value
