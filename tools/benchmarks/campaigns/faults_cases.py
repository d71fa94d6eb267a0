"""The faults of the campaign: how each is brought about and ended, and what must come of it."""

from __future__ import annotations

import contextlib
import random
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import Literal

from softfinger.daemon.profile.settings import Settings
from softfinger.tools.benchmarks.campaigns import faults_pressures as pressures
from softfinger.tools.benchmarks.campaigns.faults_rig import Rig

Inject = Callable[[Rig, random.Random], AbstractContextManager[None]]
# works: it goes on gripping. fault: torque off by a fault. either: one of both. lets go: the joints
# stay where they are, without a fault. dies: the daemon is gone, the servos stop by themselves.
# stops: `stop` is sent, and no motor is driven in time, with a fault or without.
Expect = Literal["works", "fault", "either", "lets go", "dies", "stops"]

_SETTINGS = Settings()
_SILENT = _SETTINGS.servos.fault_after
_WATCHDOG = _SETTINGS.servos.watchdog + 0.02  # the servo counts in steps of 20 ms
_FRAMES = _SETTINGS.safety.frame_age_fault / 100.0 + 0.01  # of a board of 100 Hz
_FROZEN = _SETTINGS.safety.frozen_after + 0.05  # judged in turn
_AT_ONCE = 0.03
_STOP = 0.2  # s from a stop to no motor driven, whatever gets lost
_SAME = 0.3  # s in which a hand that holds may send the same goal, of which none is missed
_JUDGED = 0.1  # s: a row that is judged in turn and must stand for half of that
_SERVOS = (1, 2)
_SIDES = ("left", "right")


@dataclass(frozen=True)
class FaultCase:
    """One kind of fault, injected into a hand that grips."""

    name: str
    expect: Expect
    inject: Inject
    names: tuple[str, ...] = ()  # of the fault that may latch
    within: float = 0.0  # s in which no motor must be driven any more, where it faults
    lasts: float = 3.0  # s, at most, that it is looked at
    holding_only: bool = False  # the hand must hold; else it may be closing or turning, too


def sent(words: Callable[[random.Random], tuple[str, str]]) -> Inject:
    """Words sent to the emulated hand: those that begin the fault, and those that end it."""

    @contextlib.contextmanager
    def inject(rig: Rig, chance: random.Random) -> Iterator[None]:
        begin, end = words(chance)
        rig.send(begin)
        try:
            yield
        finally:
            if end:
                rig.send(end)

    return inject


def _reply(kind: str, share: float) -> Inject:
    return sent(lambda _: (f"{kind}={share}", "well"))


def _lost(share: float) -> Inject:
    return sent(lambda _: (f"lose={share} drop={share}", "well"))


def _servo(begin: str, end: str) -> Inject:
    def words(chance: random.Random) -> tuple[str, str]:
        servo = chance.choice(_SERVOS)
        return begin.format(servo), end.format(servo)

    return sent(words)


def _board(begin: str, end: str = "{}:well") -> Inject:
    def words(chance: random.Random) -> tuple[str, str]:
        side = chance.choice(_SIDES)
        return begin.format(side), end.format(side)

    return sent(words)


@contextlib.contextmanager
def _killed(rig: Rig, chance: random.Random) -> Iterator[None]:
    rig.end_daemon(signal.SIGKILL)
    try:
        yield
    finally:
        rig.start_daemon()


def _stood_still(seconds: float) -> Inject:
    return lambda rig, chance: pressures.stood_still(rig, seconds)


_works = partial(FaultCase, expect="works", lasts=0.3)
_silent = partial(FaultCase, expect="fault", names=("servos.silent",), within=_SILENT + _AT_ONCE)
_alert = partial(FaultCase, expect="fault", names=("servos.alert",), within=_SILENT + _AT_ONCE)
_blind = partial(FaultCase, expect="fault", names=("tactile.silent",), within=_FRAMES + _AT_ONCE)

CASES: tuple[FaultCase, ...] = (
    *(_works(f"replies dropped, {share:.0%}", inject=_reply("drop", share))
      for share in (0.01, 0.1)),
    _silent("replies dropped, 100%", inject=_reply("drop", 1.0)),
    *(_works(f"replies late, {share:.0%}", inject=_reply("late", share)) for share in (0.01, 0.1)),
    _silent("replies late, 100%", inject=_reply("late", 1.0)),
    *(_works(f"replies corrupted, {share:.0%}", inject=_reply("corrupt", share))
      for share in (0.01, 0.1)),
    _silent("replies corrupted, 100%", inject=_reply("corrupt", 1.0)),
    *(_works(f"replies truncated, {share:.0%}", inject=_reply("truncate", share))
      for share in (0.01, 0.1)),
    _silent("replies truncated, 100%", inject=_reply("truncate", 1.0)),
    *(_works(f"replies doubled, {share:.0%}", inject=_reply("duplicate", share))
      for share in (0.01, 0.1, 1.0)),
    FaultCase("one servo silent", "fault", _servo("silent={}", "answer={}"),
         ("servos.silent",), _WATCHDOG),
    _silent("one servo rebooted", inject=_servo("reboot={}", "")),
    FaultCase("one servo overheated", "fault",
         _servo("overheat={0}", "recover={0} reboot={0}"),
         ("servos.alert", "servos.temperature"), _SILENT + _AT_ONCE),
    _alert("one servo overloaded", inject=_servo("overload={0}", "recover={0} reboot={0}")),
    FaultCase("one servo without supply", "fault",
         _servo("undervoltage={0}", "recover={0} reboot={0}"),
         ("servos.alert", "servos.voltage"), _SILENT + _AT_ONCE),
    FaultCase("one servo's encoder stuck", "fault", _servo("stuck={0}", "recover={0}"),
         ("joint.dead",), 0.05 / _SETTINGS.control.approach_speed + _JUDGED),
    FaultCase("one servo's encoder jumped", "fault", _servo("jump={0}", "recover={0}"),
         ("joint.jump",), _AT_ONCE),
    FaultCase("one servo's readings frozen", "fault", _servo("frozen={0}", "recover={0}"),
         ("servos.frozen",), 0.12 + _AT_ONCE),
    _silent("one servo's readings refused", inject=_servo("refuse={0}", "recover={0}")),
    FaultCase("writes lost, 100%", "fault", sent(lambda _: ("lose-writes=1", "well")),
         ("goal.lost",), _SAME + 0.05 + _STOP),
    *(FaultCase(f"stop, {share:.0%} lost each way", "stops", _lost(share), within=_STOP)
      for share in (0.0, 0.2, 0.5, 0.8, 0.9)),
    FaultCase("stop, writes lost", "stops", sent(lambda _: ("lose-writes=1", "well")),
         within=_STOP),
    FaultCase("servos' port gone and back", "fault", sent(lambda _: ("unplug", "plug")),
         ("servos.bus",), _WATCHDOG),
    _blind("board silent", inject=_board("{}:silent")),
    FaultCase("board frozen", "fault", _board("{}:frozen"), ("tactile.frozen",), _FROZEN,
         holding_only=True),
    FaultCase("board noisy, 10%", "either", _board("{}:noisy=0.1"),
         ("tactile.silent", "tip.force", "tip.displacement", "tip.tilt", "hand.angle",
          "hand.width"), 0.5, 0.5, True),
    _blind("board noisy, 100%", inject=_board("{}:noisy=1")),
    FaultCase("board torn, 10%", "either", _board("{}:torn=0.1"), ("tactile.silent",), 0.5, 0.5),
    _blind("board torn, 100%", inject=_board("{}:torn=1")),
    _blind("board of the wrong size", inject=_board("{}:wrong-size")),
    FaultCase("board saturated", "fault", _board("{}:saturated"),
         ("tactile.silent", "tip.force", "tip.displacement"), _FRAMES + _AT_ONCE),
    FaultCase("board zero", "lets go", _board("{}:zero"), lasts=0.4, holding_only=True),
    FaultCase("board's port gone and back", "fault", _board("{}:unplug", "{}:plug"),
         ("tactile.silent",), _FRAMES + _AT_ONCE),
    FaultCase("daemon killed", "dies", _killed, within=_WATCHDOG),
    # As long as a servo's reading may be old: the first one after it decides.
    FaultCase("daemon stood still for 50 ms", "either", _stood_still(0.05), ("servos.silent",),
         _SILENT + _AT_ONCE, 0.3),
    FaultCase("daemon stood still for 2 s", "fault", _stood_still(2.0),
         ("servos.bus", "servos.silent", "tactile.silent"), _WATCHDOG, 4.0),
    _works("command flood", inject=pressures.flood),
    _works("garbage on the command socket", inject=pressures.garbage),
    _works("subscribers stuck", inject=pressures.stuck),
    _works("disk full while recording", inject=pressures.full_disk),
    _works("daemon without memory", inject=pressures.no_memory),
)  # fmt: skip
