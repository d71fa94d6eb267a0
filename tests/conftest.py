"""What several tests share: free addresses, whole daemons, and conditions to wait for."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from daemon.assembly import Daemon
from daemon.settings import Settings
from tests.harness.daemon_process import Running
from tests.harness.loop import Make


@pytest.fixture
def context() -> Iterator[zmq.Context[zmq.Socket[bytes]]]:
    """A ZeroMQ context that drops what was not sent when the test ends."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield context
    context.destroy(linger=0)


@pytest.fixture
def addresses() -> tuple[str, str]:
    """Two free TCP addresses on the loopback: stream and commands."""
    with socket.socket() as first, socket.socket() as second:
        for each in (first, second):
            each.bind(("127.0.0.1", 0))
        return tuple(f"tcp://127.0.0.1:{each.getsockname()[1]}" for each in (first, second))


@pytest.fixture
def profile(tmp_path: Path, addresses: tuple[str, str]) -> Callable[[str], Path]:
    """Writes a profile on free addresses, with ``text`` added to it."""

    def write(text: str = "", name: str = "profile.toml") -> Path:
        path = tmp_path / name
        stream, commands = addresses
        path.write_text(
            f'stream.address = "{stream}"\ncommands.address = "{commands}"\n{text}',
            encoding="utf-8",
        )
        return path

    return write


@pytest.fixture
def start() -> Iterator[Callable[..., Running]]:
    started: list[Running] = []

    def run(*words: str) -> Running:
        started.append(Running(*words))
        return started[-1]

    yield run
    for each in started:
        if each.process.poll() is None:
            each.process.kill()
        each.process.wait()
        assert each.process.stderr is not None
        each.process.stderr.close()


def until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Call ``condition`` until it holds; fail when it does not in time."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not within {seconds:g} s: {condition}")
        select.select([], [], [], 0.002)  # leaves the processor to what is waited for


@pytest.fixture
def make() -> Iterator[Make]:
    """Daemons on virtual time without sockets; sections are given as keyword arguments."""
    daemons = []

    def build(**sections: Any) -> Daemon:
        loop = {"clock": "virtual"} | sections.pop("loop", {})
        settings = Settings.model_validate({"loop": loop, **sections})
        daemon = Daemon(settings, wire=False)
        daemons.append(daemon)
        daemon.loop.advance(0.3)
        return daemon

    yield build
    for daemon in daemons:
        daemon.close()
