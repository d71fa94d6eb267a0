"""What several tests share: addresses of their own, whole daemons, and conditions to wait for.

Each test process has its own loopback addresses and folders, so that several run beside each
other; whatever a test started, in this process or below it, ends with the test.
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

# The same examples on every machine, however slow; --hypothesis-profile=search looks for others.
hypothesis.settings.register_profile("same", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.register_profile("search", deadline=None, max_examples=1000)
hypothesis.settings.load_profile("same")

_PORTS = itertools.count(9872)
_OUR_OWN: set[int] = set()  # processes that no test started
PERTURBATION = pytest.StashKey[Perturbation]()
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option of `tests.harness.perturbed`."""
    help_text = "move results by a unit in the last place, to find tests that depend on rounding"
    parser.addoption("--perturb", type=int, metavar="SEED", help=help_text)


def pytest_report_header() -> str:
    """The arithmetic, for whoever reads of a test that failed on one machine alone."""
    return f"arithmetic: {arithmetic.described()}"


def pytest_configure(config: pytest.Config) -> None:
    """End as on Ctrl-C when asked to; orphans of what tests started come to this process."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    descendants.adopt_orphans()
    resource_tracker.ensure_running()  # not by a test: with its end the semaphores' names were lost
    _OUR_OWN.update(descendants.running())
    if not hasattr(config, "workerinput"):
        descendants.end_with_this_process()
    seed = config.getoption("--perturb")
    if seed is not None:
        config.stash[PERTURBATION] = Perturbation(seed)
        config.stash[PERTURBATION].start()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out extended tests, unless ``-m`` selects tests or the command line names their file.

    Begin with those that wait longest, so that the others compute meanwhile.
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
    """Spare the garbage collector the million objects of all modules, which are there to stay."""
    if session.config.stash.get(PERTURBATION, None) is not None:
        session.config.stash[PERTURBATION].enter_modules()
    gc.collect()
    gc.freeze()


def pytest_unconfigure() -> None:
    """A test process that crashed leaves what it started to the one that started it."""
    descendants.end(descendants.running() - _OUR_OWN)


@pytest.fixture(autouse=True)
def ended_with_the_test() -> Iterator[None]:
    """Ends the processes that a test started and left; gives pytest Ctrl-C and collector back."""
    before = descendants.running()
    handlers = {each: signal.getsignal(each) for each in _SIGNALS}
    yield
    for each, handler in handlers.items():
        signal.signal(each, handler)
    gc.enable()  # which a daemon's command in this process has switched off
    descendants.end(descendants.running() - before)


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    """A ZeroMQ context that drops what was not sent when the test ends."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield context
    context.destroy(linger=0)


def own_addresses() -> tuple[str, str]:
    """Two TCP addresses that nobody else has: stream and commands.

    This process has a loopback host to itself, by its number, and takes new ports there each time.
    """
    number = os.getpid()
    host = f"127.{64 + (number >> 16)}.{number >> 8 & 255}.{number & 255}"
    return f"tcp://{host}:{next(_PORTS)}", f"tcp://{host}:{next(_PORTS)}"


@pytest.fixture
def addresses() -> tuple[str, str]:
    """Two TCP addresses that are this test's alone."""
    return own_addresses()


def write_profile(path: Path, addresses: tuple[str, str], text: str = "") -> Path:
    """Write a profile on these addresses, with ``text`` added to it; of 100 ticks a second, where
    it names no other rate: daemons of several tests share the processors."""
    stream, commands = addresses
    rate = "" if "loop.rate" in text else "loop.rate = 100.0\n"
    head = f'stream.address = "{stream}"\ncommands.address = "{commands}"\n'
    path.write_text(head + rate + text, encoding="utf-8")
    return path


@pytest.fixture
def profile(tmp_path: Path, addresses: tuple[str, str]) -> Profile:
    """Writes a profile on the test's addresses, with a text added to it."""
    return lambda text="", name="profile.toml": write_profile(tmp_path / name, addresses, text)


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts daemons that are killed when the test ends before them."""

    def run(*words: str) -> Running:
        running = Running(*words)
        stack.callback(running.kill)
        return running

    with ExitStack() as stack:
        yield run


class Told(NamedTuple):
    """What a subcommand left: exit status, standard output and error."""

    returncode: int
    stdout: str
    stderr: str


Inline = Callable[..., Told]
Addresses = tuple[str, str]
Profile = Callable[..., Path]
Start = Callable[..., Running]


@pytest.fixture
def inline(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Inline:
    """Runs a subcommand in this process, for tests of its work and not of its process."""
    monkeypatch.setattr(os, "nice", lambda _: 0)  # the tests' own priority stays
    # Whichever test comes first on a machine compiles, and none is about being told so.
    monkeypatch.setattr(kernels, "print_event", lambda *_: None)

    def run(*words: object) -> Told:
        capsys.readouterr()
        try:
            status = main(list(map(str, words)))
        except SystemExit as ended:  # argparse's
            status = int(ended.code or 0)
        return Told(status, *capsys.readouterr())

    return run


def until(condition: Callable[[], object], seconds: float = 150.0) -> None:
    """Call ``condition`` until it holds, less often in time; ``seconds`` only bound a hang."""
    begin = time.monotonic()
    while not condition():
        waited = time.monotonic() - begin
        if waited > seconds:
            raise TimeoutError(f"not within {seconds:g} s: {condition}")
        # Leaves the processor to what is waited for.
        select.select([], [], [], min(0.002 + 0.01 * waited, 0.02))


@pytest.fixture
def make() -> Iterator[Make]:
    """Daemons on virtual time without sockets; sections are given as keyword arguments."""

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
    """A solid tip's data have no error of their own, as for frames that are made of them."""
    from softfinger.kinematics.estimation import error_budget, estimator

    data = estimator.solid_data
    monkeypatch.setattr(
        estimator, "solid_data", lambda tip: replace(data(tip), error=0.0, pressure_error=0.0)
    )
    monkeypatch.setattr(error_budget, "_SOLID_TILT_ERROR", 0.0)
