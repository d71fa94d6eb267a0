"""Run ``softfinger status``: describe the running hand's state in one line."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict

from softfinger.daemon.client.hand import Hand
from softfinger.daemon.errors import NoStream
from softfinger.daemon.wire.record_text import state_parts
from softfinger.daemon.wire.schema import HandState
from softfinger.tools.arguments import add_daemon, no_stream
from softfinger.tools.terminal.send import json_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "Exit status: 0 the hand has no fault, 1 the hand has a fault, 2 no state arrived."
    )
    add_daemon(parser)
    parser.add_argument(
        "--json",
        action="store_true",
        help="print the whole state as JSON, with null instead of NaN",
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the next state. Return 1 if the hand has a fault, and 2 if no state arrives."""
    try:
        with Hand(*arguments.address, keys=arguments.keys) as hand:
            state = hand.state()
    except NoStream:
        print(f"status: {no_stream(arguments.address[0], arguments.keys)}", file=sys.stderr)
        return 2
    print(json_text(asdict(state)) if arguments.json else describe(state))
    return 1 if state.fault else 0


def describe(state: HandState) -> str:
    """Return a line with the mode, mean force, object angle and width, or with the fault."""
    mode, *details = state_parts(state)
    separator = ": " if state.fault else " "
    return separator.join(filter(None, [mode, ", ".join(details)]))
