"""Run ``softfinger emulate``: parse arguments, handle signals and return the exit status."""

from __future__ import annotations

import argparse
import contextlib
import gc
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from softfinger.daemon.errors import SettingsError
from softfinger.daemon.own_files import runtime_fault
from softfinger.tools.arguments import add_profile, own_runtime_folder, profile
from softfinger.tools.stop_condition import Interrupted, Signals

if TYPE_CHECKING:
    from softfinger.daemon.profile.settings import Settings

_FAULTS = """\
Faults. Give any number of faults, each in the form KIND[=VALUE][@START]:
  tactile boards   torn, noisy (=PROBABILITY per frame), silent, frozen, wrong-size, saturated,
                   zero; for both boards, or for one board: left:silent, right:torn=0.2
  instructions     lose, lose-writes =PROBABILITY that an instruction does not reach any servo
  servo replies    drop, late, truncate, corrupt, duplicate =PROBABILITY; delay=S for every reply
  servos           silent, answer, reboot, overheat, overload, undervoltage =ID; readings: stuck
                   (constant angle, velocity and current 0), jump (by 0.2 rad), frozen (all
                   registers constant, including time), refuse (errors only); recover =ID
  ports            unplug, plug: the servo port; left:unplug, right:plug …: the port of a board
  measurements     wrong values, while the hand itself is unchanged; for both fingers, or for one
                   finger: left:gain=0.5. gain=FACTOR for all pressures, shift-x, shift-y=CELLS for
                   the image, mirror=1 (columns reversed), drift=FRACTION of the maximum count (may
                   be negative), replay=S (repeats the last S seconds of frames, at most 3 s, with
                   new numbers), current=FACTOR for the reported current. To end a fault, set a
                   FACTOR to 1, and any other value to 0
  the object       push=N along the object's faces, away from the palm, twist=N·m; 0 ends the load
  recovery         well ends all faults; left:well ends those of one board and its measurements.
                   Loads on the object stay. Hardware errors of servos remain until a reboot
  @START           start time [s]; without it, the fault starts immediately. With gain=0.5@3..5, a
                   measurement changes linearly from 3 to 5 s

To change the faults of a running emulator through DIR/control:
  softfinger emulate --send "drop=0.01 left:frozen@2"

To try out `calibrate`, press on the tips with an emulated plate, which replaces the object:
  --send "press PRESSES"   returns when the plate has reached its position
  PRESSES is a comma-separated list; each press consists of some of these words:
    depth=4mm      or force=5N, or pressure=10kPa on all cells, as from a bladder; 0mm lifts off
    tilt=10deg     tilt of the plate (default: 0)
    speed=2mm/s    approach speed (default: 5)
    hold=1s        hold for this time, then lift off; by default, the plate stays after the last
                   press and holds each earlier press for 1 s
    tip=left       or right (default: both)
  When a plate has reached its position, the log shows the force on the tip. Plates do not move the
  joints.

To try out `calibrate joints`, turn the joints as if by hand, while torque is off:
  --send "turn left=closed right=open"   turns each joint to its stop, or with `zero` to its zero
                                         position; returns on arrival

To put the object back after it has slipped away, at rest and without a load:
  --send place

To test a daemon, use the record of the servo bus: --send report prints the record as JSON, --send
forget starts a new record, and --send "report forget" does both without a gap. The record contains:
  t, monotonic     current time of the hand [s], and time.monotonic() at that time
  servos           left first, for each:
    id, torque, mode, q, hardware_error, watchdog (time-out [s], 0 if it is not armed, null after it
                   stopped the motor), stopped_by_watchdog: current state
    goal_q, goal_current
                   minimum and maximum received goal [rad, A; positive closes], including refused
                   goals; null if there were no goals; goals near the position of a joint without
                   torque are omitted
    goals_refused  number of writes with a goal that the servo refused
    torque_on      count: number of times that torque was switched on; t: last time; far:
                   number of times that the goal was then more than 0.05 rad from the joint angle;
                   farthest: maximum of this distance [rad]
    quiet, longest_quiet
                   time since the last instruction while torque is on (null while torque is off),
                   and the longest such time [s]
    watchdog_fired count: number of motor stops by the watchdog; t: time of the last stop
  object           current pose (x, y [m], angle [rad])
  force            current force on each tip [N], left first
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _FAULTS
    parser.add_argument(
        "--dir",
        type=Path,
        metavar="DIR",
        help="your own folder for the links servos, tactile-left and tactile-right; created if "
        "it does not exist (default: a folder in your runtime folder)",
    )
    add_profile(parser, folder=False)
    parser.add_argument("--model", metavar="NAME", help="servo model")
    parser.add_argument(
        "--ids",
        type=_ids,
        metavar="L,R",
        help="servo IDs, left first; with 1,1 both servos reply at the same time, like "
        "factory-new servos",
    )
    parser.add_argument(
        "--baud",
        type=int,
        default=0,
        metavar="N",
        help="servos reply only at this baud rate, with its transmission time; 0: at any baud "
        "rate and without delay (default)",
    )
    parser.add_argument(
        "--factory",
        action="store_true",
        help="emulate factory-new servos: position mode, return delay of 500 µs; add --baud "
        "57600 --ids 1,1 for their factory address",
    )
    parser.add_argument(
        "--send",
        metavar="WORDS",
        help="send faults or requests (see below) to the emulator running in DIR, then exit",
    )
    parser.add_argument(
        "--fault", action="append", default=[], metavar="FAULT", help="fault to emulate; see below"
    )


def _ids(text: str) -> tuple[int, ...]:
    try:
        ids = tuple(int(part) for part in text.split(","))
    except ValueError:
        ids = ()
    if len(ids) != 2 or not all(0 <= each <= 252 for each in ids):
        raise argparse.ArgumentTypeError(
            f"expected two IDs between 0 and 252, such as 1,2, found {text}"
        )
    return ids


def run(arguments: argparse.Namespace) -> int:
    """Emulate the hand until SIGINT, SIGTERM or SIGHUP arrives.

    Raises SoftfingerError if the setup fails, or if the running emulator refuses ``--send``.
    """
    arguments.dir = arguments.dir or own_runtime_folder()
    if arguments.dir is None:
        raise SettingsError(f"{runtime_fault()}; or name another folder with --dir")
    if arguments.send is not None:
        from softfinger.daemon.simulation.emulator.folder import carry_out

        if reply := carry_out(arguments.dir, arguments.send):
            print(reply)
        return 0
    if arguments.model is not None:
        arguments.set = [*arguments.set, f"servos.model={arguments.model}"]
    settings = profile(arguments)
    signals = Signals()
    try:
        _serve(settings, arguments, signals)
    except Interrupted:
        pass
    return 0


def _serve(settings: Settings, arguments: argparse.Namespace, signals: Signals) -> None:
    # The following imports are slow (numpy, numba), so settings errors are reported first.
    from softfinger.daemon.loop.realtime import RealTime

    gc.disable()  # Garbage collection during imports would take a tenth of the start-up time.
    from softfinger.daemon.loop.warm_up import EMULATED
    from softfinger.daemon.simulation.emulator.emulator import Emulator, with_board
    from softfinger.tools.processes.compile import build_kernels, print_event

    build_kernels(with_board(settings), print_event, EMULATED)
    with contextlib.ExitStack() as made:
        with signals.deferred():
            emulator = Emulator(
                settings,
                arguments.dir,
                baud=arguments.baud,
                factory=arguments.factory,
                ids=arguments.ids,
                faults=arguments.fault,
                tell=lambda line: print(line, file=sys.stderr, flush=True),
            )
            made.callback(emulator.close)
        signals.hand_over(emulator.end)
        with RealTime(_unhurried(settings, arguments.baud > 0)):
            emulator.run(lambda: print(_ready(emulator.ports), end="", flush=True))


@contextlib.contextmanager
def emulator_process(*words: object) -> Iterator[subprocess.Popen[str]]:
    """Run `softfinger emulate` with the arguments ``words``; yield the process once it is ready.

    Raises NoEmulator if the process exits before it is ready. The process prints its error message
    to standard error.
    """
    from softfinger.daemon.simulation.emulator.folder import NoEmulator

    # The -P option keeps Python from importing a folder named softfinger in the working directory.
    command = [sys.executable, "-P", "-m", "softfinger", "emulate", *map(str, words)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            if process.stdout.readline() != "ready\n":
                raise NoEmulator(
                    f"{' '.join(command[3:])}: the program exited; see its message above"
                )
            yield process
        finally:
            process.terminate()


def _ready(ports: dict[str, Path]) -> str:
    """Return the lines that report that the emulator is ready.

    The lines are printed together, because readers may wait for the last line.
    """
    return "".join(["ready\n", *(f"{name}: {path}\n" for name, path in ports.items())])


def _unhurried(settings: Settings, paced: bool) -> Settings:
    """Return the settings with real-time options for a pseudo-terminal.

    SCHED_FIFO is not used, because it delays the kernel worker that transfers the bytes. Emulated
    wire timing requires very short sleeps. CPU idle states are therefore disabled only if the
    servos reproduce the wire timing.
    """
    changes = {"priority": 0, "cpus": (), "spin": 0.0, "lock_memory": False}
    held = paced and settings.realtime.hold_latency
    realtime = {**changes, "hold_latency": held}
    return settings.changed(realtime=realtime, loop={"clock": "real"})
