"""Kernels that only kernels call: compiled to LLVM's bitcode alone, never to machine code.

Numba compiles every function that a kernel calls as if Python might call it, too: optimised with
all it calls, made into machine code, wrapped twice, kept in the cache. Their callers take the
bitcode and do all that again. Here the bitcode is all there is, which takes a third off the time of
compiling and leaves a quarter of the cache. The rest is done once, in the kernel that Python calls.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
from numba import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import _LowerResult
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

from softfinger.kinematics.compiled.compiler import KernelCompiler

_njit: Any = numba.njit
_make_function: Any = numba._dynfunc.make_function  # type: ignore[attr-defined]


class InnerKernel:
    """What stands for an inner kernel in Python: Numba sees the kernel, a call is refused."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        self.__name__ = function.__name__
        self.__doc__ = function.__doc__
        self.__module__ = function.__module__
        self.dispatcher: Any = _njit(
            pipeline_class=_InnerCompiler,
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
            **options,
        )(function)
        # Numba would compile it anew for each literal among the arguments; LLVM folds them anyway.
        resolve = self.dispatcher.get_call_template
        self.dispatcher.get_call_template = lambda args, kws: resolve(
            tuple(types.unliteral(each) for each in args), kws
        )

    def also(self, other: InnerKernel, takes: Callable[[Any], bool]) -> None:
        """Let ``other`` be compiled instead where ``takes`` the type of the first argument."""
        mine, others = self.dispatcher, other.dispatcher
        template, overload = mine.get_call_template, mine.get_overload
        mine.get_call_template = lambda args, kws: (
            others.get_call_template if takes(args[0]) else template
        )(args, kws)
        mine.get_overload = lambda sig: (others.get_overload if takes(sig[0]) else overload)(sig)

    @property
    def _numba_type_(self) -> Any:
        """By this Numba knows what a compiled caller means."""
        return self.dispatcher._numba_type_

    def __call__(self, *values: Any) -> Any:
        """Refused: there is no machine code for Python to call."""
        raise TypeError(
            f"{self.__module__}.{self.__name__} is an inner kernel, which only kernels may call; "
            "what Python calls is marked @kernel"
        )


class _Bitcode(JITCodeLibrary):
    """A library that is linked into those of its callers and never becomes machine code."""

    def _optimize_functions(self, ll_module: Any) -> None:
        # Numba does this for what is only declared here, too.
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
    """Lowering into such a library, with an entry point that stands for the kernel, but is null."""

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
        # Numba knows an overload by its entry point, so each has one of its own.
        entry = _make_function(fndesc.lookup_module(), name, "", 0, env, (state.library,))
        state.targetctx.insert_user_function(entry, fndesc, [state.library])
        state["cr"] = _LowerResult(fndesc, lowered.call_helper, cfunc=entry, env=env)
        return True


class _InnerCompiler(KernelCompiler):
    """The compiler with that lowering."""

    lowering = _InnerLowering
