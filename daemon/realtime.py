"""How the process is made fit for a steady tick. Each measure is asked for once, after warm-up."""

from __future__ import annotations

import gc
import sys

_SWITCH_INTERVAL = 2e-4  # s


def hold_collector() -> None:
    """Keep the collector off while everything is imported and built, which makes little garbage.

    Collections over half-imported modules are a tenth of the start-up.
    """
    gc.disable()


def settle() -> None:
    """Keep the collector and other threads from holding up a tick.

    A full collection over everything that numpy and numba brought along takes tens of
    milliseconds, so what exists now is frozen out of it, without a last collection for the same
    reason. A reader thread may keep the interpreter for a switch interval, 5 ms unless it is set
    lower.
    """
    gc.freeze()
    gc.enable()
    sys.setswitchinterval(_SWITCH_INTERVAL)
