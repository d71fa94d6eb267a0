"""Optional packages, by the extra that installs them."""

from __future__ import annotations

import importlib

from softfinger.daemon.errors import SoftfingerError

_EXTRAS = {  # what the message says, and the modules
    "plot": ("pictures need matplotlib", ("matplotlib",)),
    "record": ("recordings need mcap, orjson and zstandard", ("mcap", "orjson", "zstandard")),
    "view": ("the viewer needs rerun-sdk", ("rerun", "rerun_cli")),
    "parquet": ("Parquet files need pyarrow", ("pyarrow",)),
}


class MissingExtra(SoftfingerError):
    """A package that an extra installs is missing. The message says what to install."""


def require(extra: str) -> None:
    """Import an extra's packages. Raises MissingExtra without one of them."""
    needs, modules = _EXTRAS[extra]
    try:
        for module in modules:
            importlib.import_module(module)
    except ImportError:
        raise MissingExtra(f"{needs}: pip install 'softfinger[{extra}]'") from None
