"""How the process is made fit for a steady tick. Each measure is asked for once, after warm-up."""

from __future__ import annotations

import gc
import sys

_SWITCH_INTERVAL = 2e-4  # s


def settle() -> None:
    """Keep the collector and other threads from holding up a tick.

    A full collection over everything that numpy and numba brought along takes tens of
    milliseconds, so what exists now is frozen out of it. A reader thread may keep the interpreter
    for a switch interval, 5 ms unless it is set lower.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(_SWITCH_INTERVAL)
