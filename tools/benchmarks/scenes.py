"""The tick's cost in each kind of scene, and what each skipping step saves, from one run.

All daemons stand side by side, on canned readings and virtual time, and tick in turns. A skipping
step is switched off in a daemon of its own, from outside; what it saves is the median of the
differences to the daemon that has it, round by round, with that median's own error.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire import schema
from softfinger.daemon.wire.publisher import bit
from softfinger.kinematics.compiled.kernel import kernel
from softfinger.kinematics.contact.lookup import lookup
from softfinger.kinematics.contact.table import ContactTable
from softfinger.kinematics.estimation import frame_pipeline
from softfinger.tools.benchmarks.canned import can, hold
from softfinger.tools.benchmarks.interleaved import Subject, interleave

_ROUNDS = 1000
_TICKS = 20  # of a call: whole periods of the frames, as of the published topics
_LOOKUPS = 1000
_SURE = 3.0  # times its own error that a saving must have to be called one

Alter = Callable[[Daemon], None]
Samples = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A daemon to tick: its settings, what it does, who listens, and what is altered in it."""

    sections: dict[str, dict[str, Any]]
    holds: bool = False
    topic: str | None = None  # that a subscriber wants
    alter: Alter | None = None


@dataclass(frozen=True)
class Cost:
    """Mean tick of one scene [µs], the median over all rounds."""

    name: str
    median: float
    p99: float

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self) | {"unit": "µs"}


@dataclass(frozen=True)
class Saving:
    """What a step saves a tick [µs], with the standard error of that."""

    name: str
    switched_on: float
    switched_off: float
    saved: float
    error: float

    @property
    def measurable(self) -> bool:
        """More than chance."""
        return self.saved > _SURE * self.error

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return asdict(self) | {"unit": "µs", "measurable": self.measurable}


ONE = {"scene": {"fingers": ("left",)}}
CONSTANT = {"material": {"law": "constant"}}
SENSORS_ONLY = {"servos": {"backend": "none"}}
SERVOS_ONLY = {"tactile": {"backend": "none"}}
IDLE, ONE_FINGER, TWO, TWO_CONSTANT = (
    "idle and open",
    "one finger, idle",
    "two fingers holding, nobody subscribed",
    "two fingers holding, constant modulus",
)
STATE_ONLY = "two fingers holding, state subscribed"
SCENES = {
    IDLE: Scene({}),
    ONE_FINGER: Scene(ONE),
    "servos without sensors, idle": Scene(SERVOS_ONLY),
    "sensors without servos, one tip touched": Scene(SENSORS_ONLY),
    TWO: Scene({}, holds=True),
    TWO_CONSTANT: Scene(CONSTANT, holds=True),
    STATE_ONLY: Scene({}, holds=True, topic="hand/state"),
    "two fingers holding, all subscribed": Scene({}, holds=True, topic="hand"),
}


def _every_tick_estimated(daemon: Daemon) -> None:
    can(daemon, rate=math.inf)


def _always_fitted(daemon: Daemon) -> None:
    for perception in daemon.loop.perception.fingers:
        plan = perception._estimator.compiled_arguments()[0]
        plan[frame_pipeline.PEAK_LEVEL] = plan[frame_pipeline.PATCH_LEVEL] = -1e9


def _always_cold(daemon: Daemon) -> None:
    for perception in daemon.loop.perception.fingers:
        estimator = perception._estimator

        def cold(*arguments: Any, e: Any = estimator, then: Any = estimator.update) -> Any:
            e.reset()
            return then(*arguments)

        estimator.update = cold  # type: ignore[assignment,method-assign]


def _always_predicted(daemon: Daemon) -> None:
    class Live(list[bool]):
        """Both tips count as touched, whatever the frames say."""

        def __setitem__(self, *_: Any) -> None: ...

    daemon.loop.perception.filter._live = Live([True, True])


def _always_packed(daemon: Daemon) -> None:
    broadcast = daemon.loop._broadcast
    assert broadcast is not None
    broadcast._publisher._link.wanted = bit(schema.STATE) | bit(schema.TACTILE)


def _tabulated(daemon: Daemon) -> None:
    """The constant modulus through the form of table that other materials get."""
    model = daemon.models[0]
    table = ContactTable.build(model.table.tip, model.material, form="quintic")
    daemon.loop.perception.filter._tables = (table.data, table.data)


# A step: the scene that has it, and the same without it.
STEPS: dict[str, tuple[str, Scene]] = {
    "no estimate for a frame already seen": (
        TWO,
        Scene({}, holds=True, alter=_every_tick_estimated),
    ),
    "no contact, no fit": (IDLE, Scene({}, alter=_always_fitted)),
    "the fit starts from the last contact": (TWO, Scene({}, holds=True, alter=_always_cold)),
    "no contact, no prediction told": (IDLE, Scene({}, alter=_always_predicted)),
    "closed form for a constant modulus": (
        TWO_CONSTANT,
        Scene(CONSTANT, holds=True, alter=_tabulated),
    ),
    "topics nobody wants are not packed": (TWO, Scene({}, holds=True, alter=_always_packed)),
    "state published at 100 Hz, not each tick": (
        STATE_ONLY,
        Scene({"stream": {"state_rate": 500.0}}, holds=True, topic="hand/state"),
    ),
    "an absent finger costs nothing": (ONE_FINGER, SCENES[IDLE]),
}


def measure(rounds: int = _ROUNDS) -> list[Cost | Saving]:
    """All scenes and steps in turns."""
    scenes = SCENES | {f"without: {name}": scene for name, (_, scene) in STEPS.items()}
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        subjects = {}
        for number, (name, scene) in enumerate(scenes.items()):
            subjects[name] = Subject(_ticks(scene, folder / str(number), stack), _TICKS)
        subjects |= _lookups()
        times = {name: 1e-3 * ns for name, ns in interleave(subjects, rounds).items()}
    rows: list[Cost | Saving] = [_cost(name, times[name]) for name in SCENES]
    for name, (base, _) in STEPS.items():
        rows.append(_saving(name, times[base], times[f"without: {name}"]))
    force, six = times["force alone"], times["all six"]
    # Two fingers, each looked up once a tick.
    rows.append(
        _saving("energy and partials left out (not done: hypothetical)", 2 * force, 2 * six)
    )
    return rows


def table(rows: list[Cost | Saving]) -> str:
    """The rows as two aligned tables."""
    lines = [f"{'mean tick, µs':54} {'median':>8} {'p99':>8}"]
    lines += [
        f"{row.name:54} {row.median:8.2f} {row.p99:8.2f}" for row in rows if isinstance(row, Cost)
    ]
    lines += [
        "",
        f"{'skipping step, µs a tick':54} {'with':>8} {'without':>8} {'saves':>8} {'±':>6}",
    ]
    for row in rows:
        if isinstance(row, Saving):
            verdict = "" if row.measurable else "  nothing measurable"
            lines.append(
                f"{row.name:54} {row.switched_on:8.2f} {row.switched_off:8.2f} {row.saved:8.2f} "
                f"{row.error:6.2f}{verdict}"
            )
    return "\n".join(lines)


def _ticks(scene: Scene, folder: Path, stack: contextlib.ExitStack) -> Callable[[int], object]:
    folder.mkdir()
    base = {
        "loop": {"clock": "virtual"},
        "stream": {"address": f"ipc://{folder}/stream"},
        "commands": {"address": f"ipc://{folder}/commands"},
    }
    sections = {
        name: base.get(name, {}) | scene.sections.get(name, {}) for name in base | scene.sections
    }
    settings = Settings.model_validate(sections)
    context: zmq.Context[Any] = zmq.Context()
    stack.callback(context.term)
    socket = context.socket(zmq.SUB)
    stack.callback(socket.close, linger=0)
    daemon = stack.enter_context(Daemon(settings))
    if scene.topic is not None:
        socket.subscribe(scene.topic)
        socket.connect(settings.stream.address)
    loop, clock = daemon.loop, daemon.clock
    if scene.holds:
        hold(daemon)
    elif settings.servos.backend == "none":
        loop.advance(4.0)  # until the object has been pressed on a tip
        if not any(contact.contact for contact in loop.state.contacts):
            raise RuntimeError("no tip was touched")
    else:
        loop.advance(1.0)
    can(daemon)
    if scene.alter is not None:
        scene.alter(daemon)
    mode = loop.state.mode

    def run(repeat: int) -> None:
        for _ in range(repeat * _TICKS):
            clock.sleep_until(clock.now() + loop.period)
            loop.tick(clock.now())

    def checked(repeat: int) -> None:
        run(repeat)
        if loop.state.mode != mode:
            raise RuntimeError(f"{mode} became {loop.state.mode}: {loop.state.fault}")

    return checked


def _cost(name: str, times: Samples) -> Cost:
    return Cost(name, float(np.median(times)), float(np.percentile(times, 99)))


def _saving(name: str, switched_on: Samples, switched_off: Samples) -> Saving:
    saved = switched_off - switched_on
    # A median's error is 1.25 times a mean's; the spread is from quartiles, which no hiccup moves.
    low, middle, high = np.percentile(saved, [25, 50, 75]).tolist()
    error = 1.2533 * (high - low) / 1.349 / math.sqrt(len(saved))
    on, off = float(np.median(switched_on)), float(np.median(switched_off))
    return Saving(name, on, off, middle, error)


@kernel
def _force_alone(data: NDArray[np.float64], count: int) -> float:
    total = 0.0
    for i in range(count):
        force, _, _, _, _, _, _ = lookup(data, 0.002 + 1e-6 * i, 0.1)
        total += force
    return total


@kernel
def _all_six(data: NDArray[np.float64], count: int) -> float:
    total = 0.0
    for i in range(count):
        force, energy, by_d, by_theta, energy_d, energy_theta, _ = lookup(
            data, 0.002 + 1e-6 * i, 0.1
        )
        total += force + energy + by_d + by_theta + energy_d + energy_theta
    return total


def _lookups() -> dict[str, Subject]:
    with Daemon(Settings.model_validate({"loop": {"clock": "virtual"}}), wire=False) as daemon:
        data = daemon.models[0].table.data

    def subject(run: Callable[[NDArray[np.float64], int], float]) -> Subject:
        return Subject(lambda repeat: run(data, repeat * _LOOKUPS), _LOOKUPS)

    return {"force alone": subject(_force_alone), "all six": subject(_all_six)}
