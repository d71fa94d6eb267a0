"""Import optional packages, grouped by the extra that installs them."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

from softfinger.daemon.errors import SoftfingerError

_EXTRAS = {  # maps each extra to its error message and required modules
    "plot": ("plots require matplotlib", ("matplotlib",)),
    "record": ("recordings require mcap, orjson and zstandard", ("mcap", "orjson", "zstandard")),
    "view": ("the web page requires websockets and orjson", ("websockets", "orjson")),
    "parquet": ("Parquet files require pyarrow", ("pyarrow",)),
    "cluster": ("cluster workers require dask and distributed", ("distributed",)),
    "gym": ("the environments require gymnasium", ("gymnasium",)),
}


class MissingExtra(SoftfingerError, ImportError):
    """Error raised if an extra's package is missing; the message gives the install command."""


def require(extra: str) -> None:
    """Import an extra's packages; raise MissingExtra if one is missing."""
    needs, modules = _EXTRAS[extra]
    try:
        for module in modules:
            importlib.import_module(module)
    except ImportError:
        raise MissingExtra(f"{needs}: {_install()} 'softfinger[{extra}]'") from None


def _install() -> str:
    """Return the command for installing packages in this environment."""
    if (Path(sys.prefix) / "pipx_metadata.json").exists():
        return "pipx runpip softfinger install"
    if importlib.util.find_spec("pip") is None:  # This environment was created by uv.
        return f"uv pip install --python {sys.executable}"
    return f"{sys.executable} -m pip install"
