"""``softfinger compile``: the kernels of a hand, compiled now instead of at its first start."""

from __future__ import annotations

import argparse

from softfinger.tools.arguments import add_profile, profile
from softfinger.tools.processes.kernel_build import build_kernels, print_event


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_profile(parser)
    parser.add_argument(
        "--all", action="store_true", help="also what the other tools and the tests use"
    )


def run(arguments: argparse.Namespace) -> int:
    """Compile what is missing; 1 when something could not be. Raises SettingsError."""
    settings = profile(arguments)
    from softfinger.daemon.loop.warm_up import ALL

    built = build_kernels(settings, print_event, ALL if arguments.all else None)
    if built.failed:
        return 1
    if not built.parts:
        print("all kernels are compiled")
    return 0
