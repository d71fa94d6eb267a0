"""What is kept of a compiled kernel, and how it is loaded: machine code, and nothing that compiles.

Numba keeps bitcode as well, for kernels that call this one; here they compile it anew.
And to load a kernel Numba first imports all that it could compile: a third of a second, 50 MB.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.runtime import nrt

from softfinger.kinematics.compiled.kernel_folder import ROOT, kernel_folder, text

_llvm: Any = llvmlite.binding


class KernelFolder:
    """Tells Numba where a kernel is kept: one of its cache locators."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> KernelFolder | None:
        """None where there is no folder: then nothing is kept."""
        return None if kernel_folder() is None else cls(function, file)

    def get_cache_path(self) -> str:
        """The one folder."""
        return str(kernel_folder())

    def ensure_cache_path(self) -> None:
        """Nothing to do: `kernel_folder` has made and checked it."""

    def get_source_stamp(self) -> str:
        """The kernel's own file; what the folder's name covers is the same by its being there."""
        return hashlib.sha256(text(Path(self._py_file))).hexdigest()

    def get_disambiguator(self) -> str:
        """Tells apart kernels of the same name in modules of the same name."""
        file = Path(self._py_file)
        inside = file.is_relative_to(ROOT)
        place = file.relative_to(ROOT).parent if inside else file.parent
        return f"{hashlib.sha256(str(place).encode()).hexdigest()[:8]}-{self._line}"


class _MachineCode(CompileResultCacheImpl):
    """A compiled kernel as it is kept."""

    _locator_classes: Any = (KernelFolder,)

    def reduce(self, cres: Any) -> Any:
        """Instead of the bitcode the names of what it defines, by which Numba finds it."""
        (name, kind, (code, bitcode)), *rest = super().reduce(cres)
        module = _llvm.parse_bitcode(bitcode)
        defined = (*module.functions, *module.global_variables)
        names = [f'@"{each.name}" = global i8 0' for each in defined if not each.is_declaration]
        names_alone = _llvm.parse_assembly("\n".join(names)).as_bitcode()
        return ((name, kind, (code, names_alone)), *rest)


class KernelCache(FunctionCache):
    """Where Numba looks for a kernel. Raises RuntimeError where there is no folder."""

    _impl_class = _MachineCode

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """As Numba does, without importing first all that it can compile."""
        _add_symbols()
        return self._load_overload(sig, target_context)


@cache
def _add_symbols() -> None:
    """Tell LLVM of Numba's memory functions, which machine code calls."""
    for name, address in nrt._nrt.c_helpers.items():  # type: ignore[attr-defined]
        _llvm.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)
