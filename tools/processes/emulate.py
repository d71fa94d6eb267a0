"""Run ``softfinger emulate``, the process of an emulated hand: arguments, signals, exit status."""

from __future__ import annotations

import argparse
import contextlib
import gc
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.own_files import runtime_fault
from softfinger.tools.arguments import add_settings, own_runtime_folder, profile
from softfinger.tools.ending import Interrupted, Signals

if TYPE_CHECKING:
    from softfinger.daemon.profile.settings import Settings

_LOOK = 0.1  # s between two queries about the motion of a plate or joint
_FAULTS = """\
faults, each KIND[=VALUE][@START], given as often as needed:
  tactile boards   torn, noisy (=PROBABILITY a frame), silent, frozen, wrong-size, saturated, zero;
                   both boards, or one: left:silent, right:torn=0.2
  to the servos    lose, lose-writes =PROBABILITY that an instruction reaches none of them
  servo replies    drop, late, truncate, corrupt, duplicate =PROBABILITY; delay=S for every reply
  servos           silent, answer, reboot, overheat, overload, undervoltage =ID; their readings:
                   stuck (angle stands, velocity and current read 0), jump (by 0.2 rad), frozen
                   (all registers stand, their time too), refuse (an error for each); recover =ID
  ports            unplug, plug for the servos'; left:unplug, right:plug … for a board's
  measurements     which are wrong while the hand is as it was; of both fingers, or left:gain=0.5:
                   gain=FACTOR of all pressures, shift-x, shift-y=CELLS of the image, mirror=1 (its
                   columns in reverse), drift=SHARE of the largest count (below 0, too), replay=S
                   (the last S seconds of frames, 3 at most, again and again with new numbers),
                   current=FACTOR of what a servo reports; back with 1, 1 for factors and 0 else
  the object       push=N along its faces, away from the palm, twist=N·m; 0 ends it
  all well again   well for the servos' line, boards and measurements, left:well for one finger's
  @START           when it starts [s]; at once without. gain=0.5@3..5: a measurement goes wrong
                   evenly from 3 to 5 s

softfinger emulate --send "drop=0.01 left:frozen@2" changes a running one, by DIR/control.

a plate on a stage, which presses a tip instead of the object, so that `calibrate` can be tried:
  --send "press PRESSES", which returns when the plate is there
  PRESSES are separated by commas, each some of these words:
    depth=4mm      or force=5N; or pressure=10kPa on all cells, as by a bladder; depth=0mm lifts off
    tilt=10deg     of the plate (0)
    speed=2mm/s    of the way there (5)
    hold=1s        then it lifts off; a last press without it stays, others rest for 1 s
    tip=left       or right (both)
  The log says what a tip feels where a plate has come to rest. The joints don't feel it.

a person's hand, which turns joints without torque, so that `calibrate joints` can be tried:
  --send "turn left=closed right=open"   each to its stop, or upright with zero; ends when there

the object, where it slipped away: --send place puts it back, at rest and without a load.

what was on the servos' wire, for tests of a daemon: --send report prints it as JSON, --send forget
begins the record again, --send "report forget" does both without a gap:
  t, monotonic     the hand's time now [s], and time.monotonic() then
  servos           left first, of each:
    id, torque, mode, q, hardware_error, watchdog (time armed for [s], 0 when it is not, null after
                   it stopped the motor), stopped_by_watchdog: the state now
    goal_q, goal_current
                   least and greatest goal that came [rad, A; positive closes], refused ones too;
                   null when none came; goals near where a limp joint is are left out
    goals_refused  how many writes with a goal the servo refused
    torque_on      count, t of the last; far: how often the goal was more than 0.05 rad away,
                   farthest [rad]
    quiet, longest_quiet
                   time since the last instruction with torque on, null while it is off, and the
                   longest such [s]
    watchdog_fired count, t of the last
  object           pose (x, y [m], angle [rad]) now
  force            what presses each tip now [N], left first
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _FAULTS
    parser.add_argument(
        "--dir",
        type=Path,
        metavar="DIR",
        help="where servos, tactile-left and tactile-right are linked, a folder of your own, made "
        "if absent; without it one in your runtime folder",
    )
    add_settings(parser)
    parser.add_argument("--model", metavar="NAME", help="the servos' model")
    parser.add_argument(
        "--ids",
        type=_ids,
        metavar="L,R",
        help="the servos' IDs, left first; 1,1 lets both answer at once, as factory-new ones do",
    )
    parser.add_argument(
        "--baud",
        type=int,
        default=0,
        metavar="N",
        help="servos take the wire's time at this rate and hear no other; "
        "0 answers at once and at any rate (default)",
    )
    parser.add_argument(
        "--factory",
        action="store_true",
        help="servos as they leave the factory: position mode, 500 µs return delay; in all with "
        "--baud 57600 --ids 1,1",
    )
    parser.add_argument(
        "--send",
        metavar="WORDS",
        help="send words to the emulator that runs in DIR: faults that begin, or a request for a "
        "report; then end",
    )
    parser.add_argument(
        "--fault", action="append", default=[], metavar="FAULT", help="what goes wrong; see below"
    )


def _ids(text: str) -> tuple[int, ...]:
    try:
        ids = tuple(int(part) for part in text.split(","))
    except ValueError:
        ids = ()
    if len(ids) != 2 or not all(0 <= each <= 252 for each in ids):
        raise argparse.ArgumentTypeError(f"expected two IDs of 0 to 252 such as 1,2, found {text}")
    return ids


def run(arguments: argparse.Namespace) -> int:
    """Emulate until SIGINT, SIGTERM or SIGHUP; return 1 with a message if the set-up fails."""
    arguments.dir = arguments.dir or own_runtime_folder()
    if arguments.dir is None:
        raise SettingsError(f"{runtime_fault()}; or name another folder by --dir")
    if arguments.send is not None:
        return _send(arguments.dir, arguments.send)
    if arguments.model is not None:
        arguments.set = [*arguments.set, f"servos.model={arguments.model}"]
    settings = profile(arguments)
    signals = Signals()
    try:
        return _serve(settings, arguments, signals)
    except Interrupted:
        return 0


def _serve(settings: Settings, arguments: argparse.Namespace, signals: Signals) -> int:
    # The following imports load numpy and numba; report wrong settings before this delay.
    from softfinger.daemon.loop.realtime import RealTime

    gc.disable()  # garbage collections during imports take a tenth of the start-up time
    from softfinger.daemon.loop.warm_up import EMULATED
    from softfinger.daemon.simulation.emulator.emulator import (
        EmulatedServos,
        Emulator,
        EmulatorError,
        with_board,
    )
    from softfinger.tools.processes.compile import build_kernels, print_event

    build_kernels(with_board(settings), print_event, EMULATED)
    servos = EmulatedServos(arguments.baud, arguments.factory, arguments.ids)
    with contextlib.ExitStack() as made:
        with signals.held():
            try:
                emulator = Emulator(
                    settings,
                    arguments.dir,
                    servos=servos,
                    faults=arguments.fault,
                    tell=lambda line: print(line, file=sys.stderr, flush=True),
                )
            except (EmulatorError, SettingsError) as error:
                print(f"softfinger: {error}", file=sys.stderr)
                return 1
            made.callback(emulator.close)
        signals.hand_over(emulator.end)
        with RealTime(_unhurried(settings, arguments.baud > 0)):
            emulator.run(lambda: print("ready", flush=True))
    return 0


def _unhurried(settings: Settings, paced: bool) -> Settings:
    """Return the settings with the real-time measures that suit a pseudo-terminal.

    SCHED_FIFO is not used, because it delays the kernel worker that transfers the bytes. Idle
    states are disabled only if the servos reproduce wire timing, because they then sleep for times
    as short as on a wire.
    """
    changes = {"priority": 0, "cpus": (), "spin": 0.0, "lock_memory": False}
    held = paced and settings.realtime.hold_latency
    realtime = settings.realtime.model_copy(update={**changes, "hold_latency": held})
    loop = settings.loop.model_copy(update={"clock": "real"})
    return settings.model_copy(update={"realtime": realtime, "loop": loop})


def _send(folder: Path, words: str) -> int:
    from softfinger.daemon.simulation.emulator.folder import NoEmulator, send_words

    try:
        reply = send_words(folder, words)
        # The motion is timed by the emulated hand's clock, which stops while the emulator is
        # suspended, so ask again for the remaining time.
        kind = words.partition(" ")[0]
        while kind in ("press", "turn") and reply.startswith("{"):
            left = json.loads(reply)["wait"]
            if left == 0.0:
                return 0
            time.sleep(min(left, _LOOK))
            reply = send_words(folder, kind)
    except NoEmulator as error:
        reply = f"error: {error}"
    if reply.startswith("error: "):
        print(f"softfinger: {reply.removeprefix('error: ')}", file=sys.stderr)
        return 1
    if reply != "ok":
        print(reply)
    return 0
