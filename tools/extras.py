"""Optional packages, by the extra that installs them."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path

from softfinger.daemon.errors import SoftfingerError

_EXTRAS = {  # what the message says, and the modules
    "plot": ("pictures need matplotlib", ("matplotlib",)),
    "record": ("recordings need mcap, orjson and zstandard", ("mcap", "orjson", "zstandard")),
    "view": ("the page needs websockets and orjson", ("websockets", "orjson")),
    "parquet": ("Parquet files need pyarrow", ("pyarrow",)),
    "cluster": ("a cluster's workers need dask and distributed", ("distributed",)),
    "gym": ("the environments need gymnasium", ("gymnasium",)),
}


class MissingExtra(SoftfingerError, ImportError):
    """A package that an extra installs is missing. The message says what to install."""


def require(extra: str) -> None:
    """Import an extra's packages. Raises MissingExtra without one of them."""
    needs, modules = _EXTRAS[extra]
    try:
        for module in modules:
            importlib.import_module(module)
    except ImportError:
        raise MissingExtra(f"{needs}: {_install()} 'softfinger[{extra}]'") from None


def _install() -> str:
    """The command that installs packages beside this one, however it was installed."""
    if (Path(sys.prefix) / "pipx_metadata.json").exists():
        return "pipx runpip softfinger install"
    if importlib.util.find_spec("pip") is None:  # an environment of uv's
        return f"uv pip install --python {sys.executable}"
    return f"{sys.executable} -m pip install"
