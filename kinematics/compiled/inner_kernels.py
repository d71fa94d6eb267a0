"""Kernels that only kernels call: compiled to LLVM's bitcode alone, never to machine code.

Numba compiles every function that a kernel calls as if Python might call it, too: optimised with
all it calls, made into machine code, wrapped twice, kept in the cache. Their callers take the
bitcode and do all that again. Here the bitcode is all there is, which takes a third off the time of
compiling and leaves a quarter of the cache. The rest is done once, in the kernel that Python calls.
And what an operation makes of its arguments' types is asked once, not at each place in the source.

This module alone replaces steps of Numba's compiler; `pyproject.toml` bounds Numba for it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numba
from numba import types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, _LowerResult
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering, NopythonTypeInference

_njit: Any = numba.njit
_make_function: Any = numba._dynfunc.make_function  # type: ignore[attr-defined]


class InnerKernel:
    """What stands for an inner kernel in Python: Numba sees the kernel, a call is refused."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self.py_func = function
        self.__name__ = function.__name__
        self.__doc__ = function.__doc__
        self.__module__ = function.__module__
        self._dispatcher: Any = _njit(
            pipeline_class=_InnerCompiler,
            no_cpython_wrapper=True,
            no_cfunc_wrapper=True,
            **options,
        )(function)
        # Numba would compile it anew for each literal among the arguments; LLVM folds them anyway.
        resolve = self._dispatcher.get_call_template
        self._dispatcher.get_call_template = lambda args, kws: resolve(
            tuple(types.unliteral(each) for each in args), kws
        )

    def also(self, other: InnerKernel, takes: Callable[[Any], bool]) -> None:
        """Let ``other`` be compiled instead where ``takes`` the type of the first argument."""
        mine, others = self._dispatcher, other._dispatcher
        template, overload = mine.get_call_template, mine.get_overload
        mine.get_call_template = lambda args, kws: (
            others.get_call_template if takes(args[0]) else template
        )(args, kws)
        mine.get_overload = lambda sig: (others.get_overload if takes(sig[0]) else overload)(sig)

    @property
    def _numba_type_(self) -> Any:
        """By this Numba knows what a compiled caller means."""
        return self._dispatcher._numba_type_

    def __call__(self, *values: Any) -> Any:
        """Refused: there is no machine code for Python to call."""
        raise TypeError(
            f"{self.__module__}.{self.__name__} is an inner kernel, which only kernels may call; "
            "what Python calls is marked @kernel"
        )


class _Bitcode(JITCodeLibrary):
    """A library that is linked into those of its callers and never becomes machine code."""

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


_operation: Any = types.Function
_SIGNATURES: dict[Any, Any] = {}  # of operations, by their arguments' types and the arithmetic


@register_pass(mutates_CFG=True, analysis_only=False)
class _QuickTyping(NopythonTypeInference):
    """Type inference that remembers what Numba's own functions make of their arguments' types."""

    _name = "quick_typing"

    def run_pass(self, state: Any) -> bool:
        context = state.typingctx
        resolve = type(context).resolve_function_type
        arithmetic = frozenset(state.flags.fastmath.flags), state.flags.error_model

        def remembered(function: Any, arguments: Any, named: Any) -> Any:
            if named or not isinstance(function, _operation):
                return resolve(context, function, arguments, named)
            key = function, arguments, arithmetic
            if key not in _SIGNATURES:
                found = resolve(context, function, arguments, named)
                if found is None:
                    return None
                _SIGNATURES[key] = found, function._impl_keys[found.args]
            found, body = _SIGNATURES[key]
            function._impl_keys[found.args] = body  # by which Numba finds what to compile
            return found

        outer = vars(context).get("resolve_function_type", partial(resolve, context))
        context.resolve_function_type = remembered
        try:
            return bool(super().run_pass(state))
        finally:
            context.resolve_function_type = outer


class OuterCompiler(Compiler):
    """Numba's own pipeline with that type inference."""

    _replaced: ClassVar[dict[Any, Any]] = {NopythonTypeInference: _QuickTyping}

    def define_pipelines(self) -> list[Any]:
        pipelines: list[Any] = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [
                (self._replaced.get(each, each), text) for each, text in pipeline.passes
            ]
            pipeline._finalized = False
            pipeline.finalize()
        return pipelines


class _InnerCompiler(OuterCompiler):
    """And with that lowering."""

    _replaced: ClassVar[dict[Any, Any]] = {
        **OuterCompiler._replaced,
        NativeLowering: _InnerLowering,
    }
