"""Numba's compiler with the passes that kernels need, and without asking it the same thing twice.

Left out are the passes for closures, `with`, parallel loops, branches on constants (LLVM's part)
and the listing of types, which filled the cache. What an operation makes of its arguments' types,
and the size of LLVM's types, are remembered: at each place in the source Numba looks through
dozens of candidates for the one, and has LLVM parse a module for the other.

This module, `inner_kernels` and `kernel_cache` alone reach into Numba; `pyproject.toml` bounds it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

from numba import types
from numba.core.base import BaseContext
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonRewrites,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.untyped_passes import (
    DeadBranchPrune,
    FixupArgs,
    GenericRewrites,
    IRProcessing,
    ReconstructSSA,
    RewriteSemanticConstants,
    TranslateByteCode,
)

_operation: Any = types.Function
_resolve = _operation.get_call_type
_SIGNATURES: dict[Any, Any] = {}  # of operations, by their arguments' types and the arithmetic
_context: Any = BaseContext
_size = _context.get_abi_sizeof
_SIZES: dict[Any, int] = {}  # of LLVM's types [bytes]


class KernelCompiler(CompilerBase):
    """From a kernel's source to machine code."""

    lowering: ClassVar[Any] = NativeLowering

    def __init__(self, *state: Any) -> None:
        super().__init__(*state)
        self.state.args = _Arguments(self.state.args)

    def compile_extra(self, func: Any) -> Any:
        """Compile ``func``."""
        with _remembering(self.state.flags):
            return super().compile_extra(func)

    def define_pipelines(self) -> list[Any]:
        """The passes, in their order."""
        # Under `if blur is None` nothing has a type unless it is: pruned, and again what follows.
        nones = types.none in self.state.args
        passes: list[Any] = [TranslateByteCode, FixupArgs, IRProcessing]
        passes += [RewriteSemanticConstants, DeadBranchPrune] if nones else []
        passes += [GenericRewrites, ReconstructSSA]
        passes += [DeadBranchPrune] if nones else []
        passes += [NopythonTypeInference, PreLowerStripPhis, NopythonRewrites]
        passes += [IRLegalization, self.lowering, NoPythonBackend]
        pipeline = PassManager("kernel")
        for each in passes:
            pipeline.add_pass(each, each.__name__)
        pipeline.finalize()
        return [pipeline]


class _Arguments(tuple[Any, ...]):
    """Arguments' types without their text, which Numba makes for each pass; a record's is long."""

    __slots__ = ()

    def __str__(self) -> str:
        return f"{len(self)} arguments"


@contextmanager
def _remembering(flags: Any) -> Iterator[None]:
    """Meanwhile Numba remembers signatures of its own functions, and sizes."""
    arithmetic = frozenset(flags.fastmath.flags), flags.error_model

    def signature(function: Any, context: Any, arguments: Any, named: Any) -> Any:
        if named:
            return _resolve(function, context, arguments, named)
        key = function, arguments, arithmetic
        if key not in _SIGNATURES:
            found = _resolve(function, context, arguments, named)
            if found is None:
                return None
            _SIGNATURES[key] = found, function._impl_keys[found.args]
        found, body = _SIGNATURES[key]
        function._impl_keys[found.args] = body  # by which Numba finds what to compile
        return found

    def size(context: Any, kind: Any) -> int:
        if kind not in _SIZES:
            _SIZES[kind] = _size(context, kind)
        return _SIZES[kind]

    outer = _operation.get_call_type, _context.get_abi_sizeof
    _operation.get_call_type, _context.get_abi_sizeof = signature, size
    try:
        yield
    finally:
        _operation.get_call_type, _context.get_abi_sizeof = outer
