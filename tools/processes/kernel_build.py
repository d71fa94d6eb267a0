"""Compiles the kernels of a scene that are not in the cache yet, in processes on all cores.

The daemon then only loads them and stays small. Each process takes one part of the pipeline after
another (`loop.warm_up`); parts that need the contact table wait for it.
"""

from __future__ import annotations

import gc
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from softfinger.daemon.loop.warm_up import Part, WantedScene, is_built, mark_built, named, parts
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.compiled.kernel_folder import kernel_folder, user_cache
from softfinger.tools.terminal.progress import Progress

Tell = Callable[[str, str, str], None]

_ROOT = Path(__file__).parents[3]
_MEMORY = 400e6  # bytes that a process needs at most
_LOOK = 0.2  # s between two looks at the time


def table_cache() -> Path | None:
    """The folder of built contact tables; None without a home folder."""
    try:
        return user_cache()
    except RuntimeError:
        return None


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
    missing = [part for part in wanted or parts(settings) if not is_built(part, settings)]
    if not missing:
        return Built(0, False)
    if kernel_folder() is None:
        tell("warning", "compile", "kernels are compiled in this process, for half a minute")
        return Built(0, False)
    names = ", ".join(part.name for part in missing)
    tell("info", "compile", f"compiling kernels, on the first start only: {names}")
    started = time.monotonic()
    workers = _Workers(settings, missing, tell, bar)
    try:
        workers.work()
    finally:
        workers.close()
    if not workers.failed:
        tell("info", "compile", f"compiled in {time.monotonic() - started:.1f} s")
    return Built(len(missing), workers.failed)


def _jobs(missing: list[Part]) -> int:
    """As many processes as there are cores, parts, and memory for."""
    cores = len(os.sched_getaffinity(0))
    return max(1, min(cores, len(missing), int(_available() / _MEMORY)))


def _available() -> float:
    """Memory that may be taken without swapping [bytes]."""
    _, _, rest = Path("/proc/meminfo").read_text().partition("MemAvailable:")
    return 1024.0 * float(rest.split()[0])


class _Workers:
    """The processes and the parts that are left."""

    def __init__(self, settings: Settings, missing: list[Part], tell: Tell, bar: bool) -> None:
        self._waiting = list(missing)
        self._total = sum(part.kernels for part in missing)
        self._begun = 0  # kernels
        self._started = time.monotonic()
        self._bar = Progress("compiling kernels", self._total, bar)
        self._tell = tell
        self.failed = False
        self._workers: dict[int, _Worker] = {}  # by the file that it is read from
        self._selector = selectors.DefaultSelector()
        try:
            for _ in range(_jobs(missing)):
                worker = _Worker(settings)
                self._workers[worker.output] = worker
                self._selector.register(worker.output, selectors.EVENT_READ)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        for worker in self._workers.values():
            worker.close()
        self._selector.close()

    def work(self) -> None:
        """Hand out parts until all are built, or no process is left to build them."""
        with self._bar as show:
            while self._hand_out():
                for key, _ in self._selector.select(_LOOK):
                    worker = self._workers[key.fd]
                    lines = worker.read()
                    if lines is None:
                        self._lost(worker)
                    else:
                        for line in lines:
                            self._take(worker, line)
                at = "; ".join(filter(None, (each.at for each in self._workers.values())))
                show(self._begun, f"{self._so_far()}: {at}")

    def _so_far(self) -> str:
        return (
            f"{min(self._begun, self._total)} of about {self._total}, "
            f"{time.monotonic() - self._started:.0f} s"
        )

    def _hand_out(self) -> bool:
        """Give each idle process the next part that need not wait; False when none has one."""
        for worker in self._workers.values():
            if worker.part is not None:
                continue
            under_way = {each.part.name for each in self._workers.values() if each.part}
            under_way.update(part.name for part in self._waiting)
            free = [part for part in self._waiting if part.after not in under_way]
            if free:
                self._waiting.remove(free[0])
                worker.build(free[0])
        return any(worker.part is not None for worker in self._workers.values())

    def _take(self, worker: _Worker, line: str) -> None:
        word, _, rest = line.partition(" ")
        if word == "kernel":
            self._begun += 1
            worker.kernel = rest
        elif word in ("done", "failed") and worker.part is not None:
            if word == "failed":
                self._fail(worker.part, rest)
            elif not self._bar.on:
                self._tell("info", "compile", f"{worker.part.name}: {self._so_far()}")
            worker.part = None

    def _lost(self, worker: _Worker) -> None:
        self._selector.unregister(worker.output)
        status = worker.close()
        del self._workers[worker.output]
        if worker.part is not None:
            self._fail(worker.part, f"its process ended with status {status}")

    def _fail(self, part: Part, reason: str) -> None:
        self.failed = True
        self._tell("warning", "compile", f"{part.name} was not compiled ahead: {reason}")


class _Worker:
    """One process, which runs `main`."""

    def __init__(self, settings: Settings) -> None:
        # -P: a folder named tools where this was started is not ours.
        command = [sys.executable, "-P", "-m", "softfinger.tools.processes.kernel_build"]
        path = os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": path},
            process_group=0,  # Ctrl-C is for this process, which ends it
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        self.output = self._output.fileno()
        self.part: Part | None = None
        self.kernel = ""
        self._rest = b""
        self._send(f"{settings.model_dump_json()}\n{table_cache() or ''}\n")

    @property
    def at(self) -> str:
        """Part and kernel that it is compiling."""
        return "" if self.part is None else f"{self.part.name}: {self.kernel}"

    def build(self, part: Part) -> None:
        self.part, self.kernel = part, ""
        self._send(f"{part.name}\n")

    def _send(self, text: str) -> None:
        try:
            self._input.write(text.encode())
            self._input.flush()
        except BrokenPipeError:
            pass  # it has died, which `read` finds

    def read(self) -> list[str] | None:
        """The lines that have come; None when it has ended."""
        data = os.read(self.output, 65536)
        if not data:
            return None
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [line.decode() for line in lines]

    def close(self) -> int:
        """End it; its exit status."""
        self._process.kill()
        status = self._process.wait()
        try:
            self._input.close()
        except BrokenPipeError:
            pass
        self._output.close()
        return status


def main() -> None:
    """A process that compiles kernels, a part of a scene at a time, until standard input ends.

    Standard input: the settings in JSON, the folder of contact tables (empty: none), then the name
    of a part a line. Standard output, a line each: ``kernel NAME`` as one is begun, ``done`` when a
    part is built, ``failed REASON`` when it can't be.
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
    cache = sys.stdin.readline().rstrip("\n")
    scene = WantedScene(settings, Path(cache) if cache else None)
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
