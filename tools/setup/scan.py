"""Run ``softfinger scan [PORT …]``: find servos and their baud rates without changing settings."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

from softfinger.daemon.diagnosis.ports import serial_ports
from softfinger.daemon.errors import ServoError
from softfinger.daemon.servos.control_table import BAUD_RATES
from softfinger.daemon.servos.provisioning import ONE_SERVO_ONLY, SEARCH_TIME, FoundServo, search
from softfinger.tools.arguments import number, seconds


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "Exit status: 0 a servo replied, 1 no servo replied or no port can be used."
    parser.add_argument(
        "ports", metavar="PORT", nargs="*", help="ports to scan (default: every serial port)"
    )
    parser.add_argument(
        "--baud",
        type=number("a baud rate of 1 or more", 1.0, includes_low=True, kind=int),
        action="append",
        metavar="N",
        help="baud rate to try; can be given several times (default: all baud rates that servos "
        "support)",
    )
    parser.add_argument(
        "--wait",
        type=seconds,
        default=SEARCH_TIME,
        metavar="S",
        help="listening time per baud rate in seconds (0.8 s is enough for 253 servos at 1 Mbaud)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Scan the ports and print a line for each servo. Return 0 if a servo was found."""
    paths = arguments.ports or [path for path, _ in serial_ports()]
    if not paths:
        print(
            "scan: found no serial port on this machine; give a port as an argument",
            file=sys.stderr,
        )
        return 1
    count = 0
    for path in paths:
        try:
            found = search(path, arguments.baud or BAUD_RATES, arguments.wait)
        except ServoError as error:
            print(f"scan: {error}", file=sys.stderr)
            continue
        rates: dict[FoundServo, list[str]] = {}
        for servo in found.servos:
            rates.setdefault(replace(servo, baud=0), []).append(str(servo.baud))
        for servo, at in rates.items():
            # An emulated servo may reply at several baud rates, which are listed on one line.
            print(f"{path}: {servo.describe(', '.join(at))}", flush=True)
        for garbled in found.garbled:
            print(f"{path}: {garbled}\n  → {ONE_SERVO_ONLY}", flush=True)
        for old in found.old_protocol():
            print(f"{path}: {old}", flush=True)
        if not found.servos and not found.garbled and not found.old:
            print(f"{path}: no servo replied at any of these baud rates", flush=True)
        count += len(rates)
    return 0 if count else 1
