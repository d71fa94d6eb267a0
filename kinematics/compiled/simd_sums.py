"""Weighted sums of neighbouring rows or columns, eight numbers at a time in SIMD lanes.

Numba vectorises long loops well, and short ones of a few dozen hardly; so this one is written as
LLVM instructions. LLVM splits the vectors where the machine's are narrower.
"""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import intrinsic

LANES = 8

_DOUBLE = ir.DoubleType()
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_LANE = ir.IntType(32)


def _weighted(
    context: Any,
    start: Any,
    source: Any,
    at: Any,
    stride: Any,
    weights: Any,
    first: Any,
    count: Any,
) -> Any:
    """Signature and code generator; see :data:`weighted`."""
    whole = types.intp
    signature = types.void(start, source, whole, whole, weights, whole, whole)

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        out, source, at, stride, weights, first, count = arguments
        fma = cast(Any, cgutils).get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fma.v{LANES}f64"
        )
        zeros = ir.Constant(_LANE, 0)
        mask = ir.Constant(ir.VectorType(_LANE, LANES), [0] * LANES)
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        place = builder.bitcast(out, _VECTOR.as_pointer())
        total = cast(Any, cgutils).alloca_once_value(builder, builder.load(place, align=8))
        with cast(Any, cgutils).for_range(builder, count) as loop:
            weight = builder.load(builder.gep(weights, [builder.add(first, loop.index)]))
            many = builder.insert_element(undefined, weight, zeros)
            many = builder.shuffle_vector(many, undefined, mask)
            moved = builder.add(at, builder.mul(stride, loop.index))
            row = builder.bitcast(builder.gep(source, [moved]), _VECTOR.as_pointer())
            value = builder.load(row, align=8)
            builder.store(builder.call(fma, [many, value, builder.load(total)]), total)
        builder.store(builder.load(total), place, align=8)
        return codegen.get_dummy_value()

    return signature, generate


# weighted(out, source, at, stride, weights, first, count): adds Σ weights[first + k]
# source[at + k stride : … + 8] over k < count to out[0 : 8], all addresses of float64.
weighted = cast(Any, intrinsic)(_weighted)
