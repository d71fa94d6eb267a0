"""Types of command-line arguments that several subcommands share."""

from __future__ import annotations

import argparse
import math


def seconds(text: str) -> float:
    """A time above 0 s. Raises ArgumentTypeError with what was found."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"expected a time above 0 s, found {text!r}")
    return value
