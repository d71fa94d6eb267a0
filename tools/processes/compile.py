"""Compile a scene's kernels on all cores, for ``softfinger compile`` or a daemon's first start.

The daemon itself only loads the kernels and therefore uses less memory. Each process compiles
pipeline parts (`loop.warm_up`) one after another. Parts that need the contact table wait until the
table exists.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from softfinger.daemon.loop.warm_up import (
    ALL,
    Part,
    WantedScene,
    is_built,
    mark_built,
    named,
    parts,
)
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import EventSink
from softfinger.kinematics.compiled.kernel import why_plain
from softfinger.kinematics.compiled.kernel_folder import kernel_folder, remove_damaged
from softfinger.tools.arguments import add_profile, profile
from softfinger.tools.sweep import Progress, processors

_ROOT = Path(__file__).parents[3]
_MEMORY_MAX = 400e6  # upper bound on the memory use per process [bytes]
_CHECK_INTERVAL = 0.2  # s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_profile(parser)
    parser.add_argument(
        "--all", action="store_true", help="also compile the kernels of other tools and tests"
    )


def run(arguments: argparse.Namespace) -> int:
    """Compile the missing kernels. Return 1 if a kernel could not be compiled or stored.

    Raises SettingsError.
    """
    if not build_kernels(profile(arguments), print_event, ALL if arguments.all else None):
        return 1
    print("all kernels are compiled")
    return 0


def print_event(_level: str, _kind: str, text: str) -> None:
    """Print an event to standard error, for tools that do not have a log."""
    print(text, file=sys.stderr, flush=True)


def build_kernels(
    settings: Settings, tell: EventSink, wanted: Sequence[Part] | None = None, bar: bool = True
) -> bool:
    """Build the missing parts in ``wanted``, or all missing parts of the scene by default.

    Return False if a part could not be built or stored. If all parts exist, the function returns
    quickly without a message. If standard error is a terminal and ``bar`` is set, a bar shows the
    progress. Without a bar, ``tell(level, kind, text)`` is called for each part. Failures are also
    passed to ``tell``. An interrupt ends all processes.
    """
    folder = kernel_folder()
    if folder is not None and (count := remove_damaged(folder)):
        text = f"{folder.path}: recompiling {count} corrupted files"
        tell("warning", "compile", text)
    missing = [part for part in wanted or parts(settings) if not is_built(part, settings)]
    if not missing:
        return True
    if folder is None:
        text = (
            "the kernels can't be stored, so each process compiles the kernels that it uses, which "
            "takes about half a minute"
        )
        tell("warning", "compile", text)
        return False
    if why_plain:
        tell(
            "info", "compile", f"compiling with Numba alone, which takes twice as long: {why_plain}"
        )
    names = ", ".join(part.name for part in missing)
    tell("info", "compile", f"compiling kernels (only on the first start): {names}")
    started = time.monotonic()
    if not _Build(settings, missing, tell, bar).run():
        return False
    tell("info", "compile", f"compiled in {time.monotonic() - started:.1f} s")
    return True


def _available() -> float:
    """Return the memory available without swapping [bytes], or infinity if unknown."""
    try:
        _, _, rest = Path("/proc/meminfo").read_text().partition("MemAvailable:")
    except OSError:
        return math.inf
    return 1024.0 * float(rest.split()[0])


class _Build:
    """Build pipeline parts in several processes, each controlled by its own thread."""

    def __init__(self, settings: Settings, missing: list[Part], tell: EventSink, bar: bool) -> None:
        self._head = f"{settings.model_dump_json()}\n"
        self._missing = missing
        self._at: dict[str, str] = {}  # for each part, the kernel that is being compiled
        self._total, self._begun = sum(part.kernels for part in missing), 0
        self._started = time.monotonic()
        self._bar, self._tell = Progress("compiling kernels", self._total, bar), tell
        self._processes: list[subprocess.Popen[str]] = []
        self._own = threading.local()  # Each thread uses its own process.
        self._over = False

    def run(self) -> bool:
        """Build all parts; return True on success. If interrupted, end all processes."""
        built: dict[str, Future[str]] = {}
        jobs = max(1, int(min(processors(), len(self._missing), _available() / _MEMORY_MAX)))
        pool = ThreadPoolExecutor(jobs)
        try:
            for part in self._missing:
                built[part.name] = pool.submit(self._build, part, built.get(part.after))
            with self._bar as show:
                while wait(built.values(), _CHECK_INTERVAL).not_done:
                    at = "; ".join(f"{name}: {kernel}" for name, kernel in list(self._at.items()))
                    show(self._begun, f"{self._so_far()}: {at}")
        finally:
            self._over = True
            pool.shutdown(wait=False, cancel_futures=True)
            for process in self._processes:
                process.kill()
            pool.shutdown()
            for process in self._processes:
                with process:
                    pass
        # Report each reason only once, because invalid settings make all parts fail in the same
        # way.
        reasons: set[str] = set()
        for name, future in built.items():
            if (reason := future.result()) and reason not in reasons:
                self._tell("warning", "compile", f"{name} was not compiled ahead of time: {reason}")
            reasons.add(reason)
        return reasons == {""}

    def _so_far(self) -> str:
        return (
            f"{min(self._begun, self._total)} of about {self._total}, "
            f"{time.monotonic() - self._started:.0f} s"
        )

    def _build(self, part: Part, after: Future[str] | None) -> str:
        """Wait for ``after``, then build ``part``; return the reason for a failure, or ""."""
        if after is not None:
            wait([after])
        head, process = "", getattr(self._own, "process", None)
        if process is None:
            process = self._own.process = _start()
            self._processes.append(process)
            if self._over:
                process.kill()
            head = self._head
        assert process.stdout is not None
        self._at[part.name] = ""
        with contextlib.suppress(BrokenPipeError):
            print(f"{head}{part.name}", file=process.stdin, flush=True)
        for line in process.stdout:
            word, _, rest = line.rstrip("\n").partition(" ")
            if word == "kernel":
                self._begun += 1
                self._at[part.name] = rest
                continue
            del self._at[part.name]
            if word == "done" and not self._bar.on:
                self._tell("info", "compile", f"{part.name}: {self._so_far()}")
            return rest
        self._own.process = None
        del self._at[part.name]
        return f"the compiling process exited with status {process.wait()}"


def _start() -> subprocess.Popen[str]:
    """Start a process that runs `main`."""
    # The -P option keeps Python from importing a folder named tools in the working directory.
    command = [sys.executable, "-P", "-m", "softfinger.tools.processes.compile"]
    path = os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
        text=True,
        process_group=0,  # Ctrl-C reaches only the parent process, which then stops its children.
    )


def main() -> None:
    """Compile a scene's kernels part by part, until standard input ends.

    Standard input contains the settings as JSON, followed by one part name per line. When the
    compilation of a kernel starts, the line ``kernel NAME`` is written to standard output. The last
    line for each part is ``done`` or ``failed REASON``.
    """
    # The compiler allocates many long-lived objects, so frequent garbage collection would take 10 %
    # of the compile time.
    gc.set_threshold(100_000)
    out = sys.stdout
    sys.stdout = sys.stderr  # Other output must not interfere with the protocol.

    def tell(line: str) -> None:
        print(line, file=out, flush=True)

    from numba.core import event as numba_event

    events: Any = numba_event

    class Compiling(numba_event.Listener):
        def on_start(self, event: Any) -> None:
            tell(f"kernel {event.data['dispatcher'].py_func.__name__}")

        def on_end(self, event: Any) -> None:
            pass

    events.register("numba:compile", Compiling())
    head = sys.stdin.readline()
    if not head:
        return
    settings = Settings.model_validate_json(head)
    scene = WantedScene(settings)
    for line in sys.stdin:
        part = named(line.rstrip("\n"))
        try:
            part.run(scene)
        except Exception as error:
            tell(f"failed {type(error).__name__}: {error}".replace("\n", " "))
        else:
            mark_built(part, settings)
            tell("done")


if __name__ == "__main__":
    main()
