"""The kernel decorator: a cached caller never runs an old callee."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import kinematics.kernels
from kinematics.kernels import source_digest

CALLER = """
from kinematics.callee import twice
from kinematics.kernels import kernel

@kernel
def caller(x):
    return twice(x) + 1.0

if __name__ == "__main__":
    print(caller(1.0), len(caller.stats.cache_hits))
"""
CALLEE = """
from kinematics.kernels import kernel

@kernel
def twice(x):
    return {factor} * x
"""


def copied_package(tmp_path: Path, factor: float) -> Path:
    package = tmp_path / "kinematics"
    package.mkdir(exist_ok=True)
    (package / "__init__.py").touch()
    source = Path(kinematics.kernels.__file__).read_text(encoding="utf-8")
    (package / "kernels.py").write_text(source, encoding="utf-8")
    (package / "callee.py").write_text(CALLEE.format(factor=factor), encoding="utf-8")
    (package / "caller.py").write_text(CALLER, encoding="utf-8")
    return package


def run_caller(tmp_path: Path) -> list[str]:
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", "import kinematics.caller as c; print(c.caller(1.0), "
         "sum(c.caller.stats.cache_hits.values()))"],
        env=environment, cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout.split()


def test_a_changed_callee_recompiles_the_cached_caller(tmp_path: Path) -> None:
    copied_package(tmp_path, 2.0)
    assert run_caller(tmp_path) == ["3.0", "0"]
    assert run_caller(tmp_path) == ["3.0", "1"]
    copied_package(tmp_path, 5.0)
    assert run_caller(tmp_path) == ["6.0", "0"]


def test_the_digest_follows_imports_through_other_modules() -> None:
    here = Path(kinematics.kernels.__file__).parent
    assert source_digest(here / "fingers.py") == source_digest(here / "fingers.py")
    assert source_digest(here / "fingers.py") != source_digest(here / "kernels.py")
