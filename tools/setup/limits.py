"""``softfinger limits``: the table of all limits, with the numbers of a profile."""

from __future__ import annotations

import argparse
from typing import Any

from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import add_profile, profile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_profile(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the table. Raises SettingsError."""
    settings = profile(arguments)
    from softfinger.daemon.safety.limits import LIMITS

    lines = [(row.name, row.level, row.quantity, _values(settings, row.keys)) for row in LIMITS]
    widths = [max(len(line[column]) for line in lines) for column in range(3)]
    for line in lines:
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=False)]
        print("  ".join([*cells, line[3]]).rstrip())
    return 0


def _values(settings: Settings, keys: tuple[str, ...]) -> str:
    return ", ".join(f"{key} = {_shown(_value(settings, key))}" for key in keys)


def _value(settings: Settings, key: str) -> Any:
    section, _, name = key.partition(".")
    return getattr(getattr(settings, section), name)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_shown(each) for each in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
