"""Run ``softfinger limits``: print all limits and their values in a profile."""

from __future__ import annotations

import argparse
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from softfinger.daemon.profile.settings import Settings
from softfinger.tools.arguments import add_profile, profile
from softfinger.tools.terminal.text_layout import plain_table, table_text

if TYPE_CHECKING:
    from softfinger.daemon.safety.limits import Limit


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_profile(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the table. Raises SettingsError for invalid settings."""
    settings = profile(arguments)
    from softfinger.daemon.safety.limits import LIMITS

    table = plain_table(heads=False)
    for wrapped in (False, False, True, True):
        table.add_column(no_wrap=not wrapped, overflow="fold")
    for row in LIMITS:
        table.add_row(row.name, row.level, row.quantity, "\n".join(_values(settings, row)))
    print(table_text(table, 120))
    return 0


def _values(settings: Settings, row: Limit) -> list[str]:
    """Format a limit's settings, after the fraction of the limit at which a warning is issued."""
    values = [f"{key} = {_shown(attrgetter(key)(settings))}" for key in row.keys]
    return values if row.fraction == 1.0 else [f"at {row.fraction:g} × the limit", *values]


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_shown(each) for each in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)
