"""Define fixtures shared by all tests.

Each test process has its own loopback addresses and folders, so that tests can run in parallel. All
processes that a test starts, directly or indirectly, are killed when the test ends.
"""

from __future__ import annotations

import gc
import itertools
import os
import select
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis
import pytest
import zmq

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.cli import main
from softfinger.tools.processes import compile as kernels
from tests.harness import arithmetic, descendants
from tests.harness.daemon_process import Running
from tests.harness.loop import Make
from tests.harness.perturbed import Perturbation

# Run the same Hypothesis examples on all machines, without a deadline. Use
# --hypothesis-profile=search to try other examples.
hypothesis.settings.register_profile("same", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.register_profile("search", deadline=None, max_examples=1000)
hypothesis.settings.load_profile("same")

_PORTS = itertools.count(9872)
_OUR_OWN: set[int] = set()  # child processes that no test started
PERTURBATION = pytest.StashKey[Perturbation]()
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the ``--perturb`` option, which enables `tests.harness.perturbed`."""
    help_text = "move results by a unit in the last place, to find tests that depend on rounding"
    parser.addoption("--perturb", type=int, metavar="SEED", help=help_text)


def pytest_report_header() -> str:
    """Show the floating-point environment in pytest's header, to help diagnose failures."""
    return f"arithmetic: {arithmetic.described()}"


def pytest_configure(config: pytest.Config) -> None:
    """Treat SIGTERM like Ctrl-C, and adopt orphaned processes that tests started."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    descendants.adopt_orphans()
    # Start the resource tracker here, because a tracker started by a test would be killed with that
    # test.
    resource_tracker.ensure_running()
    _OUR_OWN.update(descendants.running())
    if not hasattr(config, "workerinput"):
        descendants.end_with_this_process()
    seed = config.getoption("--perturb")
    if seed is not None:
        config.stash[PERTURBATION] = Perturbation(seed)
        config.stash[PERTURBATION].start()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip each extended test unless ``-m`` or the test's file is given on the command line.

    Start the tests that mostly wait first, so that other tests run during the waits.
    """
    if not config.option.markexpr:
        named = {Path(each.partition("::")[0]).resolve() for each in config.args}
        left_out = {
            item for item in items if item.get_closest_marker("extended") and item.path not in named
        }
        config.hook.pytest_deselected(items=list(left_out))
        items[:] = [item for item in items if item not in left_out]
    items.sort(key=lambda item: item.get_closest_marker("waits") is None)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Exclude the million objects of imported modules from garbage collection."""
    if session.config.stash.get(PERTURBATION, None) is not None:
        session.config.stash[PERTURBATION].enter_modules()
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    """Kill the adopted processes that a crashed test process left behind."""
    descendants.end(descendants.running() - _OUR_OWN)


@pytest.fixture(autouse=True)
def ended_with_the_test() -> Iterator[None]:
    """Kill the test's processes, restore signal handlers and re-enable garbage collection."""
    before = descendants.running()
    handlers = {each: signal.getsignal(each) for each in _SIGNALS}
    yield
    for each, handler in handlers.items():
        signal.signal(each, handler)
    gc.enable()  # Daemons in this process disable the garbage collector.
    descendants.end(descendants.running() - before)


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    """Yield a ZeroMQ context whose sockets drop unsent messages when they are closed."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    context.linger = 0
    yield context
    context.destroy()


def own_addresses() -> tuple[str, str]:
    """Return two unused TCP addresses, one for the stream and one for commands.

    The loopback host is derived from the process ID, and each call uses new ports.
    """
    number = os.getpid()
    host = f"127.{64 + (number >> 16)}.{number >> 8 & 255}.{number & 255}"
    return f"tcp://{host}:{next(_PORTS)}", f"tcp://{host}:{next(_PORTS)}"


@pytest.fixture
def addresses() -> tuple[str, str]:
    """Return TCP addresses that only this test uses."""
    return own_addresses()


def write_profile(path: Path, addresses: tuple[str, str], text: str = "") -> Path:
    """Write a profile that contains ``addresses`` and ``text``.

    The default loop rate is only 100 Hz, because tests run several daemons in parallel.
    """
    stream, commands = addresses
    rate = "" if "loop.rate" in text else "loop.rate = 100.0\n"
    head = f'stream.address = "{stream}"\ncommands.address = "{commands}"\n'
    path.write_text(head + rate + text, encoding="utf-8")
    return path


@pytest.fixture
def profile(tmp_path: Path, addresses: tuple[str, str]) -> Profile:
    """Return a function that writes a profile with the test's addresses and additional text."""
    return lambda text="", name="profile.toml": write_profile(tmp_path / name, addresses, text)


@pytest.fixture
def start() -> Iterator[Start]:
    """Return a function that starts daemons, which are killed when the test ends."""

    def run(*words: str) -> Running:
        running = Running(*words)
        stack.callback(running.kill)
        return running

    with ExitStack() as stack:
        yield run


class Told(NamedTuple):
    """Result of a subcommand: exit status, standard output and standard error."""

    returncode: int
    stdout: str
    stderr: str


Inline = Callable[..., Told]
Addresses = tuple[str, str]
Profile = Callable[..., Path]
Start = Callable[..., Running]


@pytest.fixture
def inline(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Inline:
    """Return a function that runs a subcommand in the test process."""
    monkeypatch.setattr(os, "nice", lambda _: 0)  # Keep the priority of the test process.
    # Suppress the compilation messages that appear only in the first test on a machine.
    monkeypatch.setattr(kernels, "print_event", lambda *_: None)

    def run(*words: object) -> Told:
        capsys.readouterr()
        try:
            status = main(list(map(str, words)))
        except SystemExit as ended:  # argparse raises this exception.
            status = int(ended.code or 0)
        return Told(status, *capsys.readouterr())

    return run


def until(condition: Callable[[], object], seconds: float = 150.0) -> None:
    """Poll ``condition`` until it is true; raise TimeoutError after ``seconds``."""
    begin = time.monotonic()
    while not condition():
        waited = time.monotonic() - begin
        if waited > seconds:
            raise TimeoutError(f"not within {seconds:g} s: {condition}")
        # Sleep, so that the awaited process can use the processor.
        select.select([], [], [], min(0.002 + 0.01 * waited, 0.02))


@pytest.fixture
def make() -> Iterator[Make]:
    """Return a function that builds daemons in virtual time, without sockets.

    Each keyword argument is a section of the settings.
    """

    def build(**sections: Any) -> Daemon:
        loop = {"clock": "virtual"} | sections.pop("loop", {})
        settings = Settings.model_validate({"loop": loop, **sections})
        daemon = stack.enter_context(Daemon(settings, wire=False))
        daemon.loop.advance(0.3)
        return daemon

    with ExitStack() as stack:
        yield build


@pytest.fixture
def exact_solid_data(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set the errors of the solid-tip data to zero, because tests simulate frames from the data."""
    from softfinger.kinematics.estimation import error_budget, estimator

    data = estimator.solid_data
    monkeypatch.setattr(
        estimator, "solid_data", lambda tip: replace(data(tip), error=0.0, pressure_error=0.0)
    )
    monkeypatch.setattr(error_budget, "_SOLID_TILT_ERROR", 0.0)
