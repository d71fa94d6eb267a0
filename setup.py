"""Check the four symbolic links in softfinger/, and create them in an unpacked sdist.

A clone without symbolic links is rejected. All other package settings are in pyproject.toml.
"""

from pathlib import Path

from setuptools import setup

for name in ("config", "daemon", "kinematics", "tools"):
    link = Path(__file__).with_name("softfinger") / name
    if not link.exists() and not link.is_symlink():
        link.symlink_to(Path("..", name), target_is_directory=True)
    if not (link / "__init__.py").exists() and not (link / "sim.toml").exists():
        raise SystemExit(
            f"softfinger/{name}: found {'a file' if link.is_file() else 'nothing'}, "
            f"expected a link to ../{name}: this clone was made without symbolic links. "
            "`git config core.symlinks true`, then `git checkout -- softfinger`, brings them back"
        )

setup()
