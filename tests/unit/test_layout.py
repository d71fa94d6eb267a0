"""Records: views of their arrays; what is no field, or no record, is an error."""

from __future__ import annotations

import types
from typing import Annotated

import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.kinematics.compiled.layout import Pair, Record, Records, _kind


class Tip(Record):
    d: float
    cells: int


class Memory(Record):
    spread: Pair
    newest: Tip
    tip: Annotated[Records[Tip], 2]


def test_a_record_is_a_view_of_its_array() -> None:
    memory = Memory()
    memory.spread = [3.0, 4.0]
    memory.tip[1].d = 2.0
    assert memory.array[0]["spread"][1] == 4.0  # type: ignore[index]
    assert memory.array[0]["tip"]["d"].tolist() == [0.0, 2.0]  # type: ignore[index]
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
