"""Run ``softfinger doctor``: check ports, servos, boards and the machine, and suggest fixes.

Each check prints one line of results. This module parses the arguments, runs the checks in order,
prints their results and sets the exit status. The checks are in :mod:`softfinger.daemon.diagnosis`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from softfinger.daemon.backends import BUILT_IN, backend, plugins, source
from softfinger.daemon.diagnosis.devices import (
    check_board,
    check_law,
    check_servos,
    repair_latency_timer,
    repair_servos,
)
from softfinger.daemon.diagnosis.machine import check_kernels, check_machine
from softfinger.daemon.diagnosis.ports import (
    check_addresses,
    check_port,
    check_runtime_folder,
    daemon_mode,
    note_ports,
)
from softfinger.daemon.diagnosis.register_file import restore_registers, save_registers
from softfinger.daemon.errors import ServoError
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.profile.validation import plausibility_warnings
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.servos.checks import check_latency_timer
from softfinger.daemon.types import FINGERS
from softfinger.tools.arguments import add_profile, profile
from softfinger.tools.processes.compile import build_kernels, print_event

_EPILOG = """\
exit status: 0 no check failed (there may be warnings), 1 a check failed, 2 the settings can't be
used. Without --fix, nothing is changed. With --fix, doctor sets the latency timers of adapters to
1 ms, sets the ID and baud rate of each servo that can be identified with certainty, sets all
registers that the hand requires, and compiles the kernels. doctor --fix also reboots servos that
report a hardware error or whose position is wrong by a turn; the hand drops its object during a
reboot. --fix never switches torque on or moves the hand.

All factory-new servos have ID 1 at 57600 baud: connect only one servo and run doctor --fix; then
connect the next servo as well, and run doctor --fix again."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EPILOG
    add_profile(parser)
    change = parser.add_mutually_exclusive_group()
    change.add_argument(
        "--fix", action="store_true", help="fix the problems that softfinger can fix"
    )
    change.add_argument(
        "--restore",
        type=Path,
        metavar="FILE",
        help="restore the servo registers that --save stored in FILE",
    )
    parser.add_argument(
        "--save",
        type=Path,
        metavar="FILE",
        help="store the servo registers in the new FILE before changing any of them",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the checks, print their results and return the exit status. Raises SettingsError."""
    settings = profile(arguments)
    print(f"settings: {arguments.config or 'the built-in simulated hand'}")
    counts = {"FAIL": 0, "warn": 0, "pass": 0}
    for result in results(settings, arguments.fix, arguments.save, arguments.restore):
        counts[result.status] = counts.get(result.status, 0) + 1
        print(f"{result.status:5}  {result.subject}: {result.text}", flush=True)
        if result.fix:
            print(f"       → {result.fix.replace('`', '')}", flush=True)
    print(f"{counts['pass']} passed, {counts['warn']} warnings, {counts['FAIL']} failed")
    return 1 if counts["FAIL"] else 0


def results(
    settings: Settings, fix: bool, save: Path | None = None, restore: Path | None = None
) -> Iterator[Finding]:
    """Perform the requested repairs, then run all checks in the order of their dependencies."""
    ports = settings.ports(plugins=False)
    for kind in BUILT_IN:
        yield from (Finding("note", f"softfinger.{kind}", source(each)) for each in plugins(kind))
    yield note_ports()
    yield check_runtime_folder()
    running = daemon_mode(settings.commands.address, settings.access.keys) if ports else ""
    free = {}  # maps the settings key of each port to True if the port is free
    for key, path in ports:
        found = check_port(path, key, running)
        free[key] = found.status == "pass"
        yield found
        if free[key]:
            # A board sends frames unprompted, so the latency timer merely delays the frames. With a
            # timeout of 1 s, every latency timer is acceptable.
            timeout = settings.servos.reply_timeout if key == "servos.port" else 1.0
            yield from _latency(path, timeout, fix)
    usable, saved = free.get("servos.port", False), True
    for found in _register_files(settings, usable, save, restore):
        saved = saved and found.status != "FAIL"
        yield found
    if fix and not saved:
        text = "not repaired, because their registers were not saved"
        yield Finding("warn", "servos", text, "correct the error above, or omit --save")
    yield from _servos(settings, usable, fix and saved)
    for warning in plausibility_warnings(settings):
        yield Finding("warn", "settings", warning)
    tactile = settings.tactile
    if not backend("tactile", tactile.backend).metal:
        yield Finding("note", "tactile", f"{tactile.backend}: there is no board to check")
    else:
        for finger in settings.scene.indices:
            if free.get(f"tactile.port ({FINGERS[finger]})", True):
                yield check_board(settings, finger)
            yield check_law(settings, finger)
    yield from check_machine()
    if fix:
        build_kernels(settings, print_event)
    yield from check_kernels(settings)
    yield from check_addresses(settings)


def _register_files(
    settings: Settings, port_is_free: bool, save: Path | None, restore: Path | None
) -> Iterator[Finding]:
    if not port_is_free:
        for path, action in ((save, "saved"), (restore, "restored")):
            if path is not None:
                text = f"no registers were {action}, because there is no servo port to use"
                fix = "use a profile with Dynamixel servos, and correct errors of their port"
                yield Finding("FAIL", str(path), text, fix)
        return
    try:
        if save is not None:
            yield from save_registers(settings, save)
        if restore is not None:
            yield from restore_registers(settings, restore)
    except (ServoError, OSError) as error:
        yield Finding("FAIL", "servos", str(error))


def _latency(path: str, timeout: float, fix: bool) -> Iterator[Finding]:
    if fix:
        repaired = repair_latency_timer(path)
        if repaired is not None:
            yield repaired
    found = check_latency_timer(path, timeout)
    if found is not None:
        yield found


def _servos(settings: Settings, port_is_free: bool, fix: bool) -> Iterator[Finding]:
    servos = settings.servos
    found = backend("servos", servos.backend)
    if not found.metal:
        yield Finding("note", "servos", f"{servos.backend}: there is no servo to check")
        return
    if found.source:
        text = (
            f"{servos.backend}: the servos use a plugin; test the plugin with "
            "softfinger.testing.check_servos"
        )
        yield Finding("note", "servos", text)
        return
    if not port_is_free:
        return
    if fix:
        yield from repair_servos(settings)
    yield from check_servos(settings)
