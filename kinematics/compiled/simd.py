"""Polynomials in two variables, in SIMD lanes, and addresses of arrays.

And nothing of what they mean. Numba vectorises long loops, not a Horner scheme over neighbouring
coefficients, of which each of all five polynomials is here one vector load and one fused
multiply-add. So it is written as LLVM instructions. LLVM splits the vectors where the machine's are
narrower.
"""

from __future__ import annotations

from functools import partial
from typing import Any, TypeAlias, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

LANES = 5  # polynomials
STRIDE = 8  # numbers of a vector register, and stored for each coefficient: the lanes, padded

# Shapes by number: how many powers of x each power of y has, the lowest first. None; shapes cut to
# what an analytic function needs for one precision after the other; that of a solid tip.
SHAPES: tuple[tuple[int, ...], ...] = (
    (),
    (7, 6, 6, 6, 6, 5, 5, 4, 4, 3, 3, 3, 2, 2, 1),
    (9, 8, 8, 7, 7, 7, 6, 6, 5, 5, 5, 4, 4, 4, 3, 3, 3, 2, 1, 1),
    (10, 9, 9, 9, 9, 8, 8, 7, 7, 7, 6, 6, 6, 6, 5, 5, 5, 5, 4, 4, 4, 3, 3, 2, 2, 1),
    (12,) * 6,
)
SIZES = tuple(STRIDE * sum(shape) for shape in SHAPES)  # numbers of one set of coefficients

# What `address` gives, as far as kernels index it.
Pointer: TypeAlias = NDArray[np.float64]
IntPointer: TypeAlias = NDArray[np.int64]

_DOUBLE = ir.DoubleType()
_VECTOR = ir.VectorType(_DOUBLE, STRIDE)
_INDEX = ir.IntType(64)


def _fma(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a b + c of vectors; llvmlite's own takes scalars only."""
    function = cast(Any, cgutils).get_or_insert_function(
        builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fma.v{STRIDE}f64"
    )
    return builder.call(function, [a, b, c])


def _broadcast(builder: Any, value: Any) -> Any:
    """A vector of the one value."""
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    single = builder.insert_element(undefined, value, ir.Constant(_INDEX, 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), STRIDE), [0] * STRIDE)
    return builder.shuffle_vector(single, undefined, mask)


def _polynomials(context: Any, data: Any, at: Any, shape: Any, x: Any, y: Any) -> Any:
    """Signature and code generator; see :data:`polynomials`."""
    signature = cast(Any, types).UniTuple(types.float64, LANES)(data, types.intp, shape, x, y)

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        start, at, _, x, y = arguments
        fma = partial(_fma, builder)
        xs, ys = _broadcast(builder, x), _broadcast(builder, y)
        pointer = builder.bitcast(builder.gep(start, [at]), _VECTOR.as_pointer())
        # All powers of y are independent, and the machine may work on them before y is known.
        rows = []
        read = 0
        for terms in SHAPES[sig.args[2].literal_value]:
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
    y2 = builder.fmul(y, y)
    y4 = builder.fmul(y2, y2)
    sums = []
    for k in range(4):
        total = None
        for row in reversed(rows[k::4]):
            total = row if total is None else fma(total, y4, row)
        sums.append(total)
    return fma(fma(sums[3], y, sums[2]), y2, fma(sums[1], y, sums[0]))


def _address(context: Any, array: Any) -> Any:
    """Signature and code generator; see :data:`address`."""
    signature = cast(Any, types).CPointer(array.dtype)(array)

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return codegen.make_array(sig.args[0])(codegen, builder, arguments[0]).data

    return signature, generate


def _further(context: Any, start: Any, number: Any) -> Any:
    """Signature and code generator; see :data:`further`."""

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return builder.gep(arguments[0], [arguments[1]])

    return start(start, types.intp), generate


# polynomials(pointer, at, shape, x, y): the five sums Σ c_ij x^i y^j over a shape of SHAPES, whose
# number is a literal. From pointer[at] on stand, for j = 0, 1, …, the coefficients of falling
# powers of x, STRIDE numbers each.
polynomials = cast(Any, intrinsic(prefer_literal=True))(_polynomials)

# address(array): where a contiguous array starts. Numba counts the references to an array
# wherever a function that has it returns in several ways, and each count is an atomic instruction
# that costs as much as a lookup; it counts none for an address. The caller keeps the array.
address = cast(Any, intrinsic)(_address)

# further(address, n): the address n numbers further.
further = cast(Any, intrinsic)(_further)
