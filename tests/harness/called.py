"""Inner kernels as tests call them: from Python, which needs a wrapper that they don't have."""

from typing import Any, TypeVar

from softfinger.kinematics.compiled.kernel import kernel

Function = TypeVar("Function")


def called(inner: Function) -> Function:
    """The same source compiled as a kernel that Python may call."""
    source: Any = inner
    made: Function = kernel(source.py_func)
    return made
