"""Run ``softfinger calibrate``: perform one calibration step for the hand or for one tip."""

from __future__ import annotations

import argparse
import sys
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.daemon.client.hand import Hand
from softfinger.daemon.client.stream import read
from softfinger.daemon.wire.schema import STATE, HandState
from softfinger.tools.arguments import add_daemon, add_profile, number, profile
from softfinger.tools.extras import MissingExtra
from softfinger.tools.recordings.reader import Recording

if TYPE_CHECKING:
    from softfinger.daemon.profile.settings import Settings

# Steps that change the profile, and steps that calibrate a single tip.
_OF_PROFILE = ("joints", "heat", "friction", "latency")
_OF_TIP = ("tare", "equilibrate", "curve", "centre", "modulus", "law", "relaxation", "scales")
# Fraction of the prior standard deviation. If a sensor gain's standard deviation exceeds this
# fraction, the gain has never been measured in a grip.
_LEARNT = 0.8
# Minimum relative standard deviation of each stored factor, because rubber and joints change from
# day to day.
_LEAST = 0.02
_EPILOG = """\
steps for a hand; FILE is a profile; if it does not exist, the --config profile is copied to FILE:
  joints       servo, direction, zero and range of each finger; you close, open and straighten each
               finger by hand while torque is off
  heat         temperature rise and time constant of one servo (--finger); requires a recording of a
               grip that starts with a cold servo and lasts several minutes
  friction     friction of each joint without contact; the running daemon sweeps the joint back and
               forth, or you give a recording of such a motion
  latency      frame latency; the running daemon grasps an object with several forces (--force sets
               the first force), or you give a recording of such a grip

steps for a tip, in this order; each step except relaxation adds its result to FILE:
  tare         zero offset of each cell, noise, noise correlation, drift; the tip must be unloaded
  equilibrate  gain of each cell, and dead cells; requires several uniform pressures
  curve        pressure versus count; requires known weights placed upright on the tip (--force), or
               a run with known displacement (--d)
  centre       position and rotation of the tip; requires upright presses, or presses at known tilts
               (--theta)
  modulus      E; requires a run with known displacement (--d); the zero offset of d is fitted
  law          comparison of springs and solid rubber: E, ν, goodness of fit and remaining error;
               requires presses at known depths and tilts (--d, --theta), or CSV files from a
               testing machine (--compression), which give E, or E versus d, from the force alone
  relaxation   initial stiffness of the rubber relative to its final stiffness, for the profile;
               requires a press held for a few seconds at a known d (--d, --frames 500)
  scales       correction factors for the tip's modulus, the sensor's gain and the joint's torque;
               requires grips of a running daemon, or a recording of such grips; the daemon then
               starts with these factors

Frames are read from the profile's sensor, one load after the other, or from recordings: one file
per load, or one .npz file of the whole run that contains d [m], theta [rad] and force [N] for each
frame. The values of --d, --theta and --force replace those of the file.
If you have no test stage, try the steps on `softfinger emulate`:
  --move "softfinger emulate --send 'press depth={d}mm tilt={theta}deg'"
  --move "softfinger emulate --send 'turn {finger}={pose}'"     for joints
If matplotlib is installed, the results of tare, equilibrate, curve, centre, modulus, law (only with
--compression) and relaxation are plotted in FILE.STEP.png.
Steps depend on earlier steps: repeating equilibrate removes the results of curve, modulus, law and
scales; repeating curve removes the results of modulus, law and scales; repeating modulus or law
removes the result of scales.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    parser.add_argument("step", choices=(*_OF_PROFILE, *_OF_TIP))
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="output file, created if it does not exist"
    )
    parser.add_argument("--finger", choices=("left", "right"), default="left")
    add_profile(parser)
    parser.add_argument(
        "--recording",
        type=Path,
        nargs="+",
        default=[],
        metavar="R",
        help="recordings to use instead of the live sensor",
    )
    parser.add_argument(
        "--compression",
        type=Path,
        nargs="+",
        default=[],
        metavar="CSV",
        help="law: files with d and F, or with strain and stress; the header states the units; for "
        "files without a tilt column, --theta gives the tilt",
    )
    parser.add_argument(
        "--frames", type=_frames, default=64, help="number of live frames per load (default 64)"
    )
    parser.add_argument(
        "--loads", type=int, default=1, help="equilibrate, live: number of pressures (default 1)"
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
        "--move",
        metavar="COMMAND",
        help="live: instead of waiting for Enter, run a program that applies one load and then "
        "exits; {force}, {d} and {theta} are replaced by the load's values; for joints, {finger} "
        "and {pose} are replaced (pose: closed, open or zero)",
    )
    parser.add_argument("--no-plot", action="store_true", help="do not plot the result")
    add_daemon(parser)  # The `friction`, `latency` and `scales` steps use this option.


def run(arguments: argparse.Namespace) -> int:
    """Run one step. Raises SoftfingerError or OSError; the file is then unchanged."""
    step = arguments.step
    if arguments.compression and step != "law":
        from softfinger.kinematics.calibration.calibration import CalibrationError

        raise CalibrationError(
            f"--compression: found the `{step}` step, but only the `law` step uses this option"
        )
    arguments.file.parent.stat()  # Report a missing folder before the user applies any loads.
    if step in _OF_PROFILE and arguments.config is None:
        arguments.config = arguments.file
    settings = profile(arguments)
    if step in _OF_PROFILE:
        told = _calibrate_profile(arguments, settings)
    elif step == "scales":
        told = calibrate_scales(arguments, settings)
    else:
        told = _calibrate_tip(arguments, settings)
    written = "" if step == "relaxation" else f"; written to {arguments.file}"
    print(f"{step}: {told}{written}")
    return 0


def _calibrate_profile(arguments: argparse.Namespace, settings: Settings) -> str:
    from softfinger.tools.calibration.joints import calibrate_heat, calibrate_joints
    from softfinger.tools.calibration.motion import calibrate_friction, calibrate_latency

    steps = {
        "joints": calibrate_joints,
        "heat": calibrate_heat,
        "friction": calibrate_friction,
        "latency": calibrate_latency,
    }
    return steps[arguments.step](arguments, settings)


def _calibrate_tip(arguments: argparse.Namespace, settings: Settings) -> str:
    from softfinger.daemon.perception.calibration_file import save_calibration
    from softfinger.tools.calibration.calibration_frames import gather
    from softfinger.tools.calibration.calibration_plot import draw
    from softfinger.tools.calibration.steps import Step, begin, done

    file = arguments.file
    calibration = begin(arguments, settings)
    if arguments.compression:
        from softfinger.tools.calibration.compression import fit_files

        calibration, line, panels = fit_files(
            calibration, settings, arguments.compression, arguments.theta
        )
    else:
        loads = gather(arguments, settings, calibration)
        calibration, line, panels = done(Step(arguments, settings, calibration, loads))
    if arguments.step != "relaxation":  # Its result is only printed, for the profile.
        save_calibration(file, calibration)
    if panels and not arguments.no_plot:
        try:
            draw(arguments.step, panels, file.with_name(f"{file.stem}.{arguments.step}.png"))
        except (MissingExtra, OSError) as error:
            print(f"calibrate: the result was not plotted: {error}", file=sys.stderr)
    return line


def _frames(text: str) -> int:
    return int(number("at least one frame", 1.0, includes_low=True)(text))


def calibrate_scales(arguments: argparse.Namespace, settings: Settings) -> str:
    """Write a finger's calibration factors to the calibration file; return a summary line.

    The sensor gain changes whenever the sensor is remounted, and the tip modulus may be known only
    roughly. Gain and modulus are estimated during a grip (`daemon.perception.hand_state`). A daemon
    that starts with the stored factors reaches the correct force in its first grip.

    Raises CalibrationFileError, NoStream if there is no daemon, or CalibrationError if the factors
    have not been measured in a grip.
    """
    from softfinger.daemon.perception.calibration_file import ScalesStep, now, save_calibration
    from softfinger.kinematics.calibration.calibration import CalibrationError
    from softfinger.tools.calibration.steps import begin

    calibration = begin(arguments, settings)
    state = _last_state(arguments)
    contact = getattr(state, arguments.finger)
    error, limit = contact.sensor_gain_std, _LEARNT * settings.tactile.gain_error
    if not error < limit * contact.sensor_gain:
        raise CalibrationError(
            f"scales: found a gain of {contact.sensor_gain:.2f} ± {error:.2f}, expected a standard "
            f"deviation of less than {limit:.0%} of the gain: first grasp an object firmly"
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
    return f"{', '.join(told)}, relative to the settings"


def _last_state(arguments: argparse.Namespace) -> HandState:
    from softfinger.kinematics.calibration.calibration import CalibrationError

    if not arguments.recording:
        with Hand(*arguments.address, keys=arguments.keys) as hand:
            return hand.state()
    path = arguments.recording[-1]
    last = deque(Recording(path).messages({STATE}), maxlen=1)
    if not last:
        raise CalibrationError(f"{path}: the recording does not contain {STATE.decode()}")
    return read(HandState, last[0][1])


def _known(mean: float, std: float) -> tuple[float, float]:
    return mean, max(std / mean, _LEAST)
