"""Scheduling, memory and timers for a steady tick: the section ``[realtime]``, once, after warm-up.

No measure is needed: one that the system refuses is reported, with what is lost and the command
that grants it. The spin before a deadline is `daemon.clock`'s.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import struct
import sys
import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from softfinger.daemon.profile.settings import Realtime, Settings

_SWITCH_INTERVAL = 2e-4  # s
_LATENCY = "/dev/cpu_dma_latency"

# The commands that grant a user what is asked of the system.
_LIMITS = "/etc/security/limits.d/softfinger.conf"
_RULE = "/etc/udev/rules.d/99-softfinger.rules"
_LATENCY_RULE = 'KERNEL=="cpu_dma_latency", GROUP="dialout", MODE="0660"'

GRANT_PRIORITY = f'echo "$USER - rtprio 80" | sudo tee -a {_LIMITS}, then log in again'
GRANT_MEMORY_LOCK = f'echo "$USER - memlock unlimited" | sudo tee -a {_LIMITS}, then log in again'
GRANT_LATENCY = (
    f"echo '{_LATENCY_RULE}' | sudo tee -a {_RULE} && sudo udevadm control --reload "
    "&& sudo udevadm trigger /dev/cpu_dma_latency"
)

# From <sys/prctl.h> and <sys/mman.h>.
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4

# The system calls sched_setattr and sched_getattr, which the C library lacks, by machine; and their
# argument, struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period.
_ATTRIBUTE_CALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
_ATTRIBUTES = struct.Struct("=IIQiIQQQ")
_SHORTEST, _LONGEST = 100_000, 100_000_000  # ns, between which the kernel takes a slice


def hold_collector() -> None:
    """Keep the collector off while everything is imported and built, which makes little garbage.

    Collections over half-imported modules are a tenth of the start-up.
    """
    gc.disable()


def settle(freeze: bool = True) -> None:
    """Keep the collector and other threads from delaying the loop.

    A full collection over all of numpy and numba takes tens of milliseconds: what exists now is
    frozen out of it. A thread may keep the interpreter for a switch interval, 5 ms by default.
    """
    if freeze:
        gc.freeze()
    gc.enable()
    sys.setswitchinterval(_SWITCH_INTERVAL)


class Outcome(NamedTuple):
    """What became of one measure."""

    granted: bool
    text: str  # what is had; or what was refused and what is lost by it
    remedy: str = ""  # the command that grants it

    def __str__(self) -> str:
        return f"{self.text}; to grant it: {self.remedy}" if self.remedy else self.text


class RealTime:
    """The measures, held while this is open: ``with RealTime(settings): loop.run()``.

    To be opened in the thread that ticks, after warm-up. Never raises; ``outcomes`` says what came
    of each. On virtual time only the collector and other threads are kept from the tick.
    """

    def __init__(self, settings: Settings) -> None:
        self.outcomes: list[Outcome] = []
        self._undo: list[Callable[[], object]] = []
        wanted = settings.realtime
        self._keep_interpreter(wanted)
        if settings.loop.clock == "virtual":
            return
        for ask in (
            _schedule,
            _shorten_slice,
            _keep_to_processors,
            _lock_memory,
            _hold_latency,
            _sharpen_timer,
        ):
            outcome, undo = ask(wanted)
            if outcome is not None:
                self.outcomes.append(outcome)
            self._undo += undo
        if wanted.spin:
            text = f"spin of {wanted.spin * 1e6:g} µs before each tick"
            self.outcomes.append(Outcome(True, text))

    def _keep_interpreter(self, wanted: Realtime) -> None:
        interval = sys.getswitchinterval()
        settle(freeze=wanted.freeze_collector)
        self._undo += [gc.unfreeze, lambda: sys.setswitchinterval(interval)]
        if wanted.freeze_collector:
            self.outcomes.append(Outcome(True, "collector frozen"))

    def events(self) -> list[tuple[str, str, str]]:
        """For the loop's events: one that names all that is had, one for each refusal."""
        had = ", ".join(outcome.text for outcome in self.outcomes if outcome.granted)
        refused = [str(outcome) for outcome in self.outcomes if not outcome.granted]
        events = [("info", "realtime", had)] if had else []
        return events + [("warning", "realtime", text) for text in refused]

    def close(self) -> None:
        """Give everything back. Never raises."""
        while self._undo:
            try:
                self._undo.pop()()
            except OSError:
                pass  # a thread that has ended, say

    def __enter__(self) -> RealTime:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# What came of a measure, None where it was not asked for, and what takes it back.
Asked = tuple[Outcome | None, list[Callable[[], object]]]


def _schedule(wanted: Realtime) -> Asked:
    """SCHED_FIFO for the loop, and one step below it for the threads that share its interpreter.

    A reader thread that the system puts aside while it has the interpreter would hold up the loop
    for as long. Threads without it, as ZeroMQ's, and child processes keep the usual scheduling.
    """
    if not wanted.priority:
        return None, []
    own = threading.get_native_id()
    undo: list[Callable[[], object]] = []
    try:
        for thread in threading.enumerate():
            if thread.native_id is None:
                continue
            mine = thread.native_id == own
            priority = wanted.priority if mine else max(wanted.priority - 1, 1)
            undo.append(_fifo(thread.native_id, priority))
    except OSError as error:
        for each in undo:
            each()
        text = (
            f"SCHED_FIFO {wanted.priority} refused ({error.strerror}): "
            "other processes can hold up a tick"
        )
        return Outcome(False, text, GRANT_PRIORITY), []
    return Outcome(True, f"SCHED_FIFO {wanted.priority}"), undo


def _fifo(thread: int, priority: int) -> Callable[[], None]:
    before = os.sched_getscheduler(thread), os.sched_getparam(thread)
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    os.sched_setscheduler(thread, policy, os.sched_param(priority))
    return lambda: os.sched_setscheduler(thread, *before)


def _shorten_slice(wanted: Realtime) -> Asked:
    """Under the usual scheduling, a short slice for the loop and the threads of its interpreter.

    Linux (from 6.12 on) runs the thread whose slice would end first: a short one runs sooner.
    """
    usual = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    calls = _ATTRIBUTE_CALLS.get(os.uname().machine)
    if not wanted.slice or not usual or calls is None:
        return None, []
    nanoseconds = min(max(round(wanted.slice * 1e9), _SHORTEST), _LONGEST)
    had = False
    undo: list[Callable[[], object]] = []
    for thread in threading.enumerate():
        if thread.native_id is not None:
            had = _set_slice(calls, thread.native_id, nanoseconds) or had
            undo.append(partial(_set_slice, calls, thread.native_id, 0))
    if not had:
        return None, []  # an older kernel, where there is nothing to be had
    return Outcome(True, f"slices of {nanoseconds * 1e-6:g} ms"), undo


def _set_slice(calls: tuple[int, int], thread: int, nanoseconds: int) -> bool:
    """Whether the thread has slices of that length afterwards; 0 stands for the system's."""
    set_call, get_call = calls
    libc = ctypes.CDLL(None, use_errno=True)
    size = _ATTRIBUTES.size
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    asked = _ATTRIBUTES.pack(size, os.SCHED_OTHER, 0, nice, 0, nanoseconds, 0, 0)
    if libc.syscall(set_call, thread, ctypes.create_string_buffer(asked), 0) != 0:
        return False
    found = ctypes.create_string_buffer(size)
    if libc.syscall(get_call, thread, found, size, 0) != 0:
        return False
    return bool(_ATTRIBUTES.unpack(found.raw)[5] == nanoseconds)


def _keep_to_processors(wanted: Realtime) -> Asked:
    """The loop's thread alone: others may run beside it."""
    if not wanted.cpus:
        return None, []
    names = ", ".join(map(str, wanted.cpus))
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, wanted.cpus)
    except OSError as error:
        there = ", ".join(map(str, sorted(before)))
        text = (
            f"processor {names} refused ({error.strerror}; there are {there}): "
            "the loop may move between processors"
        )
        return Outcome(False, text), []
    return Outcome(True, f"processor {names}"), [lambda: os.sched_setaffinity(0, before)]


def _lock_memory(wanted: Realtime) -> Asked:
    """Lock pages in memory once they have been touched, as after warm-up they are.

    Two thirds of a compiler's libraries never are, and reading them in takes most of a second.
    Under a limit only what is mapped now is locked, or later mappings would fail.
    """
    if not wanted.lock_memory:
        return None, []
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    flags = _MCL_CURRENT | _MCL_ONFAULT
    if limit == resource.RLIM_INFINITY or os.geteuid() == 0:
        flags |= _MCL_FUTURE
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(flags) != 0:
        why = os.strerror(ctypes.get_errno())
        text = f"memory lock refused ({why}): pages of the loop can be swapped out"
        return Outcome(False, text, GRANT_MEMORY_LOCK), []
    return Outcome(True, "memory locked"), [libc.munlockall]


def _hold_latency(wanted: Realtime) -> Asked:
    """As long as the file is open, no processor goes into a state that takes time to leave."""
    if not wanted.hold_latency:
        return None, []
    try:
        descriptor = os.open(_LATENCY, os.O_WRONLY | os.O_CLOEXEC)
    except OSError as error:
        text = f"{_LATENCY} refused ({error.strerror}): wake-ups take what idle states take"
        missing = isinstance(error, FileNotFoundError)
        return Outcome(False, text, "" if missing else GRANT_LATENCY), []
    try:
        os.write(descriptor, bytes(4))
    except OSError as error:
        os.close(descriptor)
        return Outcome(False, f"{_LATENCY} refused ({error.strerror})"), []
    return Outcome(True, "idle states held off"), [lambda: os.close(descriptor)]


def _sharpen_timer(wanted: Realtime) -> Asked:
    """The kernel may put off a wake-up by this thread's slack, to make one of several."""
    if not wanted.timer_slack:
        return None, []
    nanoseconds = max(round(wanted.timer_slack * 1e9), 1)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, nanoseconds, 0, 0, 0) != 0:
        why = os.strerror(ctypes.get_errno())
        return Outcome(False, f"timer slack refused ({why}): wake-ups come 50 µs later"), []
    usual = 0  # which stands for what the thread began with
    return (
        Outcome(True, f"timer slack {nanoseconds} ns"),
        [lambda: libc.prctl(_PR_SET_TIMERSLACK, usual, 0, 0, 0)],
    )
