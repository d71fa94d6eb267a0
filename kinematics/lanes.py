"""Polynomials in two variables, five at a time in SIMD lanes; and nothing of what they mean.

Numba vectorises loops, not a Horner scheme over neighbouring coefficients, so this one is written
as LLVM instructions: each coefficient of all five polynomials is one vector load and one fused
multiply-add. LLVM splits the vectors where the machine's are narrower.
"""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.extending import intrinsic

LANES = 5  # polynomials
STRIDE = 8  # coefficients stored for each power: the lanes, padded to a vector register
TRIANGLE = 0
SQUARE = 1

_DOUBLE = ir.DoubleType()
_VECTOR = ir.VectorType(_DOUBLE, STRIDE)
_INDEX = ir.IntType(64)


def _patch(context: Any, data: Any, at: Any, degree: Any, shape: Any, x: Any, y: Any) -> Any:
    """Type of, and code for, the evaluation; see :data:`patch`."""
    signature = types.UniTuple(types.float64, LANES)(data, types.intp, degree, shape, x, y)

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        array = codegen.make_array(sig.args[0])(codegen, builder, arguments[0])
        _, at, _, _, x, y = arguments
        # llvmlite's own fma takes scalars only.
        fma = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fma.v{STRIDE}f64"
        )

        def spread(value: Any) -> Any:
            single = builder.insert_element(
                ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(_INDEX, 0)
            )
            mask = ir.Constant(ir.VectorType(ir.IntType(32), STRIDE), [0] * STRIDE)
            return builder.shuffle_vector(single, ir.Constant(_VECTOR, ir.Undefined), mask)

        xs, ys = spread(x), spread(y)
        pointer = builder.bitcast(builder.gep(array.data, [at]), _VECTOR.as_pointer())
        # All rows are independent until they are summed.
        result = None
        read = 0
        for terms in row_lengths(degree.literal_value, shape.literal_value):
            row = None
            for _ in range(terms):
                place = builder.gep(pointer, [ir.Constant(_INDEX, read)])
                vector = builder.load(place, align=8)
                row = vector if row is None else builder.call(fma, [row, ys, vector])
                read += 1
            result = row if result is None else builder.call(fma, [result, xs, row])
        lanes = [
            builder.extract_element(result, ir.Constant(ir.IntType(32), i)) for i in range(LANES)
        ]
        return codegen.make_tuple(builder, sig.return_type, lanes)

    return signature, generate


# patch(data, at, degree, shape, x, y): the five sums Σ c_ij x^i y^j, over i + j ≤ degree when shape
# is TRIANGLE and over i, j ≤ degree when it is SQUARE; degree and shape are literals. From data[at]
# on stand, for i = degree … 0, the coefficients of falling powers of y, STRIDE numbers each.
patch = cast(Any, intrinsic(prefer_literal=True))(_patch)


def row_lengths(degree: int, shape: int) -> list[int]:
    """How many coefficients stand for each power of x, the highest first."""
    return [k + 1 if shape == TRIANGLE else degree + 1 for k in range(degree + 1)]


def patch_size(degree: int, shape: int) -> int:
    """Numbers that :data:`patch` reads."""
    return STRIDE * sum(row_lengths(degree, shape))
