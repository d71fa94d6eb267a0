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

_DOUBLE = ir.DoubleType()
_VECTOR = ir.VectorType(_DOUBLE, STRIDE)
_INDEX = ir.IntType(64)


def _code(columns: Any, context: Any, data: Any, x: Any, y: Any, literals: Any) -> Any:
    """Signature and code generator of a sum over powers of y of polynomials in x."""
    signature = cast(Any, types).UniTuple(types.float64, LANES)(data, types.intp, *literals, x, y)

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        array = codegen.make_array(sig.args[0])(codegen, builder, arguments[0])
        at, x, y = arguments[1], arguments[-2], arguments[-1]
        # llvmlite's own fma takes scalars only.
        function = cast(Any, cgutils).get_or_insert_function(
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fma.v{STRIDE}f64"
        )

        def fma(a: Any, b: Any, c: Any) -> Any:
            return builder.call(function, [a, b, c])

        def spread(value: Any) -> Any:
            single = builder.insert_element(
                ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(_INDEX, 0)
            )
            mask = ir.Constant(ir.VectorType(ir.IntType(32), STRIDE), [0] * STRIDE)
            return builder.shuffle_vector(single, ir.Constant(_VECTOR, ir.Undefined), mask)

        xs, ys = spread(x), spread(y)
        pointer = builder.bitcast(builder.gep(array.data, [at]), _VECTOR.as_pointer())
        # All powers of y are independent, and the machine may work on them before y is known.
        rows = []
        read = 0
        for terms in columns([literal.literal_value for literal in literals]):
            row = None
            for _ in range(terms):
                place = builder.gep(pointer, [ir.Constant(_INDEX, read)])
                vector = builder.load(place, align=8)
                row = vector if row is None else fma(row, xs, vector)
                read += 1
            rows.append(row)
        result = _in_powers(builder, fma, rows, ys)
        lanes = [
            builder.extract_element(result, ir.Constant(ir.IntType(32), i)) for i in range(LANES)
        ]
        return codegen.make_tuple(builder, sig.return_type, lanes)

    return signature, generate


def _in_powers(builder: Any, fma: Any, rows: list[Any], y: Any) -> Any:
    """Σ rows[j] y^j by four interleaved Horner schemes in y⁴, so that the chain is short."""
    if len(rows) < 4:
        total = rows[-1]
        for row in reversed(rows[:-1]):
            total = fma(total, y, row)
        return total
    y2 = builder.fmul(y, y)
    y4 = builder.fmul(y2, y2)
    sums = []
    for k in range(4):
        total = None
        for row in reversed(rows[k::4]):
            total = row if total is None else fma(total, y4, row)
        sums.append(total)
    return fma(fma(sums[3], y, sums[2]), y2, fma(sums[1], y, sums[0]))


def _slab(context: Any, data: Any, at: Any, nx: Any, ny: Any, x: Any, y: Any) -> Any:
    """Type of, and code for, the evaluation; see :data:`slab`."""
    return _code(lambda n: slab_columns(n[0], n[1]), context, data, x, y, (nx, ny))


def _square(context: Any, data: Any, at: Any, n: Any, x: Any, y: Any) -> Any:
    """Type of, and code for, the evaluation; see :data:`square`."""
    return _code(lambda n: square_columns(n[0]), context, data, x, y, (n,))


# slab(data, at, nx, ny, x, y): the five sums Σ c_ij x^i y^j over the triangle of powers with the
# corners x^nx and y^ny; square(data, at, n, x, y): over all i, j ≤ n. The degrees are literals.
# From data[at] on stand, for j = 0, 1, …, the coefficients of falling powers of x, STRIDE numbers
# each.
slab = cast(Any, intrinsic(prefer_literal=True))(_slab)
square = cast(Any, intrinsic(prefer_literal=True))(_square)


def slab_columns(nx: int, ny: int) -> list[int]:
    """How many coefficients :data:`slab` has for each power of y, the lowest first."""
    return [int((nx + 0.5) * (1.0 - j / (ny + 0.5))) + 1 for j in range(ny + 1)]


def square_columns(n: int) -> list[int]:
    """How many coefficients :data:`square` has for each power of y."""
    return [n + 1] * (n + 1)
