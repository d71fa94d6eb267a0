"""Configure scheduling, memory and timers for a steady tick, and notify systemd.

The ``[realtime]`` settings are applied once, after warm-up. Each setting is optional. If the system
refuses a setting, a warning explains the consequence and contains the command that grants the
permission. `daemon.clock` implements the busy wait before a deadline. The `Service` class sends the
READY, WATCHDOG and STOPPING notifications to systemd.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import socket
import struct
import sys
import threading
from collections.abc import Mapping
from contextlib import ExitStack, suppress

from softfinger.daemon.port_access import serial_group
from softfinger.daemon.profile.settings import Settings

_SWITCH_INTERVAL = 2e-4  # s
_KEEP_ALIVE_FRACTION = 0.25  # keep-alive interval as a fraction of the watchdog time
_NEVER = float("inf")
_LATENCY_DEVICE = "/dev/cpu_dma_latency"

# Shell commands that grant a user the requested permissions.
_LIMITS_FILE = "/etc/security/limits.d/softfinger.conf"
_UDEV_RULE_FILE = "/etc/udev/rules.d/99-softfinger.rules"
_LATENCY_UDEV_RULE = f'KERNEL=="cpu_dma_latency", GROUP="{serial_group()}", MODE="0660"'

GRANT_PRIORITY = f'echo "$USER - rtprio 80" | sudo tee -a {_LIMITS_FILE}, then log in again'
GRANT_MEMORY_LOCK = (
    f'echo "$USER - memlock unlimited" | sudo tee -a {_LIMITS_FILE}, then log in again'
)
GRANT_LATENCY = (
    f"echo '{_LATENCY_UDEV_RULE}' | sudo tee -a {_UDEV_RULE_FILE} && sudo udevadm control --reload "
    "&& sudo udevadm trigger /dev/cpu_dma_latency"
)

# From <sys/prctl.h> and <sys/mman.h>.
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4

_LIBC = ctypes.CDLL(None, use_errno=True)

# System call numbers of sched_setattr and sched_getattr for each machine type. The C library does
# not wrap the two system calls. The argument of both calls is struct sched_attr: size, policy,
# flags, nice, priority, runtime, deadline, period.
_ATTRIBUTE_CALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
_ATTRIBUTES = struct.Struct("=IIQiIQQQ")
_SLICE_MIN, _SLICE_MAX = 100_000, 100_000_000  # range of time slices that the kernel accepts [ns]


class RealTime:
    """Real-time settings, active inside ``with RealTime(settings): loop.run()``.

    Create the object in the loop thread, after warm-up. A refused setting does not raise an
    exception. Each setting is listed either in ``granted`` or in ``refused``. In virtual time, only
    the garbage collector and the thread switch interval are adjusted.
    """

    def __init__(self, settings: Settings) -> None:
        self.granted: list[str] = []
        self.refused: list[str] = []  # refused settings, each with its consequence and remedy
        self._undo = ExitStack()
        wanted = settings.realtime
        self._keep_interpreter(wanted.freeze_collector)
        if settings.loop.clock == "virtual":
            return
        if wanted.priority:
            self._schedule(wanted.priority)
        if wanted.slice:
            self._shorten_slice(min(max(round(wanted.slice * 1e9), _SLICE_MIN), _SLICE_MAX))
        if wanted.cpus:
            self._keep_to_processors(wanted.cpus)
        if wanted.lock_memory:
            self._lock_memory()
        if wanted.hold_latency:
            self._hold_latency()
        if wanted.timer_slack:
            self._sharpen_timer(max(round(wanted.timer_slack * 1e9), 1))
        if wanted.spin:
            self.granted.append(f"busy-waiting for {wanted.spin * 1e6:g} µs before each tick")

    def events(self) -> list[tuple[str, str, str]]:
        """Return one event for all granted settings, and one event for each refused setting."""
        events = [("info", "realtime", ", ".join(self.granted))] if self.granted else []
        return events + [("warning", "realtime", text) for text in self.refused]

    def close(self) -> None:
        """Undo all settings. Never raises."""
        with suppress(OSError):  # A thread may have exited.
            self._undo.close()

    def __enter__(self) -> RealTime:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _refused(self, text: str, remedy: str = "") -> None:
        self.refused.append(f"{text}; to allow this: {remedy}" if remedy else text)

    def _keep_interpreter(self, freeze: bool) -> None:
        """Keep the garbage collector and other threads from delaying the loop.

        A full collection of all NumPy and Numba objects takes tens of milliseconds, so existing
        objects are frozen. Another thread may hold the interpreter lock for one switch interval, so
        the default of 5 ms is reduced.
        """
        self._undo.callback(gc.unfreeze)
        self._undo.callback(sys.setswitchinterval, sys.getswitchinterval())
        if freeze:
            gc.freeze()
            self.granted.append("garbage collector frozen")
        gc.enable()
        sys.setswitchinterval(_SWITCH_INTERVAL)

    def _schedule(self, priority: int) -> None:
        """Set SCHED_FIFO for all threads of the interpreter.

        The loop thread gets ``priority``, and the other threads get one level less. At normal
        priority, a reader thread could be preempted while it holds the interpreter lock, and would
        then delay the loop. Native threads, such as ZeroMQ's, and child processes are scheduled
        normally.
        """
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        try:
            with ExitStack() as undo:
                for thread in _threads():
                    before = os.sched_getscheduler(thread), os.sched_getparam(thread)
                    mine = thread == threading.get_native_id()
                    level = os.sched_param(priority if mine else max(priority - 1, 1))
                    os.sched_setscheduler(thread, policy, level)
                    undo.callback(os.sched_setscheduler, thread, *before)
                self._undo.push(undo.pop_all())
        except OSError as error:
            self._refused(
                f"SCHED_FIFO {priority} denied ({error.strerror}): other processes can delay a "
                "tick",
                GRANT_PRIORITY,
            )
        else:
            self.granted.append(f"SCHED_FIFO {priority}")

    def _shorten_slice(self, nanoseconds: int) -> None:
        """Shorten the time slice of the interpreter's threads if SCHED_FIFO is not in use.

        Since version 6.12, Linux schedules threads with shorter slices sooner.
        """
        usual = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
        calls = _ATTRIBUTE_CALLS.get(os.uname().machine)
        if not usual or calls is None:
            return
        threads = _threads()
        shortened = [_set_slice(calls, thread, nanoseconds) for thread in threads]
        if any(shortened):  # Older kernels ignore the requested slice.
            for thread in threads:
                self._undo.callback(_set_slice, calls, thread, 0)
            self.granted.append(f"scheduler slices of {nanoseconds * 1e-6:g} ms")

    def _keep_to_processors(self, cpus: tuple[int, ...]) -> None:
        """Pin the loop thread to a set of processors, which other threads may still use."""
        names = ", ".join(map(str, cpus))
        before = os.sched_getaffinity(0)
        try:
            os.sched_setaffinity(0, cpus)
        except OSError as error:
            there = ", ".join(map(str, sorted(before)))
            self._refused(
                f"use of processor {names} denied ({error.strerror}; available: {there}): the "
                "loop may move between processors"
            )
        else:
            self._undo.callback(os.sched_setaffinity, 0, before)
            self.granted.append(f"processor {names}")

    def _lock_memory(self) -> None:
        """Lock each page in memory on first access. Warm-up has already accessed the loop's pages.

        Locking all pages immediately would take almost a second. Two thirds of the compiler
        libraries' pages are never accessed. If locked memory is limited, only existing mappings are
        locked, because later mappings would otherwise fail.
        """
        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        flags = _MCL_CURRENT | _MCL_ONFAULT
        if limit == resource.RLIM_INFINITY or os.geteuid() == 0:
            flags |= _MCL_FUTURE
        if _LIBC.mlockall(flags) != 0:
            why = os.strerror(ctypes.get_errno())
            text = f"memory lock denied ({why}): the loop's memory can be swapped out"
            self._refused(text, GRANT_MEMORY_LOCK)
        else:
            self._undo.callback(_LIBC.munlockall)
            self.granted.append("memory locked")

    def _hold_latency(self) -> None:
        """Prevent deep processor idle states while the device file is open."""
        try:
            descriptor = os.open(_LATENCY_DEVICE, os.O_WRONLY | os.O_CLOEXEC)
            self._undo.callback(os.close, descriptor)
            os.write(descriptor, bytes(4))
        except OSError as error:
            text = f"{_LATENCY_DEVICE} denied ({error.strerror}): deep idle states delay wake-ups"
            self._refused(text, "" if isinstance(error, FileNotFoundError) else GRANT_LATENCY)
        else:
            self.granted.append("deep idle states disabled")

    def _sharpen_timer(self, nanoseconds: int) -> None:
        """Reduce the timer slack, i.e. the time by which the kernel may delay wake-ups."""
        if _LIBC.prctl(_PR_SET_TIMERSLACK, nanoseconds, 0, 0, 0) != 0:
            why = os.strerror(ctypes.get_errno())
            self._refused(f"timer slack denied ({why}): wake-ups may be 50 µs late")
        else:  # A value of 0 restores the initial slack.
            self._undo.callback(_LIBC.prctl, _PR_SET_TIMERSLACK, 0, 0, 0, 0)
            self.granted.append(f"timer slack {nanoseconds} ns")


def _threads() -> list[int]:
    """Return the native IDs of all threads of this interpreter."""
    return [each.native_id for each in threading.enumerate() if each.native_id is not None]


def _set_slice(calls: tuple[int, int], thread: int, nanoseconds: int) -> bool:
    """Set a thread's time slice (0: system default); return True if the change took effect."""
    set_call, get_call = calls
    size = _ATTRIBUTES.size
    nice = os.getpriority(os.PRIO_PROCESS, thread)
    asked = _ATTRIBUTES.pack(size, os.SCHED_OTHER, 0, nice, 0, nanoseconds, 0, 0)
    if _LIBC.syscall(set_call, thread, ctypes.create_string_buffer(asked), 0) != 0:
        return False
    found = ctypes.create_string_buffer(size)
    if _LIBC.syscall(get_call, thread, found, size, 0) != 0:
        return False
    return bool(_ATTRIBUTES.unpack(found.raw)[5] == nanoseconds)


class Service:
    """Sender of notifications to systemd over ``NOTIFY_SOCKET``. Never blocks or raises.

    Each systemd notification is one datagram. The loop calls `alive` on every tick. Most calls only
    compare times, because a few messages per watchdog period are sufficient.
    """

    def __init__(self, address: str, watchdog: float = 0.0) -> None:
        """Open the socket.

        systemd terminates the service if no message arrives for ``watchdog`` [s]; 0 disables the
        watchdog.
        """
        # A name starting with @ denotes an abstract socket, whose address begins with a zero byte.
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._every = watchdog * _KEEP_ALIVE_FRACTION if watchdog > 0.0 else _NEVER
        self._due = -_NEVER
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)

    @classmethod
    def of_environment(cls, environment: Mapping[str, str] = os.environ) -> Service | None:
        """Return the service for this environment, or None if systemd did not start the process."""
        address = environment.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@") or len(address) < 2:
            return None
        wanted = environment.get("WATCHDOG_USEC", "")
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        watchdog = int(wanted) * 1e-6 if mine and wanted.isdecimal() else 0.0
        return cls(address, watchdog)

    def alive(self, t: float) -> None:
        """Send a keep-alive message if one is due at ``t`` [s]. The first message reports READY."""
        if t < self._due:
            return
        message = b"READY=1\nWATCHDOG=1" if self._due == -_NEVER else b"WATCHDOG=1"
        self._due = t + self._every
        self._send(message)

    def close(self) -> None:
        """Report that shutdown has begun, and close the socket."""
        self._send(b"STOPPING=1")
        self._socket.close()

    def _send(self, message: bytes) -> None:
        try:
            self._socket.sendto(message, self._address)
        except OSError:
            pass  # systemd is not listening, or its receive queue is full.
