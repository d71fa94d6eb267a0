"""How long a thread was ready to run and another had its processor, as Linux counts it.

The emulator takes that off its own lateness; the bench tells by it who held a cycle up.
"""

from __future__ import annotations

import os

_SOURCE = "/proc/thread-self/schedstat"  # ns run, ns waited for a processor, times run
_LONGEST = 80  # bytes of its one line


class RunDelay:
    """The calling thread's; to be made in the thread that it is asked from."""

    def __init__(self) -> None:
        try:
            self._descriptor = os.open(_SOURCE, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:  # a kernel without scheduling statistics
            self._descriptor = -1
        self._last = self.total()

    def total(self) -> float:
        """Seconds since the thread began; 0 where the kernel does not count."""
        if self._descriptor < 0:
            return 0.0
        return int(os.pread(self._descriptor, _LONGEST, 0).split()[1]) * 1e-9

    def since_last(self) -> float:
        """Seconds since the last call of this."""
        last, self._last = self._last, self.total()
        return self._last - last

    def close(self) -> None:
        """Give the descriptor back."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
        self._descriptor = -1
