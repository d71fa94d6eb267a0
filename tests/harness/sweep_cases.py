"""Define the cases of test sweeps. Worker processes can import this module quickly."""

import os
import random
import signal
import threading
from functools import partial
from pathlib import Path

from softfinger.tools.sweep import Sweep

CASES = list(range(12))
EXPECTED = [random.Random(seed).random() for seed in CASES]
drawn_cases: list[int] = []  # cases that were computed in this process


def drawn(seed: int) -> float:
    """Return the first random number of a seed."""
    drawn_cases.append(seed)
    return random.Random(seed).random()


def dies_once(folder: Path, seed: int) -> float:
    """Kill the first worker that reaches case 5."""
    if seed == 5:
        try:
            (folder / "died").touch(exist_ok=False)
        except FileExistsError:
            return drawn(seed)
        os.kill(os.getpid(), signal.SIGKILL)
    return drawn(seed)


def dies(seed: int) -> float:
    """Kill each worker that reaches case 5."""
    if seed == 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return drawn(seed)


def hangs(folder: Path, seed: int) -> float:
    """Create a file with the worker's process ID in ``folder``, then wait forever."""
    (folder / str(os.getpid())).touch()
    threading.Event().wait()
    return drawn(seed)


def run_hanging_sweep(folder: Path) -> None:
    """Run an endless sweep in two processes."""
    list(Sweep("hangs", partial(hangs, folder), CASES).run(2))
