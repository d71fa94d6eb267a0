"""Provide shared fixtures: servo buses, connected backends, a daemon and a fake daemon."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import NamedTuple

import pytest

from softfinger.daemon.servos.dynamixel import DynamixelServos
from tests.conftest import own_addresses, write_profile
from tests.harness.daemon_process import Running, ask
from tests.harness.fake_daemon import FakeDaemon
from tests.harness.servos import RunningBus, connected

Run = Callable[..., RunningBus]
Connect = Callable[..., DynamixelServos]


@pytest.fixture
def running() -> Iterator[Run]:
    """Return a function that runs a given bus, or the settings' servos, until the test ends."""
    with ExitStack() as stack:
        yield lambda *bus, **options: stack.enter_context(closing(RunningBus(*bus, **options)))


@pytest.fixture
def bus(running: Run) -> RunningBus:
    """Return a running bus with the servos defined in the settings."""
    return running()


@pytest.fixture
def connect(running: Run) -> Iterator[Connect]:
    """Return a function that connects backends; each backend is closed before its bus."""
    with ExitStack() as stack:
        yield lambda bus, **servos: stack.enter_context(closing(connected(bus, **servos)))


@pytest.fixture
def fake() -> Iterator[FakeDaemon]:
    """Return a fake daemon that has real sockets and computes its states from formulas."""
    with FakeDaemon() as fake:
        yield fake


class Shared(NamedTuple):
    """Daemon shared by several tests, each of which leaves it disarmed."""

    running: Running
    profile: Path
    addresses: tuple[str, str]  # stream address and command address

    @property
    def commands(self) -> str:
        return self.addresses[1]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Shared]:
    addresses = own_addresses()
    path = write_profile(tmp_path_factory.mktemp("shared") / "profile.toml", addresses)
    running = Running("--config", str(path))
    yield Shared(running, path, addresses)
    running.kill()


@pytest.fixture
def daemon(shared: Shared) -> Iterator[Shared]:
    """Return the module's daemon, disarmed and without faults before and after the test."""
    yield shared
    assert ask(shared.commands, "stop")["ok"]
    ask(shared.commands, "clear")  # The daemon refuses `clear` if there is no fault.
    assert ask(shared.commands, "status")["mode"] == "disarmed"
