"""``softfinger calibrate``: one step of calibrating the sensor under one tip, and its file.

Arguments, and the way from frames to a step's result. The mathematics is in
`estimation.calibration`, the file in `perception.calibration_file`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softfinger.daemon.errors import SettingsError, SoftfingerError
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import add_profile, profile

if TYPE_CHECKING:
    from softfinger.daemon.perception.calibration_file import Calibration, Converter
    from softfinger.tools.calibration.calibration_frames import Loads

STEPS = ("tare", "equilibrate", "curve", "centre", "modulus")
_EPILOG = """\
steps, in this order; each goes into FILE, where the others stay:
  tare         unloaded: the zero of each cell
  equilibrate  several uniform pressures: what makes the cells alike, which are dead
  curve        known weights upright on the tip (--force), or a run of known displacement (--d)
  centre       presses upright or of known tilt (--theta): where the tip stands, the rotation
  modulus      a run of known displacement (--d): E, or with --law the curve stress over strain

Frames come live from the sensor of the profile, load by load, or from recordings: one for each
load, or one .npz of the whole run with its own d [m], theta [rad], force [N] for each frame.
A live modulus may come from one press at a known speed (--speed): its zero of d is fitted.
Each step draws what it found and what is left over beside FILE, where matplotlib is installed.
A new equilibrate drops curve and modulus, a new curve drops modulus: they were made with the old.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``calibrate``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EPILOG
    parser.add_argument("step", choices=STEPS)
    parser.add_argument("file", type=Path, metavar="FILE", help="the calibration; made if absent")
    parser.add_argument("--finger", choices=("left", "right"), default="left")
    add_profile(parser)
    parser.add_argument(
        "--recording", type=Path, nargs="+", default=[], metavar="R", help="instead of the sensor"
    )
    parser.add_argument(
        "--frames", type=_frames, default=64, help="live frames a load (default 64)"
    )
    parser.add_argument(
        "--loads", type=int, default=0, help="equilibrate: how many pressures, live"
    )
    for name, unit in (("force", "N"), ("d", "mm"), ("theta", "degrees")):
        parser.add_argument(
            f"--{name}",
            type=float,
            nargs="+",
            default=[],
            metavar="X",
            help=f"of the loads [{unit}]",
        )
    parser.add_argument("--kind", choices=("power", "cubic"), default="power", help="of the curve")
    parser.add_argument("--law", action="store_true", help="modulus: the whole stress-strain curve")
    parser.add_argument(
        "--speed", type=_speed, metavar="X", help="modulus, live: of one press [mm/s], instead of d"
    )
    parser.add_argument(
        "--plot", type=Path, metavar="PICTURE", help="where to (default: FILE's name, .STEP.png)"
    )
    parser.add_argument("--no-plot", action="store_true", help="draw nothing")


def run(arguments: argparse.Namespace) -> int:
    """Do one step; 1 with one line when it can't be done, and then the file is as it was."""
    try:
        settings = profile(arguments)
    except SettingsError as error:
        print(error, file=sys.stderr)
        return 2
    from softfinger.daemon.errors import RecordingError, TactileError
    from softfinger.daemon.perception.calibration_file import save_calibration
    from softfinger.kinematics.estimation.calibration import CalibrationError
    from softfinger.tools.calibration.calibration_frames import gather

    try:
        if arguments.speed is not None and (arguments.step != "modulus" or arguments.d):
            raise CalibrationError("--speed: only modulus takes it, instead of --d")
        draw = _drawer(arguments)
        calibration = _begin(arguments, settings)
        loads = gather(arguments, settings, calibration)
        _check(loads, settings.tip.radius)
        calibration, line, picture = _STEP[arguments.step](arguments, settings, calibration, loads)
        save_calibration(arguments.file, calibration)
        print(f"{arguments.step}: {line}; written to {arguments.file}")
        if draw is not None:
            _draw(draw, arguments, picture)
    except (SettingsError, TactileError, RecordingError, CalibrationError, _NoPlot) as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return 1
    return 0


class _NoPlot(SoftfingerError):
    """The picture can't be drawn."""


def _speed(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= 1000.0:
        raise argparse.ArgumentTypeError(f"expected mm/s above 0, found {text}")
    return value


def _frames(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected at least one frame, found {text}")
    return value


def _check(loads: Loads, radius: float) -> None:
    """Raise CalibrationError for no loads, and for what is known of them and can't be."""
    import math

    import numpy as np

    from softfinger.kinematics.estimation.calibration import CalibrationError

    truths = loads.truths
    if not loads.frames:
        raise CalibrationError("no frame with d above 0 in this run")
    for name, values in truths.items():
        if not np.isfinite(values).all():
            raise CalibrationError(f"{name}: a value that is not finite")
    if "d" in truths and (deepest := float(truths["d"].max())) > radius:
        raise CalibrationError(
            f"d: {deepest * 1e3:g} mm is more than the tip's radius, {radius * 1e3:g} mm"
        )
    if "theta" in truths and (most := float(np.abs(truths["theta"]).max())) >= 0.5 * math.pi:
        raise CalibrationError(f"theta: {math.degrees(most):g}° is no tilt of a press")


def _drawer(arguments: argparse.Namespace) -> Any:
    """The function that draws, known to work before anything is measured; None to draw nothing.

    Without matplotlib a picture that was asked for is refused; else it is told, and left out.
    """
    if arguments.no_plot:
        return None
    from softfinger.tools.calibration.calibration_plot import draw
    from softfinger.tools.paper.style import NoMatplotlib, settings

    try:
        settings()
    except NoMatplotlib as error:
        if arguments.plot is not None:
            raise _NoPlot(f"--plot: {error}") from None
        print(f"calibrate: no picture is drawn: {error}", file=sys.stderr)
        return None
    return draw


def _draw(draw: Any, arguments: argparse.Namespace, picture: dict[str, Any]) -> None:
    file = arguments.file
    path = arguments.plot or file.with_name(f"{file.stem}.{arguments.step}.png")
    try:
        draw(arguments.step, picture, path)
    except (OSError, ValueError) as error:  # ValueError: a kind of picture that there isn't
        raise _NoPlot(f"{path}: no picture: {error}") from None


def _begin(arguments: argparse.Namespace, settings: Settings) -> Calibration:
    """The file's calibration, or a new one; refuses the file of another sensor."""
    from softfinger.daemon.perception.calibration_file import (
        Calibration,
        CalibrationFileError,
        difference,
        load_calibration,
        now,
        sensor_of,
    )

    sensor = sensor_of(settings, 0 if arguments.finger == "left" else 1)
    if not arguments.file.exists():
        return Calibration(sensor=sensor, date=now())
    calibration = load_calibration(arguments.file)
    wrong = difference(calibration.sensor, sensor)
    if wrong:
        raise CalibrationFileError(
            f"{arguments.file}: this is the calibration of another sensor: {wrong}"
        )
    return calibration


def _put(calibration: Calibration, **steps: Any) -> Calibration:
    from softfinger.daemon.perception.calibration_file import now

    return calibration.model_copy(update={"date": now(), **steps})


def _converter(settings: Settings, calibration: Calibration) -> Converter:
    from softfinger.daemon.perception.calibration_file import Converter

    return Converter(calibration, settings.tactile.pascal_per_count)


_Done = tuple["Calibration", str, dict[str, Any]]


def _tare(_: Any, settings: Settings, calibration: Calibration, loads: Loads) -> _Done:
    import numpy as np

    from softfinger.daemon.perception.calibration_file import TareStep, now
    from softfinger.kinematics.estimation.calibration import tare

    found = tare(np.concatenate(loads.frames))
    noise = float(np.median(found.noise))
    count = sum(map(len, loads.frames))
    step = TareStep(date=now(), zero=found.zero.tolist(), noise=noise, frames=count)
    line = f"{count} frames, zero up to {found.zero.max():.1f} counts, noise {noise:.2f} counts"
    return _put(calibration, tare=step), line, {"zero": found.zero, "noise": found.noise}


def _equilibrate(_: Any, settings: Settings, calibration: Calibration, loads: Loads) -> _Done:
    import numpy as np

    from softfinger.daemon.perception.calibration_file import EquilibrateStep, now
    from softfinger.kinematics.estimation.calibration import equilibrate

    zero = _converter(settings, calibration).zero
    found = equilibrate(loads.frames, zero)
    dead = int(np.count_nonzero(found.gain == 0.0))
    step = EquilibrateStep(
        date=now(),
        gain=found.gain.tolist(),
        dead=dead,
        spread=found.spread,
        residual=found.residual,
    )
    line = (
        f"{len(loads.frames)} pressures, cells differ by {found.spread:.2%} rms, after it by "
        f"{found.residual:.2%}; {dead} dead"
    )
    done = _put(calibration, equilibrate=step, curve=None, modulus=None)
    return done, line, {"gain": found.gain}


def _readings(settings: Settings, calibration: Calibration, loads: Loads) -> list[Any]:
    """Each load's mean reading, cleared of noise far from the contact."""
    import numpy as np

    from softfinger.kinematics.estimation.calibration import cleared

    converter = _converter(settings, calibration)
    noise = calibration.tare.noise if calibration.tare else 0.0
    spread = np.full(converter.zero.shape, noise)
    return [
        cleared(converter.readings(frames.mean(axis=0)), spread, len(frames))
        for frames in loads.frames
    ]


def _curve(
    arguments: argparse.Namespace, settings: Settings, calibration: Calibration, loads: Loads
) -> _Done:
    import numpy as np

    from softfinger.daemon.perception.calibration_file import CurveStep, now
    from softfinger.daemon.profile.factory import make_material, make_tip
    from softfinger.kinematics.estimation.calibration import CalibrationError, fit_curve
    from softfinger.kinematics.sensing.pressure_grid import SensorGrid

    sensor = calibration.sensor
    area = sensor.pitch[0] * sensor.pitch[1]
    force = loads.truths.get("force")
    if force is None:
        d = loads.truths.get("d")
        if d is None:
            raise CalibrationError("curve: expected --force or --d, or a run that has them")
        # The force that the profile's material makes, over all of its footprint.
        grid = SensorGrid(sensor.rows, sensor.cols, sensor.pitch)
        tip, material = make_tip(settings), make_material(settings.material)
        theta = loads.truths.get("theta", np.zeros(len(d)))
        force = np.array(
            [grid.pressure(tip, material, float(x), float(t)).sum() * area
             for x, t in zip(d, theta, strict=True)]
        )  # fmt: skip
    for k, frames in enumerate(loads.frames):
        if (frames >= sensor.full_count).any():
            raise CalibrationError(f"curve: load {k + 1} saturates a cell, which hides its force")
    readings = _readings(settings, calibration, loads)
    full = float(sensor.full_count) * max(
        map(max, calibration.equilibrate.gain) if calibration.equilibrate else [1.0]
    )
    found = fit_curve(arguments.kind, readings, force, area, full)
    step = CurveStep(
        date=now(), kind=found.kind, coefficients=found.coefficients, residual=found.residual
    )
    line = f"{found.kind} from {len(force)} loads, their forces met within {found.residual:.2%} rms"
    picture = {"force": force, "errors": found.errors}
    return _put(calibration, curve=step, modulus=None), line, picture


def _pressures(settings: Settings, calibration: Calibration, loads: Loads) -> Any:
    """Each load's mean pressure [Pa], [loads, rows, cols]."""
    import numpy as np

    converter = _converter(settings, calibration)
    return np.stack(
        [np.mean([converter(frame) for frame in frames], axis=0) for frames in loads.frames]
    )


def _centre(_: Any, settings: Settings, calibration: Calibration, loads: Loads) -> _Done:
    import math

    import numpy as np

    from softfinger.daemon.perception.calibration_file import CentreStep, now
    from softfinger.daemon.profile.factory import make_material, make_tip
    from softfinger.kinematics.estimation.calibration import fit_centre
    from softfinger.kinematics.sensing.pressure_grid import SensorGrid

    sensor, tactile = calibration.sensor, settings.tactile
    theta = loads.truths.get("theta", np.zeros(len(loads.frames)))
    found = fit_centre(
        _pressures(settings, calibration, loads),
        theta,
        make_tip(settings),
        make_material(settings.material),
        SensorGrid(sensor.rows, sensor.cols, sensor.pitch),
        tactile.noise,
        _converter(settings, calibration).live,
    )
    step = CentreStep(
        date=now(),
        centre=found.centre,
        rotation=found.rotation,
        scale=found.scale,
        residual=found.residual,
    )
    x, y = found.centre
    turned = (
        "rotation not measured: no press was tilted"
        if found.rotation is None
        else f"rotation {math.degrees(found.rotation):.2f}°, travel {found.scale:.3f} of the model"
    )
    line = f"tip at ({x * 1e3:.3f}, {y * 1e3:.3f}) mm; {turned}; {found.residual * 1e6:.0f} µm rms"
    return _put(calibration, centre=step), line, {"theta": theta, "centre": found}


def _modulus(
    arguments: argparse.Namespace, settings: Settings, calibration: Calibration, loads: Loads
) -> _Done:
    import numpy as np

    from softfinger.daemon.perception.calibration_file import ModulusStep, now
    from softfinger.daemon.perception.finger_model import calibrated_grid
    from softfinger.daemon.profile.factory import make_tip
    from softfinger.kinematics.estimation.calibration import CalibrationError, fit_law, fit_modulus

    d = loads.truths.get("d")
    if d is None:
        raise CalibrationError("modulus: expected --d, or a run that has d")
    theta = loads.truths.get("theta", np.zeros(len(d)))
    finger = 0 if calibration.sensor.finger == "left" else 1
    area = calibration.sensor.pitch[0] * calibration.sensor.pitch[1]
    readings = _readings(settings, calibration, loads)
    converter = _converter(settings, calibration)
    pressure = _pressures(settings, calibration, loads)
    force = np.array(
        [each[reading > 0.0].sum() for each, reading in zip(pressure, readings, strict=True)]
    )
    force *= area
    full = np.stack([(each >= calibration.sensor.full_count).any(axis=0) for each in loads.frames])
    whole = ~full.any(axis=(1, 2))  # a saturated cell hides a part of the force
    found = fit_modulus(d[whole], theta[whole], force[whole])
    line = (
        f"E = {found.modulus / 1e6:.4f} MPa from {np.count_nonzero(whole)} frames, zero of d at "
        f"{found.offset * 1e3:.3f} mm, force met within {found.residual:.2%} rms"
    )
    if not whole.all():
        line += f"; {np.count_nonzero(~whole)} frames left out, saturated"
    strain: list[float] = []
    stress: list[float] = []
    if arguments.law:
        grid = calibrated_grid(settings, finger, calibration)
        told = converter.live & ~full
        law = fit_law(pressure, d - found.offset, theta, make_tip(settings), grid, told)
        strain, stress = law.strain.tolist(), law.stress.tolist()
        line += f"; law of {len(strain)} points, cells {law.residual:.0f} Pa rms from it"
    step = ModulusStep(
        date=now(),
        modulus=found.modulus,
        strain=strain,
        stress=stress,
        offset=found.offset,
        residual=found.residual,
    )
    d, theta, force = d[whole], theta[whole], force[whole]
    picture = {"d": d, "theta": theta, "force": force, "fit": found, "law": (strain, stress)}
    return _put(calibration, modulus=step), line, picture


_STEP = {
    "tare": _tare,
    "equilibrate": _equilibrate,
    "curve": _curve,
    "centre": _centre,
    "modulus": _modulus,
}
