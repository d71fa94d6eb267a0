"""A scene pays for nothing that it doesn't need: the time that each skipped thing saves.

In µs a tick: all daemons stand side by side, on canned readings (or the simulated hand) and virtual
time, and tick in turns. A step is switched off in a daemon of its own, from outside; what it saves
is the median of the differences to the daemon that has it, round by round.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import bit
from softfinger.kinematics.estimation.estimator import ContactEstimator
from softfinger.tools.benchmarks.measuring import Report, Subject, figure, interleave
from softfinger.tools.benchmarks.rigs import (
    RigError,
    Sections,
    can,
    hold,
    virtual_daemon,
)

_TICKS = 20  # of a call: whole periods of the frames, as of the published topics


def _as_it_is(daemon: Daemon) -> None:
    """The simulated hand stays."""


@dataclass(frozen=True)
class TimedScene:
    """A daemon to tick: its settings, whether it holds, what is subscribed, what is altered."""

    sections: Sections = field(default_factory=dict)
    holds: bool = True
    topics: tuple[str, ...] = ()
    subscribers: int = 1  # to each of these
    alter: Callable[[Daemon], None] = can


def _always_fitted(daemon: Daemon) -> None:
    can(daemon)
    for finger in daemon.loop.perception.fingers:
        model, grid = daemon.models[finger.finger], finger._estimator.grid
        noise = daemon.settings.tactile.noise
        finger._estimator = ContactEstimator(model.table.tip, model.material, grid, noise)
        options = finger._estimator.state.options
        options.peak_level = options.patch_level = -1e9


def _always_packed(daemon: Daemon) -> None:
    can(daemon)
    publishing = daemon.loop._publishing
    assert publishing is not None
    publishing._publisher._link.wanted = bit(schema.STATE) | bit(schema.TACTILE)


ONE = {"scene": {"fingers": ("left",)}}
HOLDING, IDLE, ONE_IDLE = "two fingers holding", "idle and open", "one finger, idle"
NO_SENSORS, NO_SERVOS = "servos without sensors, idle", "sensors without servos, one tip touched"
SCENES = {
    IDLE: TimedScene(holds=False),
    ONE_IDLE: TimedScene(ONE, holds=False),
    NO_SENSORS: TimedScene({"tactile": {"backend": "none"}}, holds=False),
    NO_SERVOS: TimedScene({"servos": {"backend": "none"}}, holds=False),
    HOLDING: TimedScene(),
    "two fingers holding, all subscribed": TimedScene(topics=("hand",)),
}
# What is skipped: the scene that skips it, and the same without skipping.
STEPS: dict[str, tuple[TimedScene, TimedScene]] = {
    "a frame already seen is not estimated": (
        SCENES[HOLDING],
        TimedScene(alter=lambda daemon: can(daemon, every_tick=True)),
    ),
    "no contact, no fit": (SCENES[IDLE], TimedScene(holds=False, alter=_always_fitted)),
    "no blur": (SCENES[HOLDING], TimedScene({"tactile": {"blur": 0.5e-3}})),
    "topics without subscribers": (SCENES[HOLDING], TimedScene(alter=_always_packed)),
    "state at 100 Hz, not each tick": (
        TimedScene(topics=("hand/state",)),
        TimedScene({"stream": {"state_rate": 500.0}}, topics=("hand/state",)),
    ),
    "the simulated hand": (TimedScene(), TimedScene(alter=_as_it_is)),
}


def measure(brief: bool = False, rounds: int = 400) -> list[Report]:
    """Return all scenes and steps in turns."""
    scenes = dict(SCENES)
    for name, (base, without) in STEPS.items():
        scenes |= {f"with {name}": base, f"without {name}": without}
    same = {id(scene): name for name, scene in scenes.items()}  # each is measured once
    with contextlib.ExitStack() as stack:
        subjects = {
            name: ticking(standing(scenes[name], stack)) for name in dict.fromkeys(same.values())
        }
        times = interleave(subjects, 100 if brief else rounds)
    taken = {name: 1e-3 * times[same[id(scene)]] for name, scene in scenes.items()}
    costs = [figure(name, "µs", taken[name]) for name in SCENES]
    savings = []
    for name in STEPS:
        had, lacked = taken[f"with {name}"], taken[f"without {name}"]
        medians = {"with": float(np.median(had)), "without": float(np.median(lacked))}
        savings.append(figure(name, "µs", lacked - had, **medians))
    return [Report("mean tick", costs), Report("skipped, µs a tick", savings)]


def standing(scene: TimedScene, stack: contextlib.ExitStack) -> Daemon:
    """Return a daemon of this scene until ``stack`` is closed. Raises RigError."""
    daemon = stack.enter_context(
        virtual_daemon(scene.sections, *scene.topics, subscribers=scene.subscribers)
    )
    loop = daemon.loop
    if scene.holds:
        hold(daemon)
    elif daemon.settings.servos.backend == "none":
        loop.advance(4.0)  # until the object has been pressed on a tip
        if not any(contact.contact for contact in loop.state.contacts):
            raise RigError("no tip was touched")
    else:
        loop.advance(1.0)
    scene.alter(daemon)
    return daemon


def ticking(daemon: Daemon) -> Subject:
    """Return a daemon's ticks back to back, as long as its mode stays. They raise RigError."""
    loop, clock, mode = daemon.loop, daemon.clock, daemon.loop.state.mode

    def run(repeat: int) -> None:
        for _ in range(repeat * _TICKS):
            clock.sleep_until(clock.now() + loop.period)
            loop.tick(clock.now())
        if loop.state.mode != mode:
            raise RigError(f"{mode} became {loop.state.mode}: {loop.state.fault}")

    return Subject(run, _TICKS)
