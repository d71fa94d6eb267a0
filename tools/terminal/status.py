"""Run ``softfinger status``: describe the running hand's state in one line."""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict

from softfinger.daemon.client.hand import Hand
from softfinger.daemon.errors import NoStream
from softfinger.daemon.types import FINGERS
from softfinger.daemon.wire.schema import HandState
from softfinger.kinematics.estimation.invalid import Invalid
from softfinger.tools.arguments import add_daemon, no_stream, stream_address


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_daemon(parser, stream_address)
    parser.add_argument("--json", action="store_true", help="print the whole state as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the next state. Return 1 if the hand has a fault, 2 if no state arrives."""
    try:
        with Hand(arguments.address, keys=arguments.keys) as hand:
            state = hand.state()
    except NoStream:
        print(f"status: {no_stream(arguments.address, arguments.keys)}", file=sys.stderr)
        return 2
    print(json.dumps(asdict(state), ensure_ascii=False) if arguments.json else describe(state))
    return 1 if state.fault else 0


def describe(state: HandState) -> str:
    """Return a line with the mode, mean force, object angle and object width, or the fault."""
    if state.fault:
        return f"{state.mode}: {state.fault}"
    parts = [state.mode]
    touching = [finger for finger in (state.left, state.right) if finger.contact]
    if touching:
        force = sum(finger.force for finger in touching) / len(touching)
        tips = ", ".join(f"{finger.force:.1f} ± {finger.force_std:.1f}" for finger in touching)
        parts.append(f"{force:.1f} N ({tips})")
    if state.object.valid:
        parts.append(f"{math.degrees(state.object.angle):z.1f}°")
        parts.append(f"{state.object.width * 1e3:.1f} mm")
    parts += [why_invalid(state)] if why_invalid(state) else []
    return " ".join(parts[:1]) + (" " + ", ".join(parts[1:]) if parts[1:] else "")


def why_invalid(state: HandState) -> str:
    """Return the reason why the fingers' estimates are invalid, or an empty string."""
    reasons = {name: state.finger(name).invalid for name in FINGERS}
    return "; ".join(
        f"{name} not valid: {reason}"
        for name, reason in reasons.items()
        if reason not in ("", Invalid.NOT_IN_SCENE.text)
    )
