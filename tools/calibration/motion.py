"""Run `calibrate friction` and `calibrate latency`, which move the hand through its daemon.

Instead of moving the hand, both steps can evaluate a recording of such a motion.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.daemon.client.connection import REPLY_TIMEOUT, drain, subscribe, unpack
from softfinger.daemon.client.hand import Hand
from softfinger.daemon.client.stream import no_stream, read, to_columns
from softfinger.daemon.errors import HandFault, Refused
from softfinger.daemon.perception.perception import FingerPerception
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.control_table import COUNTS_PER_TURN, by_name
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.daemon.types import FINGERS, Frame
from softfinger.daemon.wire.schema import SETTINGS, STATE, TACTILE, HandState, TactileFrame
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.latency_fit import fit_latency
from softfinger.kinematics.calibration.servo_fit import FrictionFit, fit_friction
from softfinger.kinematics.hand.geometry import tip_position
from softfinger.tools.arguments import client_keys
from softfinger.tools.calibration.calibration_frames import bring
from softfinger.tools.calibration.joints import write_keys
from softfinger.tools.recordings.reader import MessageSource, Recording
from softfinger.tools.recordings.recomputed import counts_of, recorded_models, recorded_settings

FloatArray = NDArray[np.float64]

_MESSAGES_PER_READ = 1000
_COMMAND_TIMEOUT = 20.0  # time limit for each command, measured on the hand's clock [s]


class LiveHand:
    """Hand of a running daemon; stores the stream, and `messages` works as in `Recording`."""

    path = Path("the stream")

    def __init__(self, client: Hand, socket: zmq.Socket[Any]) -> None:
        self._client, self._socket = client, socket
        self._taken: list[tuple[bytes, dict[str, Any]]] = []
        self.commanded = False  # True once the daemon may have executed a command

    def command(self, name: str, **numbers: float) -> None:
        """Send a command. Raises Refused or NoAnswer."""
        before, self.commanded = self.commanded, True  # A command may be executed without a reply.
        try:
            self._client.command(name, **numbers)
        except Refused:
            self.commanded = before
            raise

    def states(self) -> Iterator[HandState]:
        """Store all messages and repeatedly yield the newest state. Raises NoStream."""
        while True:
            if not self._socket.poll(int(1e3 * REPLY_TIMEOUT)):
                raise no_stream(self._client.stream_address, STATE, REPLY_TIMEOUT)
            newest = None
            for frames in drain(self._socket, _MESSAGES_PER_READ):
                with contextlib.suppress(ValueError):  # Skip invalid messages.
                    topic, message = unpack(frames)
                    self._taken.append((topic, message))
                    newest = message if topic == STATE else newest
            if newest is not None:
                state = read(HandState, newest)
                if state.fault:
                    raise HandFault(state.fault)
                yield state

    def until(self, holds: Callable[[HandState], object]) -> None:
        """Wait until ``holds(state)`` is true; raise CalibrationError after 20 s."""
        begin = None
        for state in self.states():
            if holds(state):
                return
            begin = begin or state.mono_ns
            if (state.mono_ns - begin) * 1e-9 > _COMMAND_TIMEOUT:
                raise CalibrationError(
                    f"the hand is still {state.mode} after {_COMMAND_TIMEOUT:g} s"
                )

    def wait(self, seconds: float) -> None:
        """Wait for ``seconds``, measured on the hand's clock."""
        end = next(self.states()).mono_ns + int(1e9 * seconds)
        self.until(lambda state: state.mono_ns >= end)

    def messages(
        self, topics: Collection[bytes] | None = None
    ) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """Yield the stored messages on ``topics`` in the order of arrival."""
        for topic, message in self._taken:
            if topics is None or topic in topics:
                yield topic, message


@contextlib.contextmanager
def live_hand(arguments: argparse.Namespace) -> Iterator[LiveHand]:
    """Arm the hand, and disarm it at the end if it was disarmed at the beginning.

    After an error, the torque is switched off.
    """
    with Hand(*arguments.address, keys=arguments.keys) as client, zmq.Context() as context:
        if (keys := client_keys(arguments.keys)) is not None:
            keys.guard(context)
        with subscribe(context, arguments.address[0], SETTINGS, STATE, TACTILE) as socket:
            hand = LiveHand(client, socket)
            mode = next(hand.states()).mode
            if mode not in ("disarmed", "armed"):
                raise CalibrationError(f"found mode {mode}, expected disarmed or armed")
            try:
                if mode == "disarmed":
                    hand.command("arm")
                hand.until(lambda state: state.mode == "armed" and state.torque)
                yield hand
                if mode == "disarmed":
                    client.disarm()
            except BaseException:
                if hand.commanded:
                    client.stop()
                raise


def _source(
    arguments: argparse.Namespace,
    settings: Settings,
    moved: Callable[[argparse.Namespace, Settings], LiveHand],
) -> MessageSource:
    """Return the recording if one is given; otherwise, move the hand and return its stream."""
    if len(arguments.recording) > 1:
        raise CalibrationError(f"{arguments.step}: expected at most one --recording")
    return Recording(arguments.recording[0]) if arguments.recording else moved(arguments, settings)


def _states(source: MessageSource) -> dict[str, NDArray[Any]]:
    """Return one array per field of `hand/state`."""
    return to_columns(read(HandState, message) for _, message in source.messages([STATE]))


# Friction

# Speed [rad/s] and angle [rad] of each sweep, which moves the joint there and back twice. Slow
# sweeps determine the break-away friction; fast sweeps determine the other friction parameters.
_SWEEPS = ((0.05, 0.06), (0.3, 0.4), (0.6, 0.4))
_WIDEST = max(wide for _, wide in _SWEEPS)
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

    Raises RecordingError, SettingsError, the errors of `live_hand`, or CalibrationError if there is
    too little motion or a tip touches something.
    """
    unit = by_name(settings.servos.model).current_unit * settings.control.torque_constant
    if not unit:
        raise CalibrationError(
            f"friction: servos.model: found {settings.servos.model}, expected a model that "
            "measures its current"
        )
    states = _states(_source(arguments, settings, _swept))
    names = sorted(settings.scene.fingers)
    fits = [_fit(states, name, settings, unit) for name in names]
    found = round(float(np.mean([fit.coulomb for fit in fits])), 4)
    told = [f"{name}: {_told(fit)}" for name, fit in zip(names, fits, strict=True)]
    told.append(f"one current count corresponds to {unit:.4f} N·m")
    return "\n  ".join([*told, *write_keys(arguments, {"control": {"joint_friction": found}})])


def _fit(
    states: dict[str, NDArray[Any]], name: str, settings: Settings, unit: float
) -> FrictionFit:
    """Fit a joint's friction parameters to its motion without contact. Raises CalibrationError."""
    t = (states["mono_ns"] - states["mono_ns"][:1]) * 1e-9
    touched = t[states[f"{name}.contact"].astype(np.bool_)]
    # Without a contact in this interval, both limits have the same index in `touched`.
    before = np.searchsorted(touched, t - _TOUCHED, "left")
    after = np.searchsorted(touched, t + _TOUCHED, "right")
    used = states["torque"].astype(np.bool_) & (before == after)
    q, goal, current = (states[f"{name}.{key}"][used] for key in ("q", "goal_q", "current"))
    control = settings.control
    try:
        return fit_friction(
            t[used], q, goal, control.torque_constant * current, control.joint_inertia, unit
        )
    except CalibrationError as error:
        raise CalibrationError(f"friction: {name}: {error}") from None


def _told(fit: FrictionFit) -> str:
    told = (
        f"{fit.coulomb:.4f} ± {fit.coulomb_std:.4f} N·m, "
        f"viscous {fit.viscous:.3f} ± {fit.viscous_std:.3f} N·m·s/rad"
    )
    more = fit.stiction - fit.coulomb
    if more > _SEEN * math.hypot(fit.stiction_std, fit.coulomb_std):
        told += f", at break-away {fit.stiction:.3f} ± {fit.stiction_std:.3f} N·m"
    return told


def _swept(arguments: argparse.Namespace, settings: Settings) -> LiveHand:
    """Sweep one joint at a time; return the hand with the stored stream."""
    names = sorted(settings.scene.fingers)
    ways = {name: _way(settings, name) for name in names}
    told = ", ".join(
        f"{name} {math.degrees(start):.0f}° to {math.degrees(start + way):.0f}°"
        for name, (start, way) in ways.items()
    )
    bring(
        arguments,
        f"friction: keep the space around the fingers free; the joints will sweep {told}",
    )
    with live_hand(arguments) as hand:
        hand.command("move", **{name: start for name, (start, _) in ways.items()})
        hand.until(
            lambda state: all(
                abs(state.finger(name).q - start) < _ARRIVED for name, (start, _) in ways.items()
            )
        )
        for name in names:
            start, way = ways[name]
            for speed, wide in _SWEEPS:
                end = start + math.copysign(min(wide, abs(way)), way)
                for ends in 2 * [(start, end), (end, start)]:
                    _stroke(hand, settings, name, ends, speed)
    return hand


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


# Latency

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

    Raises RecordingError, SettingsError, the errors of `live_hand`, or CalibrationError if the data
    do not determine the latency.
    """
    source = _source(arguments, settings, _gripped)
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
    )
    with live_hand(arguments) as hand:
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
    states = _states(source)
    hand, angle = own.hand, states["object.angle"]
    depth = np.zeros(angle.size)
    for name in own.scene.fingers:
        side = 1.0 if name == FINGERS[0] else -1.0
        lengths = 0.5 * hand.pivot_separation, hand.finger_length, hand.finger_offset
        tips = np.array([tip_position(q, side, *lengths) for q in states[f"{name}.q"]])
        x, y = tips.reshape(-1, 2).T
        depth += side * (x * np.cos(angle) + y * np.sin(angle))
    return states["mono_ns"] * 1e-9, depth
