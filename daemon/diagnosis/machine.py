"""Check the machine's scheduling, memory lock, idle states, clock and kernel cache.

The daemon can run despite the problems found here, so they are reported as warnings. The checks
read the limits of this process. A daemon that is started from the same shell has the same limits.
"""

from __future__ import annotations

import os
import resource
import time
from pathlib import Path

from softfinger.daemon.loop.realtime import GRANT_LATENCY, GRANT_MEMORY_LOCK, GRANT_PRIORITY
from softfinger.daemon.loop.warm_up import is_built, parts
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.base import Finding
from softfinger.kinematics.compiled.kernel_folder import damaged, find_kernel_folder

_MEMORY = 1 << 30  # upper bound on the daemon's mapped memory [bytes]
_WAKE_UP_COUNT = 100
_PERIOD = 0.002  # s
# Earliest plausible Unix time [s]. A clock that shows an earlier time has not been set.
_CLOCK_MIN = 1_700_000_000.0


def check_machine() -> list[Finding]:
    """Run the checks that do not depend on the settings."""
    return [
        check_scheduling(),
        check_memory_lock(resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]),
        check_idle_states(Path("/dev/cpu_dma_latency")),
        check_wall_clock(time.time()),
        check_wake_ups(wake_ups()),
    ]


def check_scheduling() -> Finding:
    """Check that SCHED_FIFO is allowed; the check briefly enables SCHED_FIFO for this thread."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError:
        soft, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
        problem = f"not allowed (RLIMIT_RTPRIO {soft}), so other processes can delay a tick"
        return Finding("warn", "scheduling", f"SCHED_FIFO is {problem}", GRANT_PRIORITY)
    os.sched_setscheduler(0, *before)
    return Finding("pass", "scheduling", "SCHED_FIFO is allowed")


def check_memory_lock(limit: int) -> Finding:
    """Check that ``limit``, the value of RLIMIT_MEMLOCK [bytes], is high enough."""
    if os.geteuid() == 0:
        return Finding("pass", "memory lock", "not limited for root")
    if limit == resource.RLIM_INFINITY:
        return Finding("pass", "memory lock", "not limited")
    size = f"{limit >> 10} KiB"
    if limit >= _MEMORY:
        return Finding("pass", "memory lock", size)
    problem = (
        f"only {size} may be locked, expected {_MEMORY >> 20} MiB: the loop's memory can be "
        "swapped out"
    )
    return Finding("warn", "memory lock", problem, GRANT_MEMORY_LOCK)


def check_idle_states(path: Path) -> Finding:
    """Check that the daemon can disable deep idle states, from which processors wake up slowly."""
    name = str(path)
    if not path.exists():
        return Finding(
            "warn", name, "not provided by this kernel, so deep idle states delay wake-ups"
        )
    if os.access(path, os.W_OK):
        return Finding("pass", name, "can be opened")
    problem = "can't be opened (no permission), so deep idle states delay wake-ups"
    return Finding("warn", name, problem, GRANT_LATENCY)


def check_wall_clock(now: float) -> Finding:
    """Check that the Unix time ``now`` [s] is plausible, because messages contain timestamps."""
    if now >= _CLOCK_MIN:
        return Finding("pass", "wall clock", time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now)))
    date = time.strftime("%Y-%m-%d", time.gmtime(now))
    problem = f"is set to {date}, so published timestamps will be wrong"
    return Finding("warn", "wall clock", problem, "sudo timedatectl set-ntp true")


def wake_ups() -> list[float]:
    """Sleep as the loop does between ticks, and return the wake-up delays [s]."""
    late = []
    deadline = time.monotonic()
    for _ in range(_WAKE_UP_COUNT):
        deadline += _PERIOD
        time.sleep(max(deadline - time.monotonic(), 0.0))
        late.append(time.monotonic() - deadline)
    return late


def check_wake_ups(late: list[float]) -> Finding:
    """Return a warning if the median wake-up delay [s] exceeds a quarter of the tick period."""
    worst = max(late)
    middle = sorted(late)[len(late) // 2]
    text = (
        f"median delay {middle * 1e6:.0f} µs, maximum {worst * 1e6:.0f} µs over {len(late)} ticks"
    )
    if middle < 0.25 * _PERIOD:
        return Finding("pass", "wake-ups", text)
    problem = f"{text}: the machine is busy, or its processors wake up slowly"
    return Finding("warn", "wake-ups", problem, "end other programs")


def check_kernels(settings: Settings) -> list[Finding]:
    """Check that the kernel cache is writable and contains this scene's compiled kernels."""
    try:
        with find_kernel_folder() as folder:
            place, spoilt = folder.path, len(damaged(folder))
    except (OSError, RuntimeError) as error:
        problem = f"can't be used, so kernels are compiled at every start: {error}"
        fix = "export NUMBA_CACHE_DIR=FOLDER, where FOLDER is your own folder"
        return [Finding("warn", "kernel cache", problem, fix)]
    if spoilt:
        problem = f"found {spoilt} corrupted files in {place}, which the next start will recompile"
        return [
            Finding("warn", "kernels", problem, "run `softfinger compile`, or start the daemon")
        ]
    cold = [part.name for part in parts(settings) if not is_built(part, settings)]
    if not cold:
        return [Finding("pass", "kernels", f"compiled, in {place}")]
    problem = f"not compiled yet: {', '.join(cold)}; the next start will take longer"
    return [Finding("warn", "kernels", problem, "run `softfinger compile`, or start the daemon")]
