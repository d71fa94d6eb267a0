"""The tick's cost in each kind of scene, and what each skipping step saves, from one run.

All daemons stand side by side, on canned readings and virtual time, and tick in turns. A skipping
step is switched off in a daemon of its own, from outside; what it saves is the median of the
differences to the daemon that has it, round by round, with that median's own error.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import bit
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.tools.benchmarks.framework.interleaved import Subject, interleave
from softfinger.tools.benchmarks.framework.report import Report, Row, figure
from softfinger.tools.benchmarks.framework.rigs import Sections, can, hold, virtual_daemon

_TICKS = 20  # of a call: whole periods of the frames, as of the published topics
_SURE = 3.0  # times its own error that a saving must have to be called one


@dataclass(frozen=True)
class TimedScene:
    """A daemon to tick: its settings, whether it holds, a subscribed topic, what is altered."""

    sections: Sections = field(default_factory=dict)
    holds: bool = True
    topic: str = ""
    alter: Callable[[Daemon], None] = can


ONE = {"scene": {"fingers": ("left",)}}
CONSTANT = {"material": {"law": "constant"}}
SENSORS_ONLY = {"servos": {"backend": "none"}}
SERVOS_ONLY = {"tactile": {"backend": "none"}}
IDLE, ONE_FINGER = "idle and open", "one finger, idle"
TWO, TWO_CONSTANT = (
    "two fingers holding, nobody subscribed",
    "two fingers holding, constant modulus",
)
STATE_ONLY = "two fingers holding, state subscribed"
SCENES = {
    IDLE: TimedScene(holds=False),
    ONE_FINGER: TimedScene(ONE, holds=False),
    "servos without sensors, idle": TimedScene(SERVOS_ONLY, holds=False),
    "sensors without servos, one tip touched": TimedScene(SENSORS_ONLY, holds=False),
    TWO: TimedScene(),
    TWO_CONSTANT: TimedScene(CONSTANT),
    STATE_ONLY: TimedScene(topic="hand/state"),
    "two fingers holding, all subscribed": TimedScene(topic="hand"),
}


def _every_tick_estimated(daemon: Daemon) -> None:
    can(daemon, every_tick=True)


def _always_fitted(daemon: Daemon) -> None:
    can(daemon)
    tip, noise = daemon.models[0].table.tip, daemon.settings.tactile.noise
    for finger in daemon.loop.perception.fingers:
        grid, material = finger._estimator.grid, daemon.models[finger.finger].material
        finger._estimator = ContactEstimator(tip, material, grid, noise)
        options = finger._estimator.state.options
        options.peak_level = options.patch_level = -1e9


def _always_cold(daemon: Daemon) -> None:
    can(daemon)
    for finger in daemon.loop.perception.fingers:
        estimator = finger._estimator

        def cold(*arguments: Any, e: Any = estimator, then: Any = estimator.update) -> Any:
            e.reset()
            return then(*arguments)

        estimator.update = cold  # type: ignore[assignment,method-assign]


def _always_predicted(daemon: Daemon) -> None:
    class Live(list[bool]):
        """Both tips count as touched, whatever the frames say."""

        def __setitem__(self, *_: Any) -> None: ...

    can(daemon)
    daemon.loop.perception.filter._live = Live([True, True])


def _always_packed(daemon: Daemon) -> None:
    can(daemon)
    broadcast = daemon.loop._publishing
    assert broadcast is not None
    broadcast._publisher._link.wanted = bit(schema.STATE) | bit(schema.TACTILE)


def _tabulated(daemon: Daemon) -> None:
    """The constant modulus through the form of table that other materials get."""
    can(daemon)
    model = daemon.models[0]
    table = ContactTable.build(model.table.tip, model.material, form="quintic")
    daemon.loop.perception.filter._tables = (table.data, table.data)


# A step: the scene that has it, and the same without it.
STEPS: dict[str, tuple[str, TimedScene]] = {
    "no estimate for a frame already seen": (TWO, TimedScene(alter=_every_tick_estimated)),
    "no contact, no fit": (IDLE, TimedScene(holds=False, alter=_always_fitted)),
    "the fit starts from the last contact": (TWO, TimedScene(alter=_always_cold)),
    "no contact, no prediction published": (IDLE, TimedScene(holds=False, alter=_always_predicted)),
    "closed form for a constant modulus": (TWO_CONSTANT, TimedScene(CONSTANT, alter=_tabulated)),
    "topics without subscribers are not packed": (TWO, TimedScene(alter=_always_packed)),
    "state published at 100 Hz, not each tick": (
        STATE_ONLY,
        TimedScene({"stream": {"state_rate": 500.0}}, topic="hand/state"),
    ),
    "an absent finger costs nothing": (ONE_FINGER, SCENES[IDLE]),
}


def measure(brief: bool = False, rounds: int = 1000) -> list[Report]:
    """All scenes and steps in turns."""
    scenes = SCENES | {f"without: {name}": scene for name, (_, scene) in STEPS.items()}
    with contextlib.ExitStack() as stack:
        subjects = {name: _subject(scene, stack) for name, scene in scenes.items()}
        times = interleave(subjects, 100 if brief else rounds)
    costs = [figure(name, "µs", 1e-3 * times[name]) for name in SCENES]
    savings = []
    for name, (base, _) in STEPS.items():
        savings.append(saving(name, 1e-3 * times[base], 1e-3 * times[f"without: {name}"]))
    return [Report("mean tick of each scene", costs), Report("skipping step, µs a tick", savings)]


def _subject(scene: TimedScene, stack: contextlib.ExitStack) -> Subject:
    topics = [scene.topic] if scene.topic else []
    daemon = stack.enter_context(virtual_daemon(scene.sections, *topics))
    loop, clock = daemon.loop, daemon.clock
    if scene.holds:
        hold(daemon)
    elif daemon.settings.servos.backend == "none":
        loop.advance(4.0)  # until the object has been pressed on a tip
        if not any(contact.contact for contact in loop.state.contacts):
            raise RuntimeError("no tip was touched")
    else:
        loop.advance(1.0)
    scene.alter(daemon)
    mode = loop.state.mode

    def run(repeat: int) -> None:
        for _ in range(repeat * _TICKS):
            clock.sleep_until(clock.now() + loop.period)
            loop.tick(clock.now())
        if loop.state.mode != mode:
            raise RuntimeError(f"{mode} became {loop.state.mode}: {loop.state.fault}")

    return Subject(run, _TICKS)


def saving(name: str, with_it: NDArray[np.float64], without: NDArray[np.float64]) -> Row:
    """What a step saves, from the times [µs] of the same rounds with and without it."""
    saved = without - with_it
    # A median's error is 1.25 times a mean's; the spread is from quartiles, which no hiccup moves.
    low, middle, high = np.percentile(saved, [25, 50, 75]).tolist()
    error = 1.2533 * (high - low) / 1.349 / math.sqrt(len(saved))
    return {
        "name": name,
        "with": float(np.median(with_it)),
        "without": float(np.median(without)),
        "saves": middle,
        "±": error,
        "measurable": middle > _SURE * error,
    }
