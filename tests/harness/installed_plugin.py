"""Make this repository's pytest plugin visible to other processes, as if it were installed."""

import os
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def plugin_path(folder: Path) -> str:
    """Write the metadata of an installed package to ``folder``; return the resulting PYTHONPATH.

    The entry points are taken from pyproject.toml.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    entries = project["entry-points"]["pytest11"]
    info = folder / "softfinger_plugin-0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: softfinger-plugin\nVersion: 0\n")
    lines = ["[pytest11]", *(f"{name} = {module}" for name, module in entries.items())]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return os.pathsep.join([str(folder), str(ROOT)])
