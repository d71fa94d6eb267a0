"""Conformance checks for backend plugins.

The argument of each check contains the settings of a profile that uses the backend, for example
``check_tactile(load(Path("profile.toml")))``. The check creates the backend in the same way as the
daemon. If a check fails, it raises AssertionError with the found and expected values.
"""

from __future__ import annotations

import time

import numpy as np

from softfinger.daemon.clock import Clock, make_clock
from softfinger.daemon.loop.build import make_hand
from softfinger.daemon.profile.load import load
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.servos.base import Servos, make_servos
from softfinger.daemon.simulation.physics.plant_state import DISC
from softfinger.daemon.simulation.physics.shapes import Shape, polygon, shape_of
from softfinger.daemon.tactile.base import TactileSensor, make_sensor
from softfinger.daemon.types import FINGERS, Frame, Goal, Reading

__all__ = ["check_servos", "check_shape", "check_tactile", "load"]

_POLL = 1e-3  # poll interval [s], equal to a control tick


def check_tactile(settings: Settings, frames: int = 20, patience: float = 10.0) -> None:
    """Open each finger's tactile board twice, and check ``frames`` frames each time.

    Each time, the check waits up to ``patience`` [s] for the frames. The check does not require an
    object in the hand.
    """
    clock = make_clock(settings)
    hand = make_hand(settings, clock.now())
    for name in settings.scene.fingers:
        sensor = make_sensor(settings, clock, hand, FINGERS.index(name))
        assert sensor is not None, "tactile.backend: found none, expected a board"
        for _ in range(2):  # The daemon reopens a board whose port was lost.
            sensor.open()
            try:
                _check_frames(settings, clock, sensor, frames, time.monotonic() + patience)
                _check_counters(sensor)
            finally:
                sensor.close()
            sensor.latest()  # After `close`, `latest` must not raise an exception.
        sensor.close()


def _check_frames(
    settings: Settings, clock: Clock, sensor: TactileSensor, frames: int, deadline: float
) -> None:
    shape = (settings.tactile.rows, settings.tactile.cols)
    last: Frame | None = None
    kept = np.zeros(shape, np.uint16)
    for count in range(frames):
        while (frame := sensor.latest()) is last or frame is None:
            assert time.monotonic() < deadline, (
                f"found {count} frames within the test time, expected {frames}"
            )
            clock.sleep_until(clock.now() + _POLL)
        assert isinstance(frame, Frame), f"found {type(frame).__name__}, expected a Frame"
        found = f"{frame.data.dtype} {frame.data.shape}"
        assert found == f"uint16 {shape}", f"found data {found}, expected uint16 {shape}"
        assert frame.t_sample <= frame.t_arrival, "found a frame that arrived before its scan"
        assert frame.t_arrival <= clock.now() + _POLL, (
            "found a frame with an arrival time in the future"
        )
        if last is not None:
            assert frame.seq > last.seq, f"found seq {frame.seq} after seq {last.seq}"
            assert frame.t_arrival >= last.t_arrival, (
                "found a frame that arrived before the previous frame"
            )
            assert (last.data == kept).all(), (
                "found a frame that was modified after it was returned"
            )
        last, kept = frame, frame.data.copy()


def check_servos(settings: Settings, torque: bool = False, patience: float = 2.0) -> None:
    """Connect to the servos twice, and read the servos each time.

    If ``torque`` is True, the check also switches the torque on at the current position, and then
    off. While torque is on, the joints must not move by more than 0.05 rad. ``patience`` [s] is the
    maximum duration of each wait.
    """
    clock = make_clock(settings)
    servos = make_servos(settings, clock, make_hand(settings, clock.now()))
    assert servos is not None, "servos.backend: found none, expected servos"
    for _ in range(2):  # The daemon reconnects to servos that have stopped replying.
        servos.connect()
        try:
            reading = Reading()
            _read(servos, clock, reading, patience)
            first, seq = list(reading.q), reading.seq
            _read(servos, clock, reading, patience)
            assert reading.seq > seq, f"found seq {reading.seq} after seq {seq}"
            assert reading.t <= clock.now() + _POLL, "found a reading with a time in the future"
            assert np.isfinite([*reading.q, *reading.dq, *reading.current]).all(), "found NaN"
            _check_counters(servos)
            if torque:
                servos.torque_on()
                servos.write(Goal(q=list(reading.q), current=[0.1, 0.1], valid=True))
                _read(servos, clock, reading, patience)
                moved = np.abs(np.subtract(reading.q, first)).max()
                assert moved < 0.05, (
                    f"the joints moved by {moved:.3g} rad when torque was switched on"
                )
            deadline = time.monotonic() + patience
            while not servos.torque_off(reading):
                assert time.monotonic() < deadline, (
                    "torque off was not confirmed within the test time"
                )
        finally:
            servos.close()
    servos.close()


def _read(servos: Servos, clock: Clock, reading: Reading, patience: float) -> None:
    deadline = time.monotonic() + patience
    reading.valid = False
    while not reading.valid:
        assert time.monotonic() < deadline, "no valid reading arrived within the test time"
        clock.sleep_until(clock.now() + _POLL)
        servos.read(reading)


def _check_counters(backend: Servos | TactileSensor) -> None:
    counters = backend.counters()
    wrong = {k: v for k, v in counters.items() if not (isinstance(k, str) and type(v) is int)}
    assert not wrong, f"found counters {wrong}, expected names and whole numbers"


def check_shape(settings: Settings) -> None:
    """Check the properties of the object's shape against values computed from the corners."""
    shape = shape_of(settings)
    assert isinstance(shape, Shape), f"found {type(shape).__name__}, expected a Shape"
    if shape.kind == DISC:
        assert shape.roundness > 0.0, "found a disc without a radius"
        return
    sound = polygon(shape.corners)
    away = float(np.abs(sound.corners - shape.corners).max())
    assert away <= 1e-9, f"found a centre of mass {away:.3g} m from the origin"
    for name in ("gyration", "mean_radius"):
        found, expected = getattr(shape, name), getattr(sound, name)
        assert abs(found - expected) <= 1e-6 * expected, (
            f"{name}: found {found:g} m, expected {expected:g} m"
        )
