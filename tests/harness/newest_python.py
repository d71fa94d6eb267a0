"""Print the newest Python release installed on PATH or by pyenv."""

import os
import re
import subprocess
from pathlib import Path

_TELL = "import sys; print(*sys.version_info[:3], sys.version_info.releaselevel, sys.executable)"


def candidates() -> list[Path]:
    """Return all programs named python3 or python3.N."""
    folders = [Path(each) for each in os.environ.get("PATH", "").split(os.pathsep)]
    folders += Path.home().glob(".pyenv/versions/*/bin")
    named = [path for folder in folders for path in folder.glob("python3*")]
    return [path for path in named if re.fullmatch(r"python3(\.\d+)?", path.name)]


def main() -> None:
    """Ask each program for its version; skip programs that do not reply, such as pyenv's shims."""
    found = []
    for path in candidates():
        done = subprocess.run([path, "-c", _TELL], capture_output=True, text=True, check=False)
        if done.returncode == 0:
            *version, level, executable = done.stdout.split()
            if level == "final":
                found.append((tuple(map(int, version)), executable))
    print(max(found)[1])


if __name__ == "__main__":
    main()
