"""Check that a test pins down each tuned constant of perception and control.

``python -m tests.soak.constants [NAME ...]`` checks all constants, or those with the given names.

The constants and their tests are listed in `constants.toml`. For each constant, the program copies
the source tree twice. It halves the constant in one copy and doubles it in the other copy. The test
must fail in both copies. A constant takes about 10 s, because each copy compiles its own kernels.
In an unchanged copy, all tests must pass.
"""

import argparse
import ast
import contextlib
import math
import numbers
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("daemon/perception", "daemon/control")
_COPIED = ("config", "daemon", "kinematics", "softfinger", "tests", "tools", "pyproject.toml")

_LISTED = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
NOT_TUNED: dict[str, str] = _LISTED.pop("not_tuned")
_PAIRS = [
    (name, f"{file}::{test}")
    for file, tests in _LISTED.items()
    for test, names in tests.items()
    for name in names
]
TESTS = dict(_PAIRS)  # test of each constant, as file::function
assert len(TESTS) == len(_PAIRS), "constants.toml lists a constant twice"


def constants() -> dict[str, tuple[Path, str, str]]:
    """Return the numeric constants of the modules; the keys are ``module.NAME``.

    Each value contains the file, the source text of the assignment, and that of the number.
    """
    found = {}
    for file in (file for folder in FOLDERS for file in sorted((ROOT / folder).glob("*.py"))):
        text = file.read_text()
        for node in ast.parse(text).body:
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            name = node.targets[0] if isinstance(node, ast.Assign) else node.target
            line, value = (ast.get_source_segment(text, each) or "" for each in (node, node.value))
            with contextlib.suppress(NameError):  # not a plain number
                if isinstance(name, ast.Name) and isinstance(
                    eval(value, {"math": math}), numbers.Real
                ):
                    found[f"{file.stem}.{name.id}"] = file.relative_to(ROOT), line, value
    return found


def scaled(value: str, factor: float) -> str:
    """Return the source text of ``value`` × ``factor``; an integer stays an integer."""
    return str(round(int(value) * factor)) if value.isdigit() else f"{factor} * ({value})"


def passes(tests: Iterable[str], name: str = "", factor: float = 1.0) -> bool:
    """Return True if the ``tests`` pass when a constant is multiplied by ``factor``."""
    with tempfile.TemporaryDirectory(prefix="softfinger-constants-") as folder:
        copy = Path(folder)
        for each in _COPIED:
            source, target = ROOT / each, copy / each
            if source.is_dir():
                shutil.copytree(source, target, symlinks=True)
            else:
                shutil.copy(source, target)
        if name:
            file, line, value = constants()[name]
            text = (copy / file).read_text()
            assert f"\n{line}" in text
            changed = line.removesuffix(value) + scaled(value, factor)
            (copy / file).write_text(text.replace(f"\n{line}", f"\n{changed}", 1))
        command = [sys.executable, "-m", "pytest", "-q", "-x", "-n0", "-p", "no:cacheprovider"]
        command += ["--timeout=120", *(f"tests/unit/{each}" for each in tests)]
        environment = os.environ | {"PYTHONPATH": folder, "XDG_CACHE_HOME": f"{folder}/cache"}
        run = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
    if run.returncode not in (0, 1):
        raise RuntimeError(f"pytest ended with {run.returncode}:\n{run.stdout[-2000:]}")
    return run.returncode == 0


def main() -> int:
    """Check the selected constants; return 1 if a test passes although a constant is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="names such as hand_state.GATE; default: all")
    names = parser.parse_args().names or list(TESTS)
    if unknown := [name for name in names if name not in TESTS]:
        parser.error(f"{unknown[0]}: not a constant with a test in constants.toml")
    if not passes(dict.fromkeys(TESTS[name] for name in names)):
        print("the tests fail with the present constants")
        return 1
    found = 0
    for name in names:
        halved, doubled = (passes([TESTS[name]], name, factor) for factor in (0.5, 2.0))
        found += halved or doubled
        outcomes = ["PASSES" if each else "fails" for each in (halved, doubled)]
        print(
            f"{name:40} halved: {outcomes[0]:7} doubled: {outcomes[1]:7} {TESTS[name]}", flush=True
        )
    print(f"{len(names) - found} of {len(names)} constants are pinned down by a test")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
