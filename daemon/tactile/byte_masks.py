"""64 bytes at a time as the bits of one number, for kernels; and nothing of what they mean.

Numba has no way to say it, so these are written as LLVM instructions, a comparison of a vector and
what the machine calls moving its sign bits. LLVM splits the vectors where the machine's are
narrower.
"""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core.extending import intrinsic

WIDTH = 64

_BYTES = ir.VectorType(ir.IntType(8), WIDTH)
_BITS = ir.VectorType(ir.IntType(1), WIDTH)
_MASK = ir.IntType(64)


def _block(codegen: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    data = codegen.make_array(kind)(codegen, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _BYTES.as_pointer())


def _equal(context: Any, array: Any, at: Any, value: Any) -> Any:
    """Signature and code generator; see :data:`equal`."""

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        place = _block(codegen, builder, sig.args[0], arguments[0], arguments[1])
        block = builder.load(place, align=1)
        same = ir.Constant(_BYTES, [sig.args[2].literal_value] * WIDTH)
        return builder.bitcast(builder.icmp_unsigned("==", block, same), _MASK)

    return types.uint64(array, types.intp, value), generate


def _clear(context: Any, array: Any, at: Any, mask: Any) -> Any:
    """Signature and code generator; see :data:`clear`."""

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        place = _block(codegen, builder, sig.args[0], arguments[0], arguments[1])
        block = builder.load(place, align=1)
        marked = builder.bitcast(arguments[2], _BITS)
        zero = ir.Constant(_BYTES, [0] * WIDTH)
        builder.store(builder.select(marked, zero, block), place, align=1)
        return codegen.get_dummy_value()

    return types.void(array, types.intp, types.uint64), generate


def _lowest(context: Any, mask: Any) -> Any:
    """Signature and code generator; see :data:`lowest`."""

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 0))

    return types.int64(types.uint64), generate


# equal(bytes, at, value): which of bytes[at : at + 64] equal the literal value, uint64, the first
# byte lowest. The caller sees to it that there are so many; nothing is checked here.
equal = cast(Any, intrinsic(prefer_literal=True))(_equal)

# clear(bytes, at, mask): set those of bytes[at : at + 64] to 0 that the mask has.
clear = cast(Any, intrinsic)(_clear)

# lowest(mask): the number of the lowest bit set; 64 where none is.
lowest = cast(Any, intrinsic)(_lowest)
