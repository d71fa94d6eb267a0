"""Run sweeps of independent cases on several processors or a Dask cluster, and show the progress.

The cases are independent, so the results are bit-identical for any number of workers. If a worker
dies, its cases are run again. With a journal, an interrupted sweep resumes after the completed
cases.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from softfinger.daemon.errors import SoftfingerError
from softfinger.daemon.own_files import open_regular, write_text
from softfinger.tools.arguments import number
from softfinger.tools.extras import require

Case = TypeVar("Case")
Result = TypeVar("Result")
Submit = Callable[..., Any]  # starts a function call in a worker, and returns its future
Completed = Callable[..., Iterator[Any]]  # yields futures as soon as they have completed

# In a checkout, the last three folders are links. These folders must be listed, because a search of
# the first folder does not follow links.
_SOURCES = tuple(Path(__file__).parents[1] / n for n in ("", "daemon", "kinematics", "tools"))
_CONNECT_TIMEOUT = 10.0  # time limit for connecting to the scheduler [s]
_REDRAW_INTERVAL = 0.1  # time between two updates of a progress bar [s]
_BAR_WIDTH = 20  # columns


class SweepError(SoftfingerError):
    """Error raised if a sweep cannot continue; the message gives the reason."""


class Progress:
    """Progress bar on stderr: ``with Progress("analyse", total) as progress: progress(done)``."""

    def __init__(self, what: str, total: int, on: bool = True) -> None:
        self._what = what
        self._total = max(total, 1)
        self._shown = -1.0
        self.on = on and sys.stderr.isatty()

    def __call__(self, done: int, note: str = "") -> None:
        """Show ``done`` as the completed amount. A ``note`` replaces the percentage."""
        if not self.on or time.monotonic() - self._shown < _REDRAW_INTERVAL:
            return
        self._shown = time.monotonic()
        fraction = min(done / self._total, 1.0)
        full = round(fraction * _BAR_WIDTH)
        bar = "█" * full + "·" * (_BAR_WIDTH - full)
        line = f"{self._what} {bar} {note or f'{fraction:4.0%}'}"
        columns = shutil.get_terminal_size().columns
        print(f"\r{line[: columns - 1]}\x1b[K", end="", file=sys.stderr, flush=True)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.on:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)


def processors() -> int:
    """Return the number of processors available to this process."""
    mine = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))
    return len(mine(0))


def add_sweep(parser: argparse.ArgumentParser) -> None:
    """Add ``--processes`` and ``--scheduler``."""
    parser.add_argument(
        "--processes",
        type=number("1 to 1024 processes", 0, 1024, kind=int),
        metavar="N",
        help="run the cases in N processes (default: one per processor)",
    )
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run the cases on a Dask cluster, e.g. tcp://HOST:8786 (extra 'cluster')",
    )


class Sweep(Generic[Case, Result]):
    """Run ``work`` once for each of ``cases``; iteration yields the results in the same order.

    ``work``, cases and results must be picklable. With a ``journal``, results must also be
    JSON-serialisable; the caller removes the journal after storing the results. ``name`` labels the
    progress bar.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[Case], Result],
        cases: Sequence[Case],
        journal: Path | None = None,
    ) -> None:
        self._name, self._work, self._cases, self._journal = name, work, cases, journal
        self._results: dict[int, Result] = {}

    def run(self, processes: int | None = None, scheduler: str | None = None) -> Iterator[Result]:
        """Run the sweep and yield each result as soon as possible, in the order of the cases.

        Raises SweepError if the scheduler does not respond, workers die repeatedly, or the journal
        belongs to another sweep. Raises MissingExtra if Dask is required but not installed.
        """
        self._take_up()
        processes = processes or processors()
        with Progress(self._name, len(self._cases)) as progress:
            began, before, yielded = time.monotonic(), len(self._results), 0
            for done in self._done(processes, scheduler):
                each = (time.monotonic() - began) / max(done - before, 1)
                left = timedelta(seconds=round((len(self._cases) - done) * each))
                progress(done, f"{done}/{len(self._cases)}, {left} left")
                while yielded in self._results:
                    yield self._results[yielded]
                    yielded += 1

    def _done(self, processes: int, scheduler: str | None) -> Iterator[int]:
        """Run the remaining cases and yield the number of completed cases."""
        yield len(self._results)
        if scheduler is None and processes == 1:
            for k in self._left():
                self._keep(k, self._work(self._cases[k]))
                yield len(self._results)
        before, workers = -1, processes
        while self._left():
            try:
                chosen = _pool(workers) if scheduler is None else _cluster(scheduler)
                with chosen as (submit, completed):
                    yield from self._by(submit, completed)
            except BrokenProcessPool:
                if len(self._results) > before:
                    before, workers = len(self._results), processes
                elif workers > 1:
                    # Run one case at a time to identify the case that crashes a worker.
                    workers = 1
                else:
                    case = self._cases[self._left()[0]]
                    raise SweepError(
                        f"{self._name}: all worker processes exited during {case}"
                    ) from None

    def _by(self, submit: Submit, completed: Completed) -> Iterator[int]:
        futures = {submit(self._work, self._cases[k]): k for k in self._left()}
        for future in completed(futures):
            self._keep(futures[future], future.result())
            yield len(self._results)

    def _left(self) -> list[int]:
        return [k for k in range(len(self._cases)) if k not in self._results]

    def _keep(self, k: int, result: Result) -> None:
        self._results[k] = result
        if self._journal is not None:
            with write_text(self._journal, append=True) as file:
                file.write(json.dumps([k, result]) + "\n")

    def _take_up(self) -> None:
        """Read the journal from an interrupted sweep, or start a new journal."""
        if self._journal is None:
            return
        digest = _digest_of(self._work, self._cases)
        if not self._journal.exists():
            with write_text(self._journal) as file:
                file.write(json.dumps(digest) + "\n")
            return
        with open_regular(self._journal) as journal:
            lines = journal.read().decode("utf-8", "replace").splitlines()
        if not lines or lines[0] != json.dumps(digest):
            raise SweepError(
                f"{self._journal}: belongs to another sweep or to another version of softfinger; "
                "remove the file or choose another file"
            )
        for line in lines[1:]:
            try:
                k, result = json.loads(line)
            except ValueError:
                break  # The last line is incomplete.
            self._results[int(k)] = result


def _digest_of(work: object, cases: Sequence[object]) -> str:
    """Return a digest of the sweep and of all source files; the journal stores the digest."""
    state = hashlib.sha256(pickle.dumps((work, list(cases))))
    for folder in _SOURCES:
        for file in sorted(folder.rglob("*.py")):
            state.update(file.read_bytes())
    return state.hexdigest()


def _prepare_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Only the parent process handles Ctrl-C.
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """Exit as soon as the parent process has exited, even if it was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def _pool(processes: int) -> Iterator[tuple[Submit, Completed]]:
    executor = ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_prepare_worker,
    )
    try:
        yield executor.submit, as_completed
    finally:
        executor.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _cluster(address: str) -> Iterator[tuple[Submit, Completed]]:
    require("cluster")
    import distributed

    dask: Any = distributed
    try:
        client = dask.Client(address, timeout=_CONNECT_TIMEOUT)
    except (OSError, ValueError) as error:
        raise SweepError(f"--scheduler {address}: no Dask scheduler responds: {error}") from None
    # The executor of Dask fails if a worker dies after a case and before its result is fetched.
    with client:
        yield partial(client.submit, pure=False), dask.as_completed
