"""Arrays without an owner inside compiled code, so that nothing counts references to them.

Numba counts an array's references wherever a function that has it returns in several ways or takes
a part of it, and each count is an atomic instruction. In a kernel of a microsecond that passes its
arrays to others they are a third of the time.
"""

from __future__ import annotations

from typing import Any, cast

from numba.core import cgutils
from numba.core.extending import intrinsic


def _borrowed(context: Any, array: Any) -> Any:
    """Signature and code generator; see :data:`borrowed`."""

    def generate(codegen: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        view = codegen.make_array(sig.args[0])(codegen, builder, arguments[0])
        view.meminfo = cast(Any, cgutils).get_null_value(view.meminfo.type)
        view.parent = cast(Any, cgutils).get_null_value(view.parent.type)
        return view._getvalue()

    return array(array), generate


# borrowed(array): the same array, but owned by nobody. The caller of the kernel keeps the owner: a
# kernel may neither return what it borrowed nor keep it.
borrowed = cast(Any, intrinsic)(_borrowed)
