"""The kernel decorators and their records; which sources a compiled kernel may depend on."""

import importlib
import math
import pkgutil
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger import daemon, kinematics
from softfinger.kinematics import compiled
from softfinger.kinematics.compiled import kernel as decorators
from softfinger.kinematics.compiled import plain
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.compiled.kernel_folder import kernel_sources
from softfinger.kinematics.compiled.layout import Pair, Record, Records, _kind
from softfinger.kinematics.contact.closed_form import theta_limit


@kernel
def limit_twice(radius: float, d: float) -> float:
    return 2.0 * theta_limit(radius, d)


def test_an_inner_kernel_works_in_kernels_and_refuses_python():
    assert limit_twice(0.02, 0.02) == 0.0
    assert limit_twice(0.02, 0.0) == pytest.approx(math.pi)
    with pytest.raises(TypeError, match=r"closed_form\.theta_limit is an inner kernel"):
        theta_limit(0.02, 0.0)


@pytest.mark.parametrize("why", ["99.0", "compiler"])
def test_numba_alone_compiles_where_its_private_parts_are_not_known(why, monkeypatch):
    if why == "compiler":
        monkeypatch.setattr(numba, "__version__", "0.68.0")
        monkeypatch.delattr(compiled, "compiler", raising=False)
        monkeypatch.setitem(sys.modules, "softfinger.kinematics.compiled.compiler", None)
    else:
        monkeypatch.setattr(numba, "__version__", why)
    chosen, text = decorators._chosen_compiler()
    assert chosen is plain
    assert why in text


def kernels() -> Iterator[Any]:
    """Every kernel of the program, as Python's function."""
    for package in (kinematics, daemon):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(found.name)
            for value in vars(module).values():
                function = getattr(value, "py_func", None)
                if function is not None and function.__module__ == found.name:
                    yield function


def test_the_caches_name_covers_all_that_kernels_are_made_of():
    sources = set(kernel_sources())
    assert {
        Path(plain.__file__).with_name(f"{each}.py").resolve() for each in ("compiler", "plain")
    } <= sources
    count = 0
    for function in kernels():
        count += 1
        assert Path(function.__code__.co_filename).resolve() in sources, function
        for name in function.__code__.co_names:
            used = function.__globals__.get(name)
            if isinstance(used, types.ModuleType) and used.__name__.startswith("softfinger."):
                assert Path(used.__file__).resolve() in sources, f"{function}: {name}"
    assert count > 150


class Tip(Record):
    d: float
    cells: int


class Memory(Record):
    spread: Pair
    newest: Tip
    tip: Annotated[Records[Tip], 2]


def test_a_record_is_a_view_of_its_array():
    memory = Memory()
    memory.spread = [3.0, 4.0]
    memory.tip[1].d = 2.0
    assert memory.array[0]["spread"][1] == 4.0
    assert memory.array[0]["tip"]["d"].tolist() == [0.0, 2.0]
    with pytest.raises(TypeError, match="Tip: expected"):
        Tip(np.zeros(1, Memory.dtype))


def test_what_is_no_field_is_an_error():
    memory = Memory()
    with pytest.raises(AttributeError):
        memory.spred = 1.0
    with pytest.raises(AttributeError, match="newest is a record: set its fields"):
        memory.newest = Tip()


def test_arrays_are_known_by_the_aliases_of_every_numpy():
    of_2_5 = types.GenericAlias(np.ndarray, (np.float64,))  # NDArray[np.float64] there
    for alias in (NDArray[np.float64], of_2_5):
        assert _kind(Annotated[alias, 3]) == (None, np.float64, (3,))
