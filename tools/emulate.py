"""``softfinger emulate``: the stand-in hand's process. Arguments, signals and exit status."""

from __future__ import annotations

import argparse
import signal
import sys
from pathlib import Path

from pydantic import ValidationError

from daemon.settings import ServoSettings, Settings, SettingsError
from tools.arguments import add_settings, profile

_FAULTS = """\
faults, each KIND[=VALUE][@SECONDS], given as often as needed:
  tactile boards   torn, noisy (=PROBABILITY a frame), silent, frozen, wrong-size;
                   both boards, or one: left:silent, right:torn=0.2
  servo replies    drop, late, truncate, corrupt, duplicate =PROBABILITY
  servos           silent, answer, reboot, overheat, overload, undervoltage, recover =ID
  ports            unplug, plug for the servos'; left:unplug, right:plug … for a board's
  all well again   well for servo replies and boards, left:well for one board
  @SECONDS         when it starts; at once without

softfinger emulate --dir DIR --send "drop=0.01 left:frozen@2" tells a running one, by DIR/control.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``emulate``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _FAULTS
    parser.add_argument(
        "--dir",
        type=Path,
        required=True,
        metavar="DIR",
        help="where servos, tactile-left and tactile-right are linked; made if absent",
    )
    add_settings(parser)
    parser.add_argument("--model", metavar="NAME", help="the servos' model")
    parser.add_argument("--ids", type=_ids, metavar="L,R", help="the servos' IDs, left first")
    parser.add_argument(
        "--baud",
        type=int,
        default=0,
        metavar="N",
        help="servos take the wire's time at this rate and are deaf at others; "
        "0 answers at once and at any rate (default)",
    )
    parser.add_argument(
        "--latency",
        type=_milliseconds,
        default=0.0,
        metavar="MS",
        help="a USB adapter's latency timer, which holds replies up; with --baud",
    )
    parser.add_argument(
        "--factory",
        action="store_true",
        help="servos as they leave the factory: position mode, 500 µs return delay",
    )
    parser.add_argument(
        "--send",
        metavar="WORDS",
        help="tell the emulator that runs in DIR what goes wrong from now on, and end",
    )
    parser.add_argument(
        "--fault", action="append", default=[], metavar="FAULT", help="what goes wrong; see below"
    )


def _milliseconds(text: str) -> float:
    """Seconds."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 255.0:
        raise argparse.ArgumentTypeError(f"expected 0 to 255 ms, found {text}")
    return value / 1000.0


def _ids(text: str) -> tuple[int, ...]:
    try:
        ids = tuple(int(part) for part in text.split(","))
    except ValueError:
        ids = ()
    if len(ids) != 2 or ids[0] == ids[1]:
        raise argparse.ArgumentTypeError(f"expected two different IDs such as 1,2, found {text}")
    return ids


def run(arguments: argparse.Namespace) -> int:
    """Emulate until SIGINT or SIGTERM; 1 with one line when it can't be set up."""
    if arguments.send is not None:
        return _send(arguments.dir, arguments.send)
    try:
        settings = _settings(arguments)
    except SettingsError as error:
        print(error, file=sys.stderr)
        return 2
    # What follows imports numpy and numba: wrong settings are told without waiting for them.
    from daemon.realtime import settle
    from daemon.simulation.emulator import Emulator, EmulatorError
    from tools.run import cache_folder

    try:
        emulator = Emulator(
            settings,
            arguments.dir,
            baud=arguments.baud,
            latency=arguments.latency,
            prepared=not arguments.factory,
            faults=arguments.fault,
            table_cache=cache_folder(),
        )
    except (EmulatorError, SettingsError) as error:
        print(f"softfinger: {error}", file=sys.stderr)
        return 1

    def ready() -> None:
        settle()
        print("ready", flush=True)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: emulator.stop())
    try:
        emulator.run(ready)
    finally:
        emulator.close()
    return 0


def _send(folder: Path, words: str) -> int:
    from daemon.simulation.control_port import NoEmulator, send_words

    try:
        reply = send_words(folder, words)
    except NoEmulator as error:
        reply = f"error: {error}"
    if reply == "ok":
        return 0
    print(f"softfinger: {reply.removeprefix('error: ')}", file=sys.stderr)
    return 1


def _settings(arguments: argparse.Namespace) -> Settings:
    settings = profile(arguments)
    changes = {}
    if arguments.model is not None:
        changes["model"] = arguments.model
    if arguments.ids is not None:
        changes["ids"] = arguments.ids
    if not changes:
        return settings
    try:
        servos = ServoSettings.model_validate({**settings.servos.model_dump(), **changes})
    except ValidationError as error:
        first = error.errors()[0]
        raise SettingsError(f"--ids, --model: {first['msg']}") from None
    return settings.model_copy(update={"servos": servos})
