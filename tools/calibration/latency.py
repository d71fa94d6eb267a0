"""Run `calibrate latency`: measure the tactile frame latency in a grip with varying force."""

from __future__ import annotations

import argparse
import math

import numpy as np
from numpy.typing import NDArray

from softfinger.daemon.client.stream import read, to_columns
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import FINGERS, Frame
from softfinger.daemon.wire.schema import STATE, TACTILE, HandState, TactileFrame
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.latency_fit import fit_latency
from softfinger.kinematics.hand.geometry import tip_position
from softfinger.tools.calibration.calibration_frames import bring
from softfinger.tools.calibration.joints import write_keys
from softfinger.tools.calibration.live_hand import LiveHand
from softfinger.tools.recordings.reader import MessageSource, Recording
from softfinger.tools.recordings.recomputed import counts_of, recorded_models, recorded_settings

FloatArray = NDArray[np.float64]

_STEPS = (1.0, 0.5, 1.25, 0.5)  # successive forces, divided by the first force
_HELD = 0.5  # hold time at each force [s]
_STD_MAX = 5e-3  # maximum standard deviation of the latency [s]
# Accepted ratio of d estimated from the frames to d computed from the joint angles. A ratio outside
# this range means that the frames do not match the joint motion.
_SCALE = 0.5, 2.0
# Maximum rms residual [m]. Larger residuals indicate sliding, tilting or a second contact.
_MISFIT_MAX = 0.3e-3
# Relative error of d estimated from the frame shape, and of d estimated from the frame amplitude.
_SHAPE_ERROR, _HEIGHT_ERROR = 0.05, 0.2


def calibrate_latency(arguments: argparse.Namespace, settings: Settings) -> str:
    """Write the frame latency to the profile and return a summary.

    Errors raised by `LiveHand` are propagated.

    Raises
    ------
    CalibrationError
        If the data do not determine the latency.
    RecordingError, SettingsError
    """
    if len(arguments.recording) > 1:
        raise CalibrationError("latency: expected at most one --recording")
    source: MessageSource
    source = (
        Recording(arguments.recording[0]) if arguments.recording else _gripped(arguments, settings)
    )
    own, _ = recorded_settings(source)
    set_latency, tactile = own.tactile.latency, own.tactile
    count = 2.0 * math.pi / COUNTS_PER_TURN / own.servos.gear_ratio
    free = own.tip.physics == "springs" and own.estimator.free_gain is not False
    fingers = len(own.scene.fingers)
    encoder = fingers * own.hand.finger_length * count / math.sqrt(12.0)
    try:
        fit = fit_latency(
            _frames(source, own),
            _closing(source, own),
            (encoder, _SHAPE_ERROR if free else _HEIGHT_ERROR),
            set_latency,
            tactile.response,
        )
    except CalibrationError as error:
        raise CalibrationError(f"latency: {error}") from None
    if fit.std > _STD_MAX:
        raise CalibrationError(
            f"latency: found a latency uncertainty of {fit.std * 1e3:.1f} ms, expected at most "
            f"{_STD_MAX * 1e3:g} ms: grasp with more force, and change the force several times"
        )
    if not _SCALE[0] < fit.scale < _SCALE[1] or fit.residual > _MISFIT_MAX:
        raise CalibrationError(
            f"latency: d from the frames is {fit.scale:.2f} times d from the joints (expected "
            f"{_SCALE[0]:g} to {_SCALE[1]:g}), and the rms difference is "
            f"{fit.residual * 1e3:.2f} mm (expected at most {_MISFIT_MAX * 1e3:g} mm): grasp a "
            "flat object that neither slides nor tilts"
        )
    latency = round(max(set_latency + fit.delay, 0.0), 4)
    told = (
        f"{latency * 1e3:.1f} ± {fit.std * 1e3:.1f} ms (the daemon used {set_latency * 1e3:g} ms) "
        f"from {fit.ramps} ramps; d from the frames is {fit.scale:.2f} times d from the joints, "
        f"rms difference {fit.residual * 1e3:.2f} mm"
    )
    return "\n  ".join([told, *write_keys(arguments, {"tactile": {"latency": latency}})])


def _gripped(arguments: argparse.Namespace, settings: Settings) -> LiveHand:
    """Grasp at several forces, then open the hand; return the hand with the stored stream."""
    first = arguments.force[0] if arguments.force else settings.control.force_default
    forces = [min(step * first, settings.safety.force_max) for step in _STEPS]
    bring(
        arguments,
        f"latency: put an object between the fingers; the hand will grasp it with {first:g} N",
        {},
    )
    with LiveHand(arguments) as hand:
        for force in forces:
            hand.command("grasp", force=force)
            hand.until(lambda state: state.mode == "holding")
            hand.wait(_HELD + settings.control.force_time)
        hand.command("release")
        hand.until(lambda state: state.mode == "armed")
    return hand


def _frames(source: MessageSource, own: Settings) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times, the sum of d over all fingers, and the sum's standard deviation due to noise.

    Each frame is estimated separately. The times are the first finger's scan times while all
    fingers are in contact.
    """
    names = sorted(own.scene.fingers)
    models = recorded_models(source)
    sensors = {name: GivenFrames() for name in names}
    seen = {
        name: FingerPerception(sensors[name], models[FINGERS.index(name)], own, [])
        for name in names
    }
    rows: dict[str, list[tuple[float, float, float]]] = {name: [] for name in names}
    for _, message in source.messages([TACTILE]):
        frame = read(TactileFrame, message)
        name, scanned = frame.finger, frame.mono_ns * 1e-9
        if name not in seen or not frame.valid:
            continue
        data = counts_of(source, message, own)
        sensors[name].frame = Frame(frame.seq, scanned, scanned, True, data)
        seen[name].update()
        estimate = seen[name].estimate
        if estimate.contact and not estimate.invalid:
            own_variance = estimate.covariance[0, 0] - estimate.systematic[0, 0]
            rows[name].append((scanned, estimate.d, max(own_variance, 0.0)))
    columns = [np.array(rows[name]).reshape(-1, 3).T for name in names]
    t, d, variance = columns[0]
    for later, depth, noise in columns[1:]:
        if not later.size:
            return later, depth, noise
        both = (t >= later[0]) & (t <= later[-1])
        t, d, variance = t[both], d[both], variance[both]
        d = d + np.interp(t, later, depth)
        variance = variance + np.interp(t, later, noise)
    return t, d, np.sqrt(variance)


def _closing(source: MessageSource, own: Settings) -> tuple[FloatArray, FloatArray]:
    """Compute d1 + d2 [m] versus time from the joint angles, up to an unknown constant offset.

    The sum d1 + d2 = W + 2a − (O2 − O1)·n does not change if the object moves between the tips.
    """
    states = to_columns(read(HandState, message) for _, message in source.messages([STATE]))
    hand, angle = own.hand, states["object.angle"]
    depth = np.zeros(angle.size)
    for name in own.scene.fingers:
        side = 1.0 if name == FINGERS[0] else -1.0
        lengths = 0.5 * hand.pivot_separation, hand.finger_length, hand.finger_offset
        tips = np.array([tip_position(q, side, *lengths) for q in states[f"{name}.q"]])
        x, y = tips.reshape(-1, 2).T
        depth += side * (x * np.cos(angle) + y * np.sin(angle))
    return states["mono_ns"] * 1e-9, depth
