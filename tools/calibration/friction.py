"""Run `calibrate friction`: measure joint friction with slow sweeps in air."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.client.stream import read, to_columns
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import by_name
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import STATE, HandState
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.servo_fit import FrictionFit, fit_friction
from softfinger.tools.calibration.calibration_frames import bring
from softfinger.tools.calibration.joints import write_keys
from softfinger.tools.calibration.live_hand import LiveHand
from softfinger.tools.recordings.reader import read_recording

# Speed [rad/s], angle [rad] and number of strokes of each sweep. Slow sweeps determine the
# break-away friction; fast sweeps determine the other friction parameters.
_SWEEPS = ((0.05, 0.06, 2), (0.3, 0.4, 2), (0.6, 0.4, 2))
_WIDEST = max(wide for _, wide, _ in _SWEEPS)
_FROM_ENDS = 0.05  # margin at each end of the joint range [rad]
# Angle tolerance at the start of a sweep [rad]. Friction may stop a joint before its goal.
_ARRIVED = 0.05
_REST = 0.3  # pause between two strokes, in addition to the setpoint smoothing time [s]
_TOUCHED = 0.2  # time discarded before and after each contact [s], because detection takes time
# The break-away friction is reported if it exceeds the sliding friction by this number of standard
# deviations.
_SEEN = 2.0


def calibrate_friction(arguments: argparse.Namespace, settings: Settings) -> str:
    """Write the joint friction to the profile and return a summary.

    Errors raised by `LiveHand` are propagated.

    Raises
    ------
    CalibrationError
        If there is too little motion, or a tip touches something.
    RecordingError, SettingsError
    """
    unit = by_name(settings.servos.model).current_unit * settings.control.torque_constant
    if not unit:
        raise CalibrationError(
            f"friction: servos.model: found {settings.servos.model}, expected a model that "
            "measures its current"
        )
    if len(arguments.recording) > 1:
        raise CalibrationError("friction: expected at most one --recording")
    if arguments.recording:
        columns = read_recording(arguments.recording[0])
    else:
        columns = _swept(arguments, settings)
    names = sorted(settings.scene.fingers)
    fits = [_fit(columns, name, settings, unit) for name in names]
    found = round(float(np.mean([fit.coulomb for fit in fits])), 4)
    told = [f"{name}: {_told(fit)}" for name, fit in zip(names, fits, strict=True)]
    told.append(f"one current count corresponds to {unit:.4f} N·m")
    return "\n  ".join([*told, *write_keys(arguments, {"control": {"joint_friction": found}})])


def _fit(
    columns: dict[str, NDArray[Any]], name: str, settings: Settings, unit: float
) -> FrictionFit:
    """Fit a joint's friction parameters to its motion without contact. Raises CalibrationError."""
    t, touched = columns["t"], columns[f"{name}.contact"]
    used = columns["torque"].copy()
    for begin, end in _stretches(touched):
        used &= (t < t[begin] - _TOUCHED) | (t > t[end] + _TOUCHED)
    q, goal, current = (columns[f"{name}.{key}"][used] for key in ("q", "goal_q", "current"))
    control = settings.control
    try:
        return fit_friction(
            t[used], q, goal, control.torque_constant * current, control.joint_inertia, unit
        )
    except CalibrationError as error:
        raise CalibrationError(f"friction: {name}: {error}") from None


def _stretches(holds: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of each sequence of True values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]])))
    return zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True)


def _told(fit: FrictionFit) -> str:
    told = (
        f"{fit.coulomb:.4f} ± {fit.coulomb_std:.4f} N·m, "
        f"viscous {fit.viscous:.3f} ± {fit.viscous_std:.3f} N·m·s/rad"
    )
    more = fit.stiction - fit.coulomb
    if more > _SEEN * math.hypot(fit.stiction_std, fit.coulomb_std):
        told += f", at break-away {fit.stiction:.3f} ± {fit.stiction_std:.3f} N·m"
    return told


def _swept(arguments: argparse.Namespace, settings: Settings) -> dict[str, NDArray[Any]]:
    """Sweep one joint at a time, and return all states."""
    names = sorted(settings.scene.fingers)
    ways = {name: _way(settings, name) for name in names}
    told = ", ".join(
        f"{name} {math.degrees(start):.0f}° to {math.degrees(start + way):.0f}°"
        for name, (start, way) in ways.items()
    )
    bring(
        arguments,
        f"friction: keep the space around the fingers free; the joints will sweep {told}",
        {},
    )
    with LiveHand(arguments) as hand:
        hand.command("move", **{name: start for name, (start, _) in ways.items()})
        hand.until(
            lambda state: all(
                abs(state.finger(name).q - start) < _ARRIVED for name, (start, _) in ways.items()
            )
        )
        for name in names:
            start, way = ways[name]
            for speed, wide, times in _SWEEPS:
                end = start + math.copysign(min(wide, abs(way)), way)
                for _ in range(times):
                    _stroke(hand, settings, name, (start, end), speed)
                    _stroke(hand, settings, name, (end, start), speed)
        states = [read(HandState, message) for _, message in hand.messages([STATE])]
    columns = to_columns(states)
    return {"t": (columns["mono_ns"] - columns["mono_ns"][0]) * 1e-9, **columns}


def _way(settings: Settings, name: str) -> tuple[float, float]:
    """Return the start angle and signed length [rad] of a joint's sweeps.

    The sweeps open the joint if its range permits; otherwise, they close the joint. Raises
    CalibrationError if the range is too short.
    """
    hand, finger = settings.hand, FINGERS.index(name)
    start = hand.open_angle[finger]
    opens = start - (hand.q_min[finger] + _FROM_ENDS)
    closes = hand.q_max[finger] - _FROM_ENDS - start
    way = -min(opens, _WIDEST) if opens > 0.5 * _WIDEST else min(closes, _WIDEST)
    if abs(way) < 0.5 * _WIDEST:
        raise CalibrationError(
            f"friction: {name}: found {math.degrees(abs(way)):.0f}° between hand.open_angle and "
            f"the ends of the joint's range, expected at least {math.degrees(0.5 * _WIDEST):.0f}°"
        )
    return start, way


def _stroke(
    hand: LiveHand, settings: Settings, name: str, ends: tuple[float, float], speed: float
) -> None:
    """Move a joint between ``ends`` at ``speed`` [rad/s]. Raises CalibrationError."""
    first, last = ends
    touch, rest = settings.control.contact_force, _REST + settings.control.smooth_time
    seconds = abs(last - first) / speed
    begin, share = 0, 0.0
    for state in hand.states():
        if max(state.left.force, state.right.force) > touch:
            raise CalibrationError(
                f"friction: {name}: a tip is in contact: clear the space around the fingers"
            )
        begin = begin or state.mono_ns
        passed = (state.mono_ns - begin) * 1e-9
        if share < 1.0:
            share = min(passed / seconds, 1.0)
            hand.command("move", **{name: first + share * (last - first)})
        elif passed > seconds + rest:
            return
