"""The kernel decorators, and which sources a compiled kernel may depend on."""

from __future__ import annotations

import importlib
import math
import pkgutil
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from softfinger import daemon, kinematics
from softfinger.kinematics.compiled import compiler
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.kernel_folder import kernel_sources
from softfinger.kinematics.contact.closed_form import theta_limit


@kernel
def limit_twice(radius: float, d: float) -> float:
    return 2.0 * theta_limit(radius, d)


def test_an_inner_kernel_works_in_kernels_and_refuses_python() -> None:
    assert limit_twice(0.02, 0.02) == 0.0
    assert limit_twice(0.02, 0.0) == pytest.approx(math.pi)
    with pytest.raises(TypeError, match=r"closed_form\.theta_limit is an inner kernel"):
        theta_limit(0.02, 0.0)


def kernels() -> Iterator[Any]:
    """Every kernel of the program, as Python's function."""
    for package in (kinematics, daemon):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(found.name)
            for value in vars(module).values():
                function = getattr(value, "py_func", None)
                if function is not None and function.__module__ == found.name:
                    yield function


def test_the_caches_name_covers_all_that_kernels_are_made_of() -> None:
    sources = set(kernel_sources())
    assert Path(compiler.__file__).resolve() in sources
    count = 0
    for function in kernels():
        count += 1
        assert Path(function.__code__.co_filename).resolve() in sources, function
        for name in function.__code__.co_names:
            used = function.__globals__.get(name)
            if isinstance(used, types.ModuleType) and used.__name__.startswith("softfinger."):
                assert used.__file__ is not None
                assert Path(used.__file__).resolve() in sources, f"{function}: {name}"
    assert count > 150
