"""Records with named fields, shared between Python and kernels.

A record is declared once as a class. Python code and kernels then access the same fields.

    class Tip(Record):
        d: float              # [m]
        spread: Pair          # of d and θ
        cells: int
        live: bool

    tip = Tip()               # all fields are zero
    tip.d = 1e-3              # Python reads and writes fields by name
    press(tip.array, 0.1)     # a kernel called from Python takes the array of one record

    @kernel
    def press(tips: Records[Tip], more: float) -> None:
        tip = tips[0]         # a reference to the record, not a copy
        deeper(tip, more)     # an inner kernel takes the record itself

A field is a `float`, an `int` (64 bit), a `bool`, another record, or an array of fixed shape
declared with :data:`Annotated`. Arrays whose size depends on a grid cannot be fields, because each
size would require another compilation.
"""

from __future__ import annotations

from typing import Annotated, Any, Generic, Protocol, Self, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Pair = Annotated[NDArray[np.float64], 2]  # (left, right)
Each = TypeVar("Each", bound="Record", covariant=True)

_SCALARS: dict[Any, Any] = {float: np.float64, int: np.int64, bool: np.bool_}


class Records(Protocol, Generic[Each]):
    """Type of a structured array; kernels index its records."""

    def __getitem__(self, index: int, /) -> Each: ...
    def __setitem__(self, index: int, record: Any, /) -> None: ...  # copies the record
    def __len__(self) -> int: ...


class _Slotted(type):
    """Metaclass that rejects all attributes except fields, so that misspelt names raise errors."""

    def __new__(meta, name: str, bases: tuple[type, ...], names: dict[str, Any]) -> _Slotted:
        return super().__new__(meta, name, bases, {"__slots__": (), **names})


class Record(metaclass=_Slotted):
    """Base class of records.

    A subclass declares its fields as annotations; see the module docstring.
    """

    __slots__ = ("_fields", "array")

    dtype: np.dtype[np.void]
    array: Records[Self]  # array with a single record, which is passed to kernels

    def __init_subclass__(cls) -> None:
        hints = get_type_hints(cls, include_extras=True)
        kinds = {name: _kind(hints[name]) for name in cls.__annotations__}
        # Align fields as in C, because Numba accesses unaligned fields slowly.
        cls.dtype = np.dtype([(name, *kind) for name, (_, *kind) in kinds.items()], align=True)
        for name, (inner, _, shape) in kinds.items():
            is_scalar = inner is None and not shape
            setattr(cls, name, _Scalar(name) if is_scalar else _Compound(name, inner))

    def __init__(self, array: NDArray[np.void] | None = None) -> None:
        """Create a record of zeros or a view of the first record in ``array``."""
        one: Any = np.zeros(1, self.dtype) if array is None else array
        if one.dtype != self.dtype:
            raise TypeError(f"{type(self).__name__}: expected {self.dtype}, found {one.dtype}")
        self.array = one
        self._fields = _Views(type(self), one)

    def assign(self, other: Self) -> None:
        """Copy all fields from ``other``."""
        mine: Any = self.array
        mine[:] = other.array


class _Views(dict[str, Any]):
    """Cached views of a record's fields, because creating a view takes ten times as long as use."""

    def __init__(self, kind: type[Record], one: Any) -> None:
        self._kind = kind
        self._one = one

    def __missing__(self, name: str) -> Any:
        field = self._one[name][:1]
        view = field.reshape(field.shape[1:])
        inner = getattr(self._kind, name).inner
        if inner is not None:
            view = inner(view.reshape(1)) if view.ndim == 0 else _Many(inner, view)
        self[name] = view
        return view


class _Many(list[Any]):
    """Views of the records in an array field; ``array`` is passed to kernels."""

    def __init__(self, kind: type[Record], array: Any) -> None:
        super().__init__(kind(array[k : k + 1]) for k in range(len(array)))
        self.array = array


class _Scalar:
    inner = None

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, record: Any, owner: Any) -> Any:
        return self if record is None else record._fields[self._name].item()

    def __set__(self, record: Any, value: Any) -> None:
        record._fields[self._name][()] = value


class _Compound:
    def __init__(self, name: str, inner: Any) -> None:
        self._name = name
        self.inner = inner

    def __get__(self, record: Any, owner: Any) -> Any:
        return self if record is None else record._fields[self._name]

    def __set__(self, record: Any, value: Any) -> None:
        if self.inner is not None:
            raise AttributeError(f"{self._name} is a record: set the individual fields")
        record._fields[self._name][...] = value


def _kind(hint: Any) -> tuple[Any, Any, tuple[int, ...]]:
    """Return (record class or None, element type, shape) of an annotation."""
    shape = getattr(hint, "__metadata__", ())
    base = hint.__origin__ if shape else hint
    if base in _SCALARS:
        return None, _SCALARS[base], ()
    if isinstance(base, type) and issubclass(base, Record):
        return base, base.dtype, ()
    inner = base.__args__[-1]
    if isinstance(inner, type) and issubclass(inner, Record):
        return inner, inner.dtype, shape
    # The type argument of NDArray is dtype[float64] before NumPy 2.5, and float64 since then.
    return None, getattr(inner, "__args__", (inner,))[0], shape
