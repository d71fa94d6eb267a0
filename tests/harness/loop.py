"""A whole daemon on the virtual clock, without sockets, and what tests do with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon

Make = Callable[..., Daemon]


def command(daemon: Daemon, name: str, **numbers: float) -> dict[str, Any]:
    return daemon.loop.command({"command": name, **numbers})


def torque_of(daemon: Daemon) -> Any:
    """Whether the plant's servos have torque, each."""
    assert daemon.hand is not None
    return daemon.hand.torque_on


def advance_to(daemon: Daemon, mode: str, seconds: float) -> None:
    """Advance until the hand is in ``mode``; fail when it is not within ``seconds``."""
    finish = daemon.clock.now() + seconds
    while daemon.loop.state.mode != mode:
        assert daemon.clock.now() < finish, f"{daemon.loop.state.mode}, not {mode}"
        daemon.loop.advance(0.01)


def grasped(daemon: Daemon, force: float) -> Daemon:
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    command(daemon, "grasp", force=force)
    advance_to(daemon, "holding", 3.0)
    return daemon


def refusal(daemon: Daemon, name: str, **numbers: float) -> str:
    with pytest.raises(Refused) as caught:
        command(daemon, name, **numbers)
    return str(caught.value)
