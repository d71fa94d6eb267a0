"""Define shared fixtures, such as servo buses, connected backends and a daemon."""

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
    """Return a function that starts a bus, which runs until the test ends."""
    with ExitStack() as stack:
        yield lambda *bus, **options: stack.enter_context(closing(RunningBus(*bus, **options)))


@pytest.fixture
def bus(running: Run) -> RunningBus:
    """Return a running bus with the servos of the settings."""
    return running()


@pytest.fixture
def connect(running: Run) -> Iterator[Connect]:
    """Return a function that connects backends; each backend is closed before its bus."""
    with ExitStack() as stack:
        yield lambda bus, **servos: stack.enter_context(closing(connected(bus, **servos)))


@pytest.fixture
def fake() -> Iterator[FakeDaemon]:
    """Return a fake daemon that publishes computed states on real sockets."""
    with FakeDaemon() as fake:
        yield fake


class Shared(NamedTuple):
    """Daemon that several tests share; each test leaves the daemon disarmed."""

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
    """Return the module's daemon; after the test, disarm the hand and clear any fault."""
    yield shared
    assert ask(shared.commands, "stop")["ok"]
    ask(shared.commands, "clear")  # The daemon refuses `clear` if there is no fault.
    assert ask(shared.commands, "status")["mode"] == "disarmed"
