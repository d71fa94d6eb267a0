"""``softfinger calibrate``: one step of calibrating the joints or the sensor under one tip."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from softfinger.tools.arguments import add_keys, add_profile, number, profile, stream_address
from softfinger.tools.extras import MissingExtra, require

STEPS = (
    "joints",
    "heat",
    "tare",
    "equilibrate",
    "curve",
    "centre",
    "modulus",
    "law",
    "relaxation",
    "scales",
)
_EPILOG = """\
the joints; FILE is a profile, made of --config's if absent:
  joints       with torque off each finger is closed, opened and put upright by hand: its servo,
               direction, zero and range, of both
  heat         from the recording of a grip of some minutes, begun cold: by how much the servo of
               --finger warms, and how fast

steps of a tip, in this order; each is written into FILE, which keeps the others:
  tare         unloaded: the zero of each cell; its noise, how that correlates, and drift
  equilibrate  several uniform pressures: the gain of each cell, and dead cells
  curve        known weights upright on the tip (--force), or a run of known displacement (--d)
  centre       presses upright or of known tilt (--theta): the tip's place and rotation
  modulus      a run of known displacement (--d): E, or with --law the curve stress over strain
  law          presses at known depths and tilts (--d, --theta): springs or solid rubber, its E and
               ν, how well each explains the frames, and what error it leaves
  relaxation   a press and a hold of some seconds at a known d (--d, --frames 500): how much firmer
               the rubber is at once than in the end, for the profile
  scales       what a running daemon's grips, or a recording's, told of the tip's modulus, the
               sensor's gain and the joint's torque: the daemon begins with it next time

Frames come live from the sensor of the profile, load by load, or from recordings: one for each
load, or one .npz of the whole run with its own d [m], theta [rad], force [N] for each frame.
A live modulus may come from one press at a known speed (--speed): its zero of d is fitted.
Without a stage, try the steps on `softfinger emulate`:
  --move "softfinger emulate --send 'press depth={d}mm tilt={theta}deg'"
  --move "softfinger emulate --send 'turn {finger}={pose}'"     for joints
Each step draws its result and residuals beside FILE, where matplotlib is installed.
A new equilibrate removes curve and modulus, a new curve removes modulus, and each of these removes
scales: they depend on it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("step", choices=STEPS)
    parser.add_argument("file", type=Path, metavar="FILE", help="what is written; made if absent")
    parser.add_argument("--finger", choices=("left", "right"), default="left")
    add_profile(parser)
    parser.add_argument(
        "--recording",
        type=Path,
        nargs="+",
        default=[],
        metavar="R",
        help="recordings, instead of the live sensor",
    )
    parser.add_argument(
        "--frames", type=_frames, default=64, help="live frames of each load (default 64)"
    )
    parser.add_argument(
        "--loads", type=int, default=0, help="equilibrate, live: number of pressures"
    )
    for name, unit in (("force", "N"), ("d", "mm"), ("theta", "degrees")):
        parser.add_argument(
            f"--{name}",
            type=float,
            nargs="+",
            default=[],
            metavar="X",
            help=f"known {name} of each load [{unit}]",
        )
    parser.add_argument(
        "--kind",
        choices=("power", "cubic"),
        default="power",
        help="form of the curve (default power)",
    )
    parser.add_argument(
        "--law", action="store_true", help="modulus: fit the whole stress-strain curve"
    )
    parser.add_argument(
        "--speed",
        type=_speed,
        metavar="X",
        help="modulus, live: speed of one press [mm/s], instead of --d",
    )
    parser.add_argument(
        "--move",
        metavar="COMMAND",
        help="live: a program that brings each load on and ends when it is there, as of a stage, "
        "instead of Enter; {force}, {d} and {theta} stand for the load's, {finger} and {pose} "
        "(closed, open, zero) for a joint's",
    )
    parser.add_argument(
        "--plot", type=Path, metavar="PICTURE", help="the picture's file (default: FILE.STEP.png)"
    )
    parser.add_argument("--no-plot", action="store_true", help="draw no picture")
    parser.add_argument(
        "--address", type=stream_address, default="", help="scales: the daemon's stream"
    )
    add_keys(parser)


def run(arguments: argparse.Namespace) -> int:
    """Do one step. Raises SoftfingerError or OSError; then the file is unchanged."""
    joints = arguments.step == "joints"
    if (joints or arguments.step == "heat") and arguments.config is None:
        arguments.config = arguments.file
    settings = profile(arguments)
    if arguments.step == "heat":
        from softfinger.tools.calibration.heat import calibrate_heat

        print(f"heat: {calibrate_heat(arguments, settings)}; written to {arguments.file}")
        return 0
    if joints:
        from softfinger.tools.calibration.joints import calibrate_joints

        print(f"joints: {calibrate_joints(arguments, settings)}\n  written to {arguments.file}")
        return 0
    if arguments.step == "scales":
        from softfinger.tools.calibration.scales import calibrate_scales

        print(f"scales: {calibrate_scales(arguments, settings)}; written to {arguments.file}")
        return 0
    from softfinger.daemon.perception.calibration_file import save_calibration
    from softfinger.kinematics.calibration.calibration import CalibrationError
    from softfinger.tools.calibration.calibration_frames import gather
    from softfinger.tools.calibration.calibration_plot import draw
    from softfinger.tools.calibration.steps import Step, begin, done

    if arguments.speed is not None and (arguments.step != "modulus" or arguments.d):
        raise CalibrationError("--speed: only modulus takes it, instead of --d")
    draws = _draws(arguments)
    calibration = begin(arguments, settings)
    loads = gather(arguments, settings, calibration)
    calibration, line, picture = done(Step(arguments, settings, calibration, loads))
    save_calibration(arguments.file, calibration)
    print(f"{arguments.step}: {line}; written to {arguments.file}")
    if draws:
        file = arguments.file
        path = arguments.plot or file.with_name(f"{file.stem}.{arguments.step}.png")
        try:
            draw(arguments.step, picture, path)
        except ValueError as error:  # a suffix that is no kind of picture
            raise CalibrationError(f"{path}: no picture: {error}") from None
    return 0


def _draws(arguments: argparse.Namespace) -> bool:
    """Return whether a picture is drawn, known before anything is measured.

    Raises MissingExtra for ``--plot`` without matplotlib.
    """
    if arguments.no_plot:
        return False
    try:
        require("plot")
    except MissingExtra as error:
        if arguments.plot is not None:
            raise
        print(f"calibrate: no picture is drawn: {error}", file=sys.stderr)
        return False
    return True


def _speed(text: str) -> float:
    return number(text, "mm/s above 0, 1000 at most", 0.0, 1000.0)


def _frames(text: str) -> int:
    return int(number(text, "at least one frame", 1.0, includes_low=True))
