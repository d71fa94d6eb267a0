"""Run ``softfinger emulate``, the process of an emulated hand: arguments, signals, exit status."""

from __future__ import annotations

import argparse
import contextlib
import gc
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.daemon.errors import SettingsError, SoftfingerError
from softfinger.daemon.own_files import runtime_fault
from softfinger.tools.arguments import add_settings, own_runtime_folder, profile
from softfinger.tools.stop_condition import Interrupted, Signals

if TYPE_CHECKING:
    from softfinger.daemon.profile.settings import Settings

_FAULTS = """\
faults, each KIND[=VALUE][@START], any number of them:
  tactile boards   torn, noisy (=PROBABILITY a frame), silent, frozen, wrong-size, saturated, zero;
                   on both boards, or on one: left:silent, right:torn=0.2
  to the servos    lose, lose-writes =PROBABILITY that an instruction does not reach any servo
  servo replies    drop, late, truncate, corrupt, duplicate =PROBABILITY; delay=S for every reply
  servos           silent, answer, reboot, overheat, overload, undervoltage =ID; readings: stuck
                   (constant angle, velocity and current 0), jump (by 0.2 rad), frozen (all
                   registers constant, including time), refuse (errors only); recover =ID
  ports            unplug, plug for the port of the servos; left:unplug, right:plug … for a board
  measurements     wrong values while the hand itself is unchanged; on both fingers, or on one:
                   left:gain=0.5. gain=FACTOR of all pressures, shift-x, shift-y=CELLS of the image,
                   mirror=1 (columns reversed), drift=FRACTION of the largest count (may be
                   negative), replay=S (repeats the last S seconds of frames, at most 3, with new
                   numbers), current=FACTOR of the reported current; to end: factors 1, others 0
  the object       push=N along its faces, away from the palm, twist=N·m; 0 ends it
  recovery         well ends all faults, left:well those of one board and its measurements. Loads of
                   the object stay, and hardware errors of servos until a reboot
  @START           start time [s], by default at once. gain=0.5@3..5: a measurement changes linearly
                   from 3 to 5 s

softfinger emulate --send "drop=0.01 left:frozen@2" changes a running emulator, through DIR/control.

a plate on a stage, which presses a tip instead of the object, for trying `calibrate`:
  --send "press PRESSES", which returns when the plate has arrived
  PRESSES are separated by commas; each consists of some of these words:
    depth=4mm      or force=5N; or pressure=10kPa on all cells, as from a bladder; depth=0mm lifts
    tilt=10deg     tilt of the plate (0)
    speed=2mm/s    approach speed (5)
    hold=1s        hold, then lift; without it the last press stays, and others are held for 1 s
    tip=left       or right (both)
  The log shows the force on a tip when a plate has come to rest. Plates do not act on the joints.

a person's hand, which turns joints without torque, for trying `calibrate joints`:
  --send "turn left=closed right=open"   each to its stop, or upright with zero; returns on arrival

the object, after it slipped away: --send place puts it back, at rest and without a load.

the record of the servo bus, for tests of a daemon: --send report prints it as JSON, --send forget
starts a new record, and --send "report forget" does both without a gap:
  t, monotonic     current time of the hand [s], and time.monotonic() at that time
  servos           left first, for each:
    id, torque, mode, q, hardware_error, watchdog (time-out [s], 0 if it is not armed, null after it
                   stopped the motor), stopped_by_watchdog: current state
    goal_q, goal_current
                   smallest and largest goal received [rad, A; positive closes], including refused
                   ones; null without goals; goals near the position of a limp joint are omitted
    goals_refused  number of writes with a goal that the servo refused
    torque_on      count, t of the last; far: number of times the goal was more than 0.05 rad away,
                   farthest [rad]
    quiet, longest_quiet
                   time since the last instruction with torque on (null while it is off), and the
                   longest such time [s]
    watchdog_fired count, t of the last
  object           current pose (x, y [m], angle [rad])
  force            current force on each tip [N], left first
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _FAULTS
    parser.add_argument(
        "--dir",
        type=Path,
        metavar="DIR",
        help="your own folder for the links servos, tactile-left, tactile-right; made if absent "
        "(default: a folder in your runtime folder)",
    )
    add_settings(parser)
    parser.add_argument("--model", metavar="NAME", help="model of the servos")
    parser.add_argument(
        "--ids",
        type=_ids,
        metavar="L,R",
        help="IDs of the servos, left first; with 1,1 both answer at once, like factory-new servos",
    )
    parser.add_argument(
        "--baud",
        type=int,
        default=0,
        metavar="N",
        help="servos answer only at this baud rate, with its transmission time; "
        "0: at any rate and without delay (default)",
    )
    parser.add_argument(
        "--factory",
        action="store_true",
        help="factory-new servos: position mode, 500 µs return delay; complete with "
        "--baud 57600 --ids 1,1",
    )
    parser.add_argument(
        "--send",
        metavar="WORDS",
        help="send faults or requests (see below) to the emulator that runs in DIR, then exit",
    )
    parser.add_argument(
        "--fault", action="append", default=[], metavar="FAULT", help="a fault; see below"
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
    """Emulate until SIGINT, SIGTERM or SIGHUP. Return 1 after a message if the set-up fails."""
    arguments.dir = arguments.dir or own_runtime_folder()
    if arguments.dir is None:
        raise SettingsError(f"{runtime_fault()}; or name another folder with --dir")
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
    # The following imports are slow (numpy, numba), so settings errors are reported earlier.
    from softfinger.daemon.loop.realtime import RealTime

    gc.disable()  # Garbage collection during imports would take a tenth of the start-up time.
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
        with signals.deferred():
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
            emulator.run(lambda: print(_ready(emulator.ports), end="", flush=True))
    return 0


@contextlib.contextmanager
def emulator_process(*words: object) -> Iterator[subprocess.Popen[str]]:
    """Run `softfinger emulate` with the arguments ``words``; yield the process once it is ready.

    Raises NoEmulator if the process ends before it is ready. The process prints its error message
    to standard error.
    """
    from softfinger.daemon.simulation.emulator.folder import NoEmulator

    # With -P, a folder named softfinger in the working directory is not imported.
    command = [sys.executable, "-P", "-m", "softfinger", "emulate", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline() != "ready\n":
                raise NoEmulator(f"{' '.join(command[3:])}: ended, see its message above")
            yield process
        finally:
            process.terminate()


def _ready(ports: dict[str, Path]) -> str:
    """Return the output of a ready emulator as one text, since readers may wait for its end."""
    return "".join(["ready\n", *(f"{name}: {path}\n" for name, path in ports.items())])


def _unhurried(settings: Settings, paced: bool) -> Settings:
    """Return the settings with real-time options that are suitable for a pseudo-terminal.

    SCHED_FIFO is not used, because it delays the kernel worker that transfers the bytes. Idle
    states are disabled only if the servos reproduce the wire timing, which requires very short
    sleeps.
    """
    changes = {"priority": 0, "cpus": (), "spin": 0.0, "lock_memory": False}
    held = paced and settings.realtime.hold_latency
    realtime = settings.realtime.model_copy(update={**changes, "hold_latency": held})
    loop = settings.loop.model_copy(update={"clock": "real"})
    return settings.model_copy(update={"realtime": realtime, "loop": loop})


def _send(folder: Path, words: str) -> int:
    from softfinger.daemon.simulation.emulator.folder import carry_out

    try:
        reply = carry_out(folder, words)
    except SoftfingerError as error:
        print(f"softfinger: {error}", file=sys.stderr)
        return 1
    if reply:
        print(reply)
    return 0
