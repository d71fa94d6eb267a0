"""Records: one declaration for kernels and Python, by name on both sides."""

from __future__ import annotations

import types
from typing import Annotated

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.kinematics.compiled.kernel import inner_kernel, kernel
from softfinger.kinematics.compiled.layout import Pair, Record, Records, _kind


class Tip(Record):
    d: float
    cells: int
    live: bool


class Memory(Record):
    count: int
    spread: Pair
    table: Annotated[NDArray[np.float64], 2, 3]
    newest: Tip
    tip: Annotated[Records[Tip], 2]


@inner_kernel
def press(tip: Tip, more: float) -> None:
    tip.d += more
    tip.cells = 7
    tip.live = True


@kernel
def step(memories: Records[Memory], more: float) -> float:
    memory = memories[0]
    memory.count += 1
    press(memory.tip[1], more)
    press(memory.newest, 2.0 * more)
    memory.table[1, 2] = more
    memory.spread[0] = memory.tip[1].d
    return memory.tip[1].d + memory.newest.d


def test_a_kernel_and_python_see_the_same_fields() -> None:
    memory = Memory()
    memory.tip[1].d = 1.0
    memory.count = 4
    assert step(memory.array, 0.5) == 2.5
    assert memory.count == 5
    assert (memory.tip[1].d, memory.tip[1].cells, memory.tip[1].live) == (1.5, 7, True)
    assert (memory.tip[0].d, memory.tip[0].cells, memory.tip[0].live) == (0.0, 0, False)
    assert memory.newest.d == 1.0
    assert memory.table[1, 2] == 0.5
    np.testing.assert_array_equal(memory.spread, [1.5, 0.0])
    memory.spread = [3.0, 4.0]
    assert memory.array[0]["spread"][1] == 4.0  # type: ignore[index]


def test_a_record_is_a_view_of_its_array() -> None:
    array = np.zeros(1, Tip.dtype)
    tip = Tip(array)
    tip.d = 2.0
    assert array["d"][0] == 2.0
    with pytest.raises(TypeError, match="Tip: expected"):
        Tip(np.zeros(1, Memory.dtype))


def test_what_is_no_field_is_an_error() -> None:
    memory = Memory()
    with pytest.raises(AttributeError):
        memory.spred = 1.0  # type: ignore[attr-defined]
    with pytest.raises(AttributeError, match="newest is a record: set its fields"):
        memory.newest = Tip()


def test_arrays_are_known_by_the_aliases_of_every_numpy() -> None:
    of_2_5 = types.GenericAlias(np.ndarray, (np.float64,))  # NDArray[np.float64] there
    for alias in (NDArray[np.float64], of_2_5):
        assert _kind(Annotated[alias, 3]) == (None, np.float64, (3,))
