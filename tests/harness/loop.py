"""Run a complete daemon in virtual time, without sockets, and simulate late wake-ups."""

from collections.abc import Callable
from typing import Any

import pytest

from softfinger.daemon.clock import VirtualClock
from softfinger.daemon.errors import Refused
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.publishing import parts
from softfinger.daemon.types import Event, Frame
from softfinger.daemon.wire.schema import STATE
from softfinger.tools.simulated_daemon import SimulatedDaemon
from tests.harness.golden_wire import message_maker

Make = Callable[..., Daemon]
_message = message_maker(STATE)


def state_message(daemon: Daemon) -> dict[str, Any]:
    """Return the ``hand/state`` message of the current tick."""
    return _message(daemon.loop.state, parts(daemon.settings))


class LateMachine(VirtualClock):
    """Test clock that replaces the real clock. Only `work` and sleeps advance the time.

    ``late_by`` holds the delays of the next wake-ups [s].
    """

    pauses_when_late = False

    def __init__(self, start: float = 0.0) -> None:
        super().__init__(start)
        self.late_by: list[float] = []

    def work(self, seconds: float) -> None:
        """Advance the clock by the duration of some work."""
        self._now += seconds

    def sleep_until(self, t: float) -> float:
        late = self.late_by.pop(0) if self.late_by else 0.0
        super().sleep_until(t + late)
        return late


def command(daemon: Daemon, name: str, **numbers: float) -> dict[str, Any]:
    return daemon.loop.command({"command": name, **numbers})


def torque_of(daemon: Daemon) -> Any:
    """Return the torque state of each servo in the plant."""
    return daemon.hand.torque_on


def run_until(
    hand: Daemon | SimulatedDaemon,
    condition: Callable[[], object],
    seconds: float = 5.0,
    step: float = 0.01,
) -> None:
    """Advance in steps of ``step`` [s] until ``condition`` is true.

    Fail if this takes longer than ``seconds`` of virtual time.
    """
    for _ in range(round(seconds / step)):
        if condition():
            return
        hand.loop.advance(step)
    assert condition(), f"not within {seconds:g} s; the mode is {hand.loop.state.mode}"


def advance_to(daemon: Daemon | SimulatedDaemon, mode: str, seconds: float) -> None:
    """Advance until the hand is in ``mode``; fail if this takes longer than ``seconds``."""
    run_until(daemon, lambda: daemon.loop.state.mode == mode, seconds)


def armed(daemon: Daemon) -> Daemon:
    command(daemon, "arm")
    daemon.loop.advance(0.1)
    return daemon


def grasped(daemon: Daemon, force: float) -> Daemon:
    command(armed(daemon), "grasp", force=force)
    advance_to(daemon, "holding", 3.0)
    return daemon


def refusal(daemon: Daemon, name: str, **numbers: float) -> str:
    with pytest.raises(Refused) as caught:
        command(daemon, name, **numbers)
    return str(caught.value)


def heard(daemon: Daemon) -> list[Event]:
    """Return a list to which all later events of the daemon are appended."""
    events: list[Event] = []
    daemon.loop._on_event = lambda *event: events.append(event)
    return events


def change_frames(daemon: Daemon, finger: int, change: Callable[[Frame], Frame | None]) -> None:
    """Replace each later frame of one sensor with the result of ``change``."""
    sensor = daemon.loop.perception.fingers[finger].sensor
    really, last = sensor.latest, [None, None]

    def latest() -> Frame | None:
        frame = really()
        if frame is not last[0] and frame is not None:
            last[:] = frame, change(frame)
        return last[1]

    sensor.latest = latest


def silence(daemon: Daemon) -> None:
    """Suppress all later frames of both sensors."""
    for perception in daemon.loop.perception.fingers:
        perception.sensor.latest = lambda kept=perception.frame: kept
