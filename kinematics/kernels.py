"""The one decorator behind every compiled kernel, and nothing else.

A kernel takes arrays and scalars and is pure. It is compiled by Numba at its first call and kept in
Numba's on-disk cache. Numba asks for a fresh compilation only when the kernel's own file changes;
here it also happens when any of our modules that the file imports changes, so that a cached caller
never runs an old callee. The modules are found by their absolute imports.
"""

from __future__ import annotations

import hashlib
import inspect
import re
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

_ROOT = Path(__file__).resolve().parent.parent
_IMPORT = re.compile(r"^\s*(?:from|import)\s+((?:kinematics|daemon)(?:\.\w+)*)", re.MULTILINE)


def kernel(function: Function) -> Function:
    """Compile ``function`` with Numba: cached on disk, IEEE arithmetic, the GIL kept.

    The GIL is kept because retaking it in the loop can cost a whole switch interval.
    """
    return _compile(function, fastmath=False)


def fast_kernel(function: Function) -> Function:
    """As :func:`kernel`, with sums reordered and fused so that they run in SIMD lanes.

    For reductions over finite numbers only: NaN and infinity have no defined result there.
    """
    return _compile(function, fastmath={"reassoc", "contract", "nsz", "arcp"})


def inlined_kernel(function: Function) -> Function:
    """As :func:`kernel`, but a part of every compiled caller, and products and sums may be fused.

    For the innermost functions of a hot path, where a call costs as much as the work. Its code is
    there again in each caller, so it should be short.
    """
    return _compile(function, fastmath={"contract"}, inline=True)


def _compile(function: Function, fastmath: bool | set[str], inline: bool = False) -> Function:
    options: dict[str, Any] = {"error_model": "numpy", "fastmath": fastmath, "forceinline": inline}
    try:
        dispatcher: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither beside the source nor in the user's cache can files be written
        _warn_uncached()
        return cast(Function, numba.njit(**options)(function))
    # Numba compares this stamp with the one it saved; it offers no public way to widen it.
    index = dispatcher._cache._cache_file
    index._source_stamp = source_digest(Path(inspect.getfile(function)))
    return cast(Function, dispatcher)


@cache
def _warn_uncached() -> None:
    warnings.warn(
        "compiled kernels can't be kept: no writable cache folder; every start compiles anew "
        "(NUMBA_CACHE_DIR names a folder)",
        stacklevel=2,
    )


def source_digest(path: Path) -> str:
    """SHA-256 over ``path`` and all our modules that it imports, directly or through others."""
    digest = hashlib.sha256()
    for source in sorted(_closure(path)):
        digest.update(source.name.encode())
        digest.update(_text(source))
    return digest.hexdigest()


def _closure(path: Path) -> set[Path]:
    seen: set[Path] = set()
    waiting = [path]
    while waiting:
        source = waiting.pop()
        if source in seen:
            continue
        seen.add(source)
        waiting.extend(_imports(source))
    return seen


@cache
def _imports(path: Path) -> tuple[Path, ...]:
    found = []
    for name in _IMPORT.findall(_text(path).decode()):
        module = _ROOT.joinpath(*name.split("."))
        for candidate in (module.with_suffix(".py"), module / "__init__.py"):
            if candidate.is_file():
                found.append(candidate)
    return tuple(found)


@cache
def _text(path: Path) -> bytes:
    return path.read_bytes()
