"""Test kernel decorators, records, and the list of sources on which a compiled kernel depends."""

import importlib
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
from softfinger.kinematics.estimation.gauss_newton import free_noise


@kernel
def noise_twice(square: float, floor: float) -> float:
    return 2.0 * free_noise(square, floor)


def test_an_inner_kernel_works_in_kernels_but_not_in_python():
    assert noise_twice(0.0, 0.0) == 0.0
    assert noise_twice(2.0, 0.0) == 4.0
    with pytest.raises(TypeError, match=r"gauss_newton\.free_noise is an inner kernel"):
        free_noise(2.0, 0.0)


@pytest.mark.parametrize("why", ["99.0", "compiler"])
def test_plain_numba_is_used_if_its_internals_are_unknown(why, monkeypatch):
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
    """Yield the Python function of every kernel in the program."""
    for package in (kinematics, daemon):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(found.name)
            for value in vars(module).values():
                function = getattr(value, "py_func", None)
                if function is not None and function.__module__ == found.name:
                    yield function


def test_the_cache_name_covers_all_inputs_of_kernels():
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


def test_an_unknown_field_is_an_error():
    memory = Memory()
    with pytest.raises(AttributeError):
        memory.spred = 1.0
    with pytest.raises(AttributeError, match="newest is a record: set the individual fields"):
        memory.newest = Tip()


def test_array_aliases_of_every_numpy_version_are_recognised():
    # In NumPy 2.5, NDArray[np.float64] is this alias.
    of_2_5 = types.GenericAlias(np.ndarray, (np.float64,))
    for alias in (NDArray[np.float64], of_2_5):
        assert _kind(Annotated[alias, 3]) == (None, np.float64, (3,))
