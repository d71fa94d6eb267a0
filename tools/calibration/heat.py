"""`calibrate heat`: a servo's thermal constants, from the recording of a hold of minutes."""

from __future__ import annotations

import argparse

from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.safety.heat import set_law
from softfinger.kinematics.calibration.calibration import CalibrationError
from softfinger.kinematics.calibration.heat_fit import fit_heat
from softfinger.kinematics.hand.servo_heat import HeatLaw
from softfinger.tools.calibration.joints import write_keys
from softfinger.tools.recordings.reader import read_recording


def calibrate_heat(arguments: argparse.Namespace, settings: Settings) -> str:
    """Write the constants into the profile and return what was found.

    Raises CalibrationError without a recording or for too short a hold, RecordingError,
    SettingsError.
    """
    if len(arguments.recording) != 1:
        raise CalibrationError(
            "heat: expected --recording with one hold, made by softfinger record"
        )
    found = read_recording(arguments.recording[0])
    law, finger = HeatLaw(), arguments.finger
    own = settings.model_copy(
        update={"servos": settings.servos.model_copy(update={"heat_rise": 0.0, "heat_time": 0.0})}
    )
    rise, time = set_law(law, own)
    known = found[f"{finger}.temperature"] > 0.0
    fit = fit_heat(
        law, *(found[key][known] for key in ("t", f"{finger}.current", f"{finger}.temperature"))
    )
    new = {"heat_rise": round(rise * fit.rise, 3), "heat_time": round(time * fit.time, 1)}
    write_keys(arguments, {"servos": new})
    return (
        f"{new['heat_rise']:.1f} ± {rise * fit.rise_std:.1f} K/A² in {new['heat_time']:.0f} ± "
        f"{time * fit.time_std:.0f} s, {fit.residual:.1f} °C left"
    )
