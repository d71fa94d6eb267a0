"""Messages of the stream as typed records, and lists of them as NumPy columns.

A message is data of unknown origin: a field that is missing or of another type is NaN, 0, False or
an empty text here, and a field this module doesn't know is passed over, so that a program goes on
with the fields it knows when the daemon's schema is newer. SI units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.types import FINGERS

_Record = TypeVar("_Record")


@dataclass(frozen=True, slots=True)
class FingerState:
    """One finger in ``hand/state``."""

    valid: bool  # takes part, and what it has of servos and sensors gave fresh, sound numbers
    q: float  # joint angle [rad], positive closes
    dq: float  # [rad/s]
    current: float  # [A]
    temperature: float  # of the servo [°C], 0 while not known
    voltage: float  # of its supply [V], 0 while not known
    goal_q: float  # [rad]
    goal_current: float  # [A]
    d: float  # maximum displacement [m]
    theta: float  # the object's angle in the tip's frame, in the hand's plane [rad]
    tilt_y: float  # and across it [rad]
    force: float  # F(d, θ) [N]
    energy: float  # U(d, θ) [J]
    d_std: float  # standard deviations [m], [rad]
    theta_std: float
    gain: float  # measured over modelled pressure
    misfit: bool  # the frame fits no contact of the model: d and theta may be biased
    contact: bool  # something touches the tip
    frame_seq: int  # of the tactile frame that the estimate rests on
    frame_age_s: float


@dataclass(frozen=True, slots=True)
class ObjectState:
    """The object in ``hand/state``, from the two contacts."""

    valid: bool
    angle: float  # of its faces' bisector; of a disc, of the line between the contacts [rad]
    width: float  # [m]


@dataclass(frozen=True, slots=True)
class HandState:
    """One ``hand/state``."""

    NESTED: ClassVar[dict[str, type[Any]]] = {
        "left": FingerState,
        "right": FingerState,
        "object": ObjectState,
    }

    schema: int
    seq: int  # the tick
    seq_step: int  # one of so many is sent
    timestamp: float  # Unix time [s]
    mono_ns: int  # the daemon's own clock [ns]
    mode: str
    fault: str  # empty when none
    fault_name: str  # its name in the table of limits
    torque: bool
    tick_s: float
    compute_s: float
    wake_late_s: float
    overruns: int
    behind_s: float  # how long a simulated hand has waited for a busy machine [s]
    goal_force: float  # the tips' mean force that the grip goes to [N], NaN without a grip
    goal_angle: float  # the object's angle that it keeps [rad], NaN where it keeps none
    left: FingerState
    right: FingerState
    object: ObjectState

    def finger(self, name: str) -> FingerState:
        """``left`` or ``right`` by its name. Raises ValueError for another."""
        if name not in FINGERS:
            raise ValueError(f"found finger {name!r}, expected one of {', '.join(FINGERS)}")
        return self.left if name == FINGERS[0] else self.right


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One ``hand/tactile``: the raw counts under one tip, or its pressure in steps of ``scale``."""

    seq: int
    timestamp: float  # Unix time at which the board sampled it [s]
    valid: bool  # False: the board is gone, and this is its last frame again
    finger: str
    pitch: float  # from column to column [m]
    pitch_y: float  # and from row to row
    centre: tuple[float, float]  # the tip's centre off the grid's, x and y [m]
    rotation: float  # of the sensor's axes against the finger's [rad]
    unit: str  # "count" or "Pa": what the board said, or what the estimator was given
    scale: float  # Pa a count or step
    calibrated: bool  # counts × scale is the pressure by the calibration
    calibration: str  # name and date of the one that the estimator goes by, empty without
    counts: NDArray[np.uint16]  # [rows, cols], read-only

    def pressure(self) -> NDArray[np.float64]:
        """Counts times the scale [Pa], [rows, cols]."""
        return self.counts.astype(np.float64) * self.scale


@dataclass(frozen=True, slots=True)
class Event:
    """One ``hand/event``."""

    seq: int
    again: bool  # told again for a late subscriber: it may have been told before
    timestamp: float  # Unix time [s]
    mono_ns: int
    level: str  # info, warning, error
    kind: str
    text: str


def read_state(message: dict[str, Any]) -> HandState:
    """``hand/state`` as a record."""
    return _read(HandState, message)


def read_event(message: dict[str, Any]) -> Event:
    """``hand/event`` as a record."""
    return _read(Event, message)


def read_frame(message: dict[str, Any]) -> TactileFrame:
    """``hand/tactile`` as a record. Raises ValueError when the grid is not what it says it is."""
    rows, cols, data = message.get("rows"), message.get("cols"), message.get("data")
    if type(rows) is not int or type(cols) is not int or not isinstance(data, bytes):
        raise ValueError("hand/tactile without rows, cols or data")
    if min(rows, cols) < 1 or len(data) != 2 * rows * cols:
        raise ValueError(f"hand/tactile: {len(data)} bytes are no {rows} × {cols} uint16 grid")
    return TactileFrame(
        seq=_as_int(message.get("seq")),
        timestamp=_as_float(message.get("timestamp")),
        valid=_as_bool(message.get("valid")),
        finger=_as_text(message.get("finger")),
        pitch=_as_float(message.get("pitch")),
        pitch_y=_as_float(message.get("pitch_y")),
        centre=(_as_float(message.get("centre_x")), _as_float(message.get("centre_y"))),
        rotation=_as_float(message.get("rotation")),
        unit=_as_text(message.get("unit")),
        scale=_as_float(message.get("scale")),
        calibrated=_as_bool(message.get("calibrated")),
        calibration=_as_text(message.get("calibration")),
        counts=np.frombuffer(data, dtype="<u2").reshape(rows, cols),
    )


def to_columns(states: Iterable[HandState]) -> dict[str, NDArray[Any]]:
    """States as one array a field, nested ones with a dot (``left.force``), in their order.

    ``pandas.DataFrame(to_columns(states))`` takes it as it is.
    """
    rows: Sequence[HandState] = list(states)
    columns: dict[str, NDArray[Any]] = {}
    for field in fields(HandState):
        nested = HandState.NESTED.get(field.name)
        if nested is None:
            columns[field.name] = np.array([getattr(row, field.name) for row in rows])
            continue
        parts = [getattr(row, field.name) for row in rows]
        for inner in fields(nested):
            values = [getattr(part, inner.name) for part in parts]
            columns[f"{field.name}.{inner.name}"] = np.array(values)
    return columns


def _as_float(value: object) -> float:
    return (
        float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan
    )


def _as_int(value: object) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) else 0


def _as_text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _as_bool(value: object) -> bool:
    return value is True


_READERS = {"float": _as_float, "int": _as_int, "str": _as_text, "bool": _as_bool}
_PLANS: dict[type[Any], list[tuple[str, Any]]] = {}


def _read(record: type[_Record], message: object) -> _Record:
    plan = _PLANS.get(record)
    if plan is None:
        nested = getattr(record, "NESTED", {})
        plan = _PLANS[record] = [
            (field.name, nested.get(field.name) or _READERS[str(field.type)])
            for field in fields(record)  # type: ignore[arg-type]
        ]
    given = message if isinstance(message, dict) else {}
    return record(
        *(
            _read(reader, given.get(name)) if isinstance(reader, type) else reader(given.get(name))
            for name, reader in plan
        )
    )
