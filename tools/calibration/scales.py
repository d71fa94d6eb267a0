"""`calibrate scales`: keep what a running daemon's grips, or a recording's, told of one finger.

Sensor gains change when a sensor is mounted again, and a tip's modulus may be known from nothing
but its rubber's name: grips tell both (`daemon.perception.scales`), and a daemon that begins with
what they told grips right the first time.
"""

from __future__ import annotations

import argparse
from collections import deque

from softfinger.daemon.client.hand import Hand
from softfinger.daemon.client.stream import read
from softfinger.daemon.perception.calibration_file import ScalesStep, now, save_calibration
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.wire.schema import STATE, HandState
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.tools.calibration.steps import begin
from softfinger.tools.recordings.reader import Recording

_LEARNT = 0.8  # of the settings' doubt about a sensor's gain: with more, no grip has told of it
_LEAST = 0.02  # relative, of each scale: rubber and joints are not the same from day to day


def calibrate_scales(arguments: argparse.Namespace, settings: Settings) -> str:
    """Write a finger's scales into its file and return the line to print.

    Raises CalibrationError where no grip has told of them, NoStream without a daemon, and
    CalibrationFileError.
    """
    calibration = begin(arguments, settings)
    state = _last_state(arguments)
    contact = getattr(state, arguments.finger)
    if not contact.sensor_gain_std < _LEARNT * settings.tactile.gain_error * contact.sensor_gain:
        raise CalibrationError(
            f"scales: found a gain known to {contact.sensor_gain_std:.2f}, expected better than "
            f"{_LEARNT * settings.tactile.gain_error:.2f}: grasp something firmly first"
        )
    step = ScalesStep(
        date=now(),
        modulus=_known(contact.modulus_scale, contact.modulus_scale_std),
        gain=_known(contact.sensor_gain, contact.sensor_gain_std),
        torque=_known(contact.torque_scale, contact.torque_scale_std),
    )
    save_calibration(arguments.file, calibration.model_copy(update={"date": now(), "scales": step}))
    told = [
        f"{name} {mean:.3f} ± {mean * error:.3f}"
        for name, (mean, error) in step.model_dump(exclude={"date"}).items()
    ]
    return f"{', '.join(told)} of what is set"


def _last_state(arguments: argparse.Namespace) -> HandState:
    if not arguments.recording:
        with Hand(arguments.address, keys=arguments.keys) as hand:
            return hand.state()
    path = arguments.recording[-1]
    last = deque(Recording(path).messages({STATE}), maxlen=1)
    if not last:
        raise CalibrationError(f"{path}: no {STATE.decode()} in it")
    return read(HandState, last[0][1])


def _known(mean: float, std: float) -> tuple[float, float]:
    return mean, max(std / mean, _LEAST)
