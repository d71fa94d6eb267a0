"""Compile and cache kernels with Numba, using its private interfaces.

No other module uses these interfaces. For Numba versions that have not been tested, `plain`
replaces this module.

`KernelCompiler` runs only the passes that kernels need. The compiler omits the passes for closures,
`with` statements and parallel loops. It does not prune constant branches, because LLVM prunes them
anyway. It does not store type annotations, because they would fill the cache. The compiler caches
the result types of operations and the sizes of LLVM types. Without the cache, Numba would search
dozens of candidates for each operation, and LLVM would parse a module for each size.

A `BitcodeKernel` is compiled to LLVM bitcode but not to machine code. Only other kernels can call a
`BitcodeKernel`. By default, Numba assumes that Python may also call each function that a kernel
calls. Numba then optimises the function together with its callees, compiles it to machine code,
adds two wrappers and caches the result. The callers link the bitcode and repeat the optimisation
and compilation. Stopping at bitcode reduces the compile time by a third and the cache size by three
quarters.

`KernelCache` stores the machine code of a kernel but not its bitcode. A caller needs the bitcode,
so Numba compiles the stored kernel again when it compiles a caller. Normally, Numba imports all its
implementations of Python and NumPy functions before it loads a stored kernel. `KernelCache` skips
this import, which would require a third of a second and 50 MB.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import llvmlite.binding
import numba
from numba import types
from numba.core.base import BaseContext
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, _LowerResult
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.runtime import nrt
from numba.core.serialize import dumps
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonRewrites,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.untyped_passes import (
    FixupArgs,
    GenericRewrites,
    IRProcessing,
    ReconstructSSA,
    TranslateByteCode,
)

from softfinger.kinematics.compiled import plain
from softfinger.kinematics.compiled.kernel_folder import ROOT, keep, kept, kernel_folder, text
from softfinger.kinematics.compiled.own_folder import OwnFolder

_operation: Any = types.Function
_resolve = _operation.get_call_type
# Signatures of operations. The keys contain the argument types and arithmetic flags.
_SIGNATURES: dict[Any, Any] = {}
_context: Any = BaseContext
_size = _context.get_abi_sizeof
_SIZES: dict[Any, int] = {}  # LLVM type sizes [bytes]


class KernelCompiler(CompilerBase):
    """Compiler for one kernel, from source to machine code."""

    lowering: ClassVar[Any] = NativeLowering

    def __init__(self, *state: Any) -> None:
        super().__init__(*state)
        self.state.args = _Arguments(self.state.args)

    def compile_extra(self, func: Any) -> Any:
        """Compile ``func`` with cached signatures and type sizes."""
        with _with_cached_lookups(self.state.flags):
            return super().compile_extra(func)

    def define_pipelines(self) -> list[Any]:
        """Return the compiler passes in the order of execution."""
        passes = (
            TranslateByteCode, FixupArgs, IRProcessing, GenericRewrites, ReconstructSSA,
            NopythonTypeInference, PreLowerStripPhis, NopythonRewrites, IRLegalization,
            self.lowering, NoPythonBackend,
        )  # fmt: skip
        pipeline = PassManager("kernel")
        for each in passes:
            pipeline.add_pass(each, each.__name__)
        pipeline.finalize()
        return [pipeline]


class _Arguments(tuple[Any, ...]):
    """Argument types with a short string form; Numba would build a long form in every pass."""

    __slots__ = ()

    def __str__(self) -> str:
        return f"{len(self)} arguments"


@contextmanager
def _with_cached_lookups(flags: Any) -> Iterator[None]:
    """Cache the signatures of operations and the sizes of LLVM types within this context."""
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
        function._impl_keys[found.args] = body  # Numba uses `_impl_keys` to look up the body.
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


_njit: Any = numba.njit
_make_function: Any = numba._dynfunc.make_function  # type: ignore[attr-defined]


class BitcodeKernel(plain.InnerKernel):
    """Inner kernel that is compiled only to bitcode."""

    dispatcher: Any

    def _register(self, options: dict[str, Any]) -> None:
        self.dispatcher = _njit(
            pipeline_class=_InnerCompiler,
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
            **options,
        )(self.py_func)
        # Replace literal types. Otherwise, Numba would recompile the function for each literal
        # argument. LLVM folds the constants anyway.
        resolve = self.dispatcher.get_call_template
        self.dispatcher.get_call_template = lambda args, kws: resolve(
            tuple(types.unliteral(each) for each in args), kws
        )

    @property
    def _numba_type_(self) -> Any:
        """Numba type of the kernel, which Numba requests when it compiles a caller."""
        return self.dispatcher._numba_type_


class _Bitcode(JITCodeLibrary):
    """Code library that is linked into its callers and never compiled to machine code."""

    def _optimize_functions(self, ll_module: Any) -> None:
        # Do the same as Numba's own libraries, but skip functions that are only declared here.
        ll_module.data_layout = self._codegen._data_layout
        for function in ll_module.functions:
            if not function.is_declaration:
                passes, builder = self._codegen._function_pass_manager()
                passes.run(function, builder)

    def finalize(self) -> None:
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _InnerLowering(NativeLowering):
    """Lowering to a bitcode library, with a null entry point in place of machine code."""

    _name = "inner_lowering"

    def run_pass(self, state: Any) -> bool:
        name = state.func_id.func_qualname
        state.library = _Bitcode(state.targetctx.codegen(), name)
        state.flags.no_compile = True
        try:
            super().run_pass(state)
        finally:
            state.flags.no_compile = False
        lowered = state["cr"]
        fndesc, env = lowered.fndesc, lowered.env
        # Numba identifies an overload by the entry point, so each overload needs its own entry
        # point.
        entry = _make_function(fndesc.lookup_module(), name, "", 0, env, (state.library,))
        state.targetctx.insert_user_function(entry, fndesc, [state.library])
        state["cr"] = _LowerResult(fndesc, lowered.call_helper, cfunc=entry, env=env)
        return True


class _InnerCompiler(KernelCompiler):
    """Kernel compiler that lowers to bitcode."""

    lowering = _InnerLowering


_llvm: Any = llvmlite.binding


class KernelFolder:
    """Numba cache locator for the kernel folder."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> KernelFolder | None:
        """Return the locator, or None if no folder is available and kernels cannot be stored."""
        return None if kernel_folder() is None else cls(function, file)

    def get_cache_path(self) -> str:
        """Return the path of the kernel folder."""
        folder = kernel_folder()
        assert folder is not None
        return str(folder.path)

    def ensure_cache_path(self) -> None:
        """Do nothing, because `kernel_folder` has already created and checked the folder."""

    def get_source_stamp(self) -> str:
        """Return a digest of the kernel's own file; the folder name depends on all other files."""
        return hashlib.sha256(text(Path(self._py_file))).hexdigest()

    def get_disambiguator(self) -> str:
        """Return a string that distinguishes kernels with the same kernel and module name."""
        file = Path(self._py_file)
        inside = file.is_relative_to(ROOT)
        place = file.relative_to(ROOT).parent if inside else file.parent
        return f"{hashlib.sha256(str(place).encode()).hexdigest()[:8]}-{self._line}"


class _MachineCode(CompileResultCacheImpl):
    """Serialiser for compiled kernels."""

    _locator_classes: Any = (KernelFolder,)

    def reduce(self, cres: Any) -> Any:
        """Replace the bitcode with its symbol names, which Numba needs to find the machine code."""
        (name, kind, (code, bitcode)), *rest = super().reduce(cres)
        module = _llvm.parse_bitcode(bitcode)
        defined = (*module.functions, *module.global_variables)
        names = [f'@"{each.name}" = global i8 0' for each in defined if not each.is_declaration]
        names_alone = _llvm.parse_assembly("\n".join(names)).as_bitcode()
        return ((name, kind, (code, names_alone)), *rest)


class _Files:
    """Cache storage with one file per overload, which replaces Numba's index and data files."""

    def __init__(self, folder: OwnFolder, name: str, stamp: str) -> None:
        self._folder, self._name, self._stamp = folder, name, stamp

    def _file(self, key: Any) -> str:
        return f"{self._name}-{hashlib.sha256(repr((self._stamp, key)).encode()).hexdigest()[:16]}"

    def save(self, key: Any, data: Any) -> None:
        keep(self._folder, self._file(key), dumps(data))

    def load(self, key: Any) -> Any:
        data = kept(self._folder, self._file(key))
        return None if data is None else pickle.loads(data)


class KernelCache(FunctionCache):
    """Numba cache that stores only machine code. Raises RuntimeError if no folder is available."""

    _impl_class = _MachineCode

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        folder = kernel_folder()
        assert folder is not None
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file: Any = _Files(folder, self._impl.filename_base, stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load an overload without importing Numba's implementations of supported functions."""
        _add_symbols()
        return self._load_overload(sig, target_context)


@cache
def _add_symbols() -> None:
    """Register Numba's memory functions with LLVM, because the machine code calls them."""
    for name, address in nrt._nrt.c_helpers.items():  # type: ignore[attr-defined]
        _llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


inner = BitcodeKernel


def compiled(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Compile ``function`` with Numba; cache the result on disk if a folder is available."""
    dispatcher = _njit(no_cfunc_wrapper=True, pipeline_class=KernelCompiler, **options)(function)
    try:
        dispatcher._cache = KernelCache(function)
    except RuntimeError:
        pass  # Kernels are not stored. `kernel_folder` has already issued a warning.
    called = inner(function, options).dispatcher  # Callers need bitcode, which is not cached.
    dispatcher.get_call_template = called.get_call_template
    dispatcher.get_overload = called.get_overload
    return dispatcher
