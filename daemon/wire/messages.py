"""What goes over the wire: records in, msgpack maps out, and the schema's number.

A map has string keys. A field that is a float is always sent as a float, a field is never left out,
and fields are only ever added. SI units.

`wire.schema` tells every field with its unit and meaning; ``daemon/wire/STREAM.md`` is its page.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import msgpack
import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import FINGERS, Contact, Frame, Reading, State

if TYPE_CHECKING:  # it brings compiled kernels, which clients have no use for
    from softfinger.daemon.loop.timing import Statistics

SCHEMA = 1
STATE = b"hand/state"
TACTILE = b"hand/tactile"
EVENT = b"hand/event"
STATS = b"hand/stats"
SETTINGS = b"hand/settings"
COMMAND = b"hand/command"
INPUT = b"hand/input"
TRUTH = b"hand/truth"

pack = msgpack.Packer(use_bin_type=True).pack


class Parts(NamedTuple):
    """What the scene has: which fingers, and whether they have servos and sensors."""

    fingers: tuple[bool, bool]
    servos: bool
    sensors: bool

    @classmethod
    def of(cls, settings: Settings) -> Parts:
        """What these settings say."""
        return cls(
            fingers=("left" in settings.scene.fingers, "right" in settings.scene.fingers),
            servos=settings.servos.backend != "none",
            sensors=settings.tactile.backend != "none",
        )


class Truth(Protocol):
    """What a simulated hand knows: arrays of both tips, and the object's x, y, φ."""

    d: NDArray[np.float64]
    theta: NDArray[np.float64]
    force: NDArray[np.float64]
    object_pose: NDArray[np.float64]


class SensorFacts(NamedTuple):
    """What `hand/tactile` tells of a sensor with each frame; names and units are that topic's."""

    pitch: float
    pitch_y: float
    centre_x: float
    centre_y: float
    rotation: float
    unit: str
    scale: float
    calibrated: bool
    calibration: str


class Facts(NamedTuple):
    """What doesn't change while a daemon runs; texts of JSON, empty where there is nothing."""

    version: str
    settings: str
    calibration_left: str
    calibration_right: str
    table_left: str
    table_right: str


class Rates(NamedTuple):
    """How often things have happened [Hz]; the names are `hand/stats`'s."""

    tick: float
    left: float
    right: float
    state: float
    tactile: float


def state_message(state: State, scene: Parts, step: int = 1) -> dict[str, Any]:
    """The ``hand/state`` map; one of ``step`` ticks is sent."""
    timing = state.timing
    reading = state.reading
    joints = zip(
        reading.q,
        reading.dq,
        reading.current,
        reading.temperature,
        reading.voltage,
        state.goal.q,
        state.goal.current,
        strict=True,
    )
    read = state.reading.valid or not scene.servos
    left, right = (
        _finger(state, contact, joint, part and read and (contact.valid or not scene.sensors))
        for contact, joint, part in zip(state.contacts, joints, scene.fingers, strict=True)
    )
    return {
        "schema": SCHEMA,
        "seq": state.seq,
        "seq_step": step,
        "timestamp": state.wall,
        "mono_ns": int(state.t * 1e9),
        "mode": state.mode,
        "fault": state.fault,
        "fault_name": state.fault_name,
        "torque": state.torque,
        "tick_s": timing.tick_s,
        "compute_s": timing.compute_s,
        "wake_late_s": timing.wake_late_s,
        "overruns": timing.overruns,
        "behind_s": timing.behind_s,
        "goal_force": state.goal.force,
        "goal_angle": state.goal.angle,
        "left": left,
        "right": right,
        "object": {
            "valid": state.object.valid,
            "angle": state.object.angle,
            "width": state.object.width,
        },
    }


def _finger(
    state: State,
    contact: Contact,
    joint: tuple[float, ...],
    valid: bool,
) -> dict[str, Any]:
    q, dq, current, temperature, voltage, goal_q, goal_current = joint
    return {
        "valid": valid,
        "q": q,
        "dq": dq,
        "current": current,
        "temperature": temperature,
        "voltage": voltage,
        "goal_q": goal_q,
        "goal_current": goal_current,
        "d": contact.d,
        "theta": contact.theta,
        "tilt_y": contact.tilt_y,
        "force": contact.force,
        "energy": contact.energy,
        "d_std": contact.d_std,
        "theta_std": contact.theta_std,
        "gain": contact.gain,
        "misfit": contact.misfit,
        "contact": contact.contact,
        "frame_seq": contact.seq,
        "frame_age_s": state.t - contact.t if contact.seq else 0.0,
    }


def input_message(state: State, frames: tuple[Frame | None, Frame | None]) -> dict[str, Any]:
    """The ``hand/input`` map: all that the tick took in from outside, numbers as they were."""
    reading = state.reading
    left, right = (_taken(reading, finger, frame) for finger, frame in enumerate(frames))
    return {
        "schema": SCHEMA,
        "seq": state.seq,
        "timestamp": state.wall,
        "mono_ns": int(state.t * 1e9),
        "t": state.t,
        "late_in_row": state.timing.late_in_row,
        "busy_s": state.timing.busy_s,
        "reading": {
            "seq": reading.seq,
            "t": reading.t,
            "valid": reading.valid,
            "alert": reading.alert,
            "error": state.read_error,
            "lost": reading.lost,
            "frozen": reading.frozen,
        },
        "left": left,
        "right": right,
        "write_error": state.write_error,
        "torque_off": state.torque_off,
    }


def truth_message(state: State, truth: Truth, step: int = 1) -> dict[str, Any]:
    """The ``hand/truth`` map of a simulated hand, sent every ``step`` ticks."""
    x, y, angle = (float(value) for value in truth.object_pose)
    left, right = (
        {"d": float(d), "theta": float(theta), "force": float(force)}
        for d, theta, force in zip(truth.d, truth.theta, truth.force, strict=True)
    )
    return {
        "schema": SCHEMA,
        "seq": state.seq,
        "seq_step": step,
        "timestamp": state.wall,
        "mono_ns": int(state.t * 1e9),
        "left": left,
        "right": right,
        "object": {"x": x, "y": y, "angle": angle},
    }


def _taken(reading: Reading, finger: int, frame: Frame | None) -> dict[str, Any]:
    return {
        "q": reading.q[finger],
        "dq": reading.dq[finger],
        "current": reading.current[finger],
        "hardware": reading.hardware[finger],
        "temperature": reading.temperature[finger],
        "voltage": reading.voltage[finger],
        "frame_seq": 0 if frame is None else frame.seq,
        "frame_t": 0.0 if frame is None else frame.t_sample,
        "frame_arrival": 0.0 if frame is None else frame.t_arrival,
        "frame_valid": False if frame is None else frame.valid,
    }


def tactile_message(
    frame: Frame,
    data: NDArray[np.uint16],
    finger: int,
    facts: SensorFacts,
    wall: float,
    step: int = 1,
    number: int = 0,
) -> dict[str, Any]:
    """The ``hand/tactile`` map of one finger's frame; ``wall`` is the Unix time it was sampled.

    ``data`` [rows, cols] is the frame's, in steps as ``facts`` tells; one of ``step`` frames is
    sent, and this is the ``number``-th of the sensor.
    """
    rows, cols = data.shape
    return {
        "schema": SCHEMA,
        "seq": frame.seq,
        "seq_step": step,
        "number": number,
        "timestamp": wall,
        "mono_ns": int(frame.t_sample * 1e9),
        "delay_s": frame.t_arrival - frame.t_sample,
        "valid": frame.valid,
        "finger": FINGERS[finger],
        "rows": rows,
        "cols": cols,
        **facts._asdict(),
        "data": data.astype("<u2", copy=False).tobytes(),
    }


def stats_message(
    state: State, period: float, rates: Rates, statistics: Statistics, step: int = 1
) -> dict[str, Any]:
    """The ``hand/stats`` map, sent every ``step`` ticks."""
    spreads = {name: spread._asdict() for name, spread in statistics.spreads().items()}
    return {
        "schema": SCHEMA,
        "seq": state.seq,
        "seq_step": step,
        "timestamp": state.wall,
        "mono_ns": int(state.t * 1e9),
        "ticks": statistics.ticks,
        "overruns": state.timing.overruns,
        "period_s": period,
        **spreads,
        "rates": rates._asdict(),
    }


def event_message(
    seq: int, wall: float, t: float, level: str, kind: str, text: str
) -> dict[str, Any]:
    """The ``hand/event`` map."""
    return {**_told(seq, wall, t), "level": level, "kind": kind, "text": text}


def settings_message(seq: int, wall: float, t: float, facts: Facts) -> dict[str, Any]:
    """The ``hand/settings`` map."""
    return {**_told(seq, wall, t), **facts._asdict()}


def command_message(
    seq: int, wall: float, t: float, tick: int, request: dict[str, Any], error: str
) -> dict[str, Any]:
    """The ``hand/command`` map; ``error`` is why it was refused, empty when it was carried out."""
    return {
        **_told(seq, wall, t),
        "tick": tick,
        "command": str(request.get("command", "")),
        "client": str(request.get("client", "")),
        "request": json.dumps(request, default=str),
        "ok": not error,
        "error": error,
    }


def _told(seq: int, wall: float, t: float) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "seq": seq,
        "again": False,
        "timestamp": wall,
        "mono_ns": int(t * 1e9),
    }
