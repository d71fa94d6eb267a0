"""Test that each constant of perception and control has a test, or a reason for having none."""

import ast
from pathlib import Path

from tests.soak.constants import NOT_TUNED, TESTS, constants, scaled

UNIT = Path(__file__).parent


def test_each_constant_is_listed_once():
    assert constants().keys() == TESTS.keys() | NOT_TUNED.keys()
    assert not TESTS.keys() & NOT_TUNED.keys()


def test_the_listed_tests_exist():
    for name, each in TESTS.items():
        file, _, function = each.partition("::")
        tree = ast.parse((UNIT / file).read_text())
        functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert function.partition("[")[0] in functions, name


def test_integers_stay_integers_when_they_are_scaled():
    assert scaled("16", 0.5) == "8"
    assert eval(scaled("3e-4", 2.0)) == 6e-4
