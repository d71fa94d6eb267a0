"""Compiles the kernels of a scene that are not in the cache yet, in processes on all cores.

The daemon then only loads them and stays small. Each process takes one part of the pipeline after
another (`loop.warm_up`); parts that need the contact table wait for it.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

from softfinger.daemon.loop.warm_up import Part, WantedScene, is_built, mark_built, named, parts
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.compiled.kernel import why_plain
from softfinger.kinematics.compiled.kernel_folder import kernel_folder, remove_damaged
from softfinger.tools.sweep import processors
from softfinger.tools.terminal.progress import Progress

Tell = Callable[[str, str, str], None]

_ROOT = Path(__file__).parents[3]
_MEMORY = 400e6  # bytes that a process needs at most
_LOOK = 0.2  # s between two looks at the time


class Built(NamedTuple):
    """The result: how many parts were missing, and whether one could not be built."""

    parts: int
    failed: bool


def print_event(_level: str, _kind: str, text: str) -> None:
    """Print an event on standard error, for tools without a log."""
    print(text, file=sys.stderr, flush=True)


def build_kernels(
    settings: Settings, tell: Tell, wanted: Sequence[Part] | None = None, bar: bool = True
) -> Built:
    """Build the missing parts of ``wanted``, by default of the whole scene.

    Silent and quick when none is missing. Progress is a bar on standard error if that is a
    terminal and ``bar`` allows it, else a call of ``tell`` for each part, as (level, kind, text);
    failures go to ``tell``, too. When interrupted it ends every process.
    """
    folder = kernel_folder()
    if folder is not None and (count := remove_damaged(folder)):
        text = f"{folder.path}: {count} damaged files are compiled anew"
        tell("warning", "compile", text)
    missing = [part for part in wanted or parts(settings) if not is_built(part, settings)]
    if not missing:
        return Built(0, False)
    if folder is None:
        tell("warning", "compile", "kernels are compiled in this process, for half a minute")
        return Built(0, False)
    if why_plain:
        tell("info", "compile", f"compiled by Numba alone, in twice the time: {why_plain}")
    names = ", ".join(part.name for part in missing)
    tell("info", "compile", f"compiling kernels, on the first start only: {names}")
    started = time.monotonic()
    build = _Build(settings, missing, tell, Progress("compiling kernels", _kernels(missing), bar))
    build.run()
    if not build.failed:
        tell("info", "compile", f"compiled in {time.monotonic() - started:.1f} s")
    return Built(len(missing), build.failed)


def _kernels(missing: list[Part]) -> int:
    return sum(part.kernels for part in missing)


def _jobs(missing: list[Part]) -> int:
    """Return the number of processes for cores, kernel groups and memory."""
    return max(1, min(processors(), len(missing), int(_available() / _MEMORY)))


def _available() -> float:
    """Memory that may be taken without swapping [bytes]; infinite where Linux doesn't tell."""
    try:
        _, _, rest = Path("/proc/meminfo").read_text().partition("MemAvailable:")
    except OSError:
        return math.inf
    return 1024.0 * float(rest.split()[0])


class _Build:
    """The parts that are left, and a thread for each process that builds some of them."""

    def __init__(self, settings: Settings, missing: list[Part], tell: Tell, bar: Progress) -> None:
        self._head = f"{settings.model_dump_json()}\n"
        self._waiting = list(missing)
        self._under_way: dict[Part, str] = {}  # and the kernel at work
        self._changed = threading.Condition()
        self._total, self._begun = _kernels(missing), 0
        self._started = time.monotonic()
        self._bar, self._tell = bar, tell
        self._processes: list[subprocess.Popen[str]] = []
        self._reasons: set[str] = set()  # told: wrong settings fail every part alike
        self._over = False

    @property
    def failed(self) -> bool:
        return bool(self._reasons)

    def run(self) -> None:
        """Build all parts; when interrupted, end every process."""
        threads = []
        try:
            for _ in range(_jobs(self._waiting)):
                self._processes.append(_start())
                threads.append(threading.Thread(target=self._work, args=self._processes[-1:]))
                threads[-1].start()
            with self._bar as show:
                while alive := [each for each in threads if each.is_alive()]:
                    alive[0].join(_LOOK)
                    at = "; ".join(f"{part.name}: {k}" for part, k in list(self._under_way.items()))
                    show(self._begun, f"{self._so_far()}: {at}")
            for part in self._waiting:
                self._fail(part, "no process is left to build it")
        finally:
            self._over = True
            for process in self._processes:
                process.kill()
            for thread in threads:
                if thread.is_alive():  # the last one never is where Ctrl-C came before its start
                    thread.join()

    def _so_far(self) -> str:
        return (
            f"{min(self._begun, self._total)} of about {self._total}, "
            f"{time.monotonic() - self._started:.0f} s"
        )

    def _work(self, process: subprocess.Popen[str]) -> None:
        """Hand parts to a process until none is left, or it has ended."""
        assert process.stdin is not None
        assert process.stdout is not None
        part = None
        try:
            process.stdin.write(self._head)
            while part := self._next():
                process.stdin.write(f"{part.name}\n")
                process.stdin.flush()
                self._follow(part, process.stdout)
        except BrokenPipeError:
            pass
        process.kill()
        status = process.wait()
        if part is not None:
            self._done(part, f"its process ended with status {status}")
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        process.stdout.close()

    def _next(self) -> Part | None:
        """The next part that need not wait for one that is waiting or under way; None: no more."""
        with self._changed:
            while self._waiting:
                names = {part.name for part in (*self._waiting, *self._under_way)}
                free = [part for part in self._waiting if part.after not in names]
                if free:
                    self._waiting.remove(free[0])
                    self._under_way[free[0]] = ""
                    return free[0]
                self._changed.wait()
        return None

    def _follow(self, part: Part, output: IO[str]) -> None:
        """Read what a process says of a part, until it is built. Raises BrokenPipeError."""
        for line in output:
            word, _, rest = line.rstrip("\n").partition(" ")
            if word == "kernel":
                self._begun += 1
                self._under_way[part] = rest
            else:
                return self._done(part, rest if word == "failed" else "")
        raise BrokenPipeError

    def _done(self, part: Part, failure: str) -> None:
        with self._changed:
            del self._under_way[part]
            self._changed.notify_all()
        if failure:
            self._fail(part, failure)
        elif not self._bar.on:
            self._tell("info", "compile", f"{part.name}: {self._so_far()}")

    def _fail(self, part: Part, reason: str) -> None:
        with self._changed:
            if self._over or reason in self._reasons:  # interrupted, or told
                return
            self._reasons.add(reason)
        self._tell("warning", "compile", f"{part.name} was not compiled ahead: {reason}")


def _start() -> subprocess.Popen[str]:
    """A process that runs `main`."""
    # -P: a folder named tools where this was started is not ours.
    command = [sys.executable, "-P", "-m", "softfinger.tools.processes.kernel_build"]
    path = os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": path},
        text=True,
        process_group=0,  # Ctrl-C is for this process, which ends it
    )


def main() -> None:
    """Compile kernels, a part of a scene at a time, until standard input ends.

    Standard input: the settings in JSON, then the name of a part a line. Standard output, a line
    each: ``kernel NAME`` as one is begun, ``done`` when a part is built, ``failed REASON`` when it
    can't be.
    """
    gc.set_threshold(100_000)  # the compiler makes much that lives: looking through it costs 10 %
    out = sys.stdout
    sys.stdout = sys.stderr  # whatever else prints, prints there

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
