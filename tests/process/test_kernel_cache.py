"""Test that kernels compiled by other users or from different source code are never run.

The tests use a small package with the structure and the real decorators of softfinger. The tests
modify the package's files and run the kernels in separate processes.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from softfinger.kinematics.compiled import kernel_folder, own_folder
from softfinger.kinematics.compiled.own_folder import OwnFolder
from tests.harness.daemon_process import python

FILES = {
    "softfinger/__init__.py": "class SoftfingerError(Exception): ...\n",
    "softfinger/kinematics/__init__.py": "",
    "softfinger/kinematics/compiled/__init__.py": "",
    "softfinger/kinematics/layout.py": "OFFSET = 1.0\n",
    "softfinger/kinematics/callee.py": """
from softfinger.kinematics.compiled.kernel import inner_kernel

@inner_kernel
def twice(x):
    return 2.0 * x
""",
    "softfinger/kinematics/array.py": """
import numpy as np
from softfinger.kinematics.compiled.kernel import kernel

@kernel
def ramp(x):
    out = np.empty(3)
    for k in range(3):
        out[k] = k * x
    return out

@kernel
def total(x):
    return ramp(x).sum()
""",
    "softfinger/kinematics/caller.py": """
from softfinger.kinematics import layout
from softfinger.kinematics.callee import twice
from softfinger.kinematics.compiled.kernel import kernel

@kernel
def caller(x):
    return twice(x) + layout.OFFSET
""",
}
KEPT = """
import sys
import softfinger.kinematics.array as a
print(a.ramp(3.0).sum(), sum(a.ramp.stats.cache_hits.values()), "numba.np.linalg" in sys.modules)
"""
RUN = """
import softfinger.kinematics.caller as c
print(c.caller(1.0), sum(c.caller.stats.cache_hits.values()))
"""


class Package:
    """The small package, in a folder that also contains the kernel cache."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.first = ""  # prefix of every script
        self.cache = folder / "cache"
        for name, text in FILES.items():
            self.write(name, text)
        real = Path(kernel_folder.__file__).parent
        for file in real.glob("*.py"):
            shutil.copy(file, folder / "softfinger" / "kinematics" / "compiled")

    def write(self, name: str, text: str) -> None:
        """Write one of this package's files."""
        file = self.folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")

    def run(self, script: str = RUN) -> tuple[list[str], str]:
        """Run a script; return the words and the warnings that the script prints."""
        environment = os.environ | {"XDG_CACHE_HOME": str(self.cache), "PYTHONPATH": ""}
        environment.pop("NUMBA_CACHE_DIR", None)
        # Python would load stale bytecode for a file that is rewritten within a second.
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        done = python("-c", self.first + script, env=environment, cwd=self.folder)
        return done.stdout.split(), done.stderr


@pytest.fixture
def package(tmp_path: Path) -> Package:
    return Package(tmp_path)


@pytest.mark.parametrize(
    "first",
    ["", pytest.param("import numba\nnumba.__version__ = '99.0'\n", marks=pytest.mark.extended)],
)
def test_a_changed_callee_or_constant_is_recompiled(package, first):
    package.first = first
    assert package.run() == (["3.0", "0"], "")
    package.write(
        "softfinger/kinematics/callee.py",
        FILES["softfinger/kinematics/callee.py"].replace("2.0", "5.0"),
    )
    assert package.run()[0] == ["6.0", "0"]
    package.write("softfinger/kinematics/layout.py", "OFFSET = 7.0\n")
    assert package.run()[0] == ["12.0", "0"]
    package.write("softfinger/kinematics/layout.py", "OFFSET = 1.0\n")
    found = package.run()
    assert found == (["6.0", "1"], ""), "the cache folder of these sources must still exist"


@pytest.mark.extended
def test_a_cached_kernel_runs_without_the_compiler_and_can_be_compiled_into_others(package):
    assert package.run(KEPT) == (["9.0", "0", "True"], "")
    assert package.run(KEPT) == (["9.0", "1", "False"], "")
    assert package.run(KEPT.replace("ramp(3.0).sum()", "total(3.0)"))[0][0] == "9.0"


def test_own_folder_refuses_links_files_and_other_users(tmp_path, monkeypatch):
    OwnFolder(tmp_path / "new").close()
    OwnFolder(tmp_path / "new").close()
    (tmp_path / "link").symlink_to(tmp_path / "new")
    (tmp_path / "file").touch()
    for name in ("link", "file"):
        with pytest.raises(NotADirectoryError, match="found a link or a file"):
            OwnFolder(tmp_path / name)
    if os.geteuid() == 0:
        os.chown(tmp_path / "new", 54321, 54321)
    monkeypatch.setattr(own_folder.os, "geteuid", lambda: 12345)
    with pytest.raises(PermissionError, match="expected the current user, 12345"):
        OwnFolder(tmp_path / "new")


@pytest.mark.extended
def test_the_folder_is_private_and_the_least_recently_used_ones_are_removed(package):
    base = package.cache / "softfinger"
    for age in range(7):
        old = base / f"kernels-{age:016x}"
        old.mkdir(parents=True)
        os.utime(old, (1e9 - age, 1e9 - age))
    others = {"contact-1.table", "kernels-of-somebody-else"}
    for name in others:
        (base / name).mkdir()
    package.run()
    kept = {each.name for each in base.iterdir()}
    oldest = {f"kernels-{age:016x}" for age in range(4)}
    assert oldest | others < kept
    assert len(kept) == 7
    in_use = {f"kernels-{number:016x}" for number in range(7, 13)}
    for name in in_use:
        (base / name).mkdir()
    package.write("softfinger/kinematics/layout.py", "OFFSET = 2.0\n")
    package.run()
    assert in_use < {each.name for each in base.iterdir()}
    for name in in_use:
        (base / name).rmdir()
    package.write("softfinger/kinematics/layout.py", "OFFSET = 1.0\n")
    (new,) = kept - oldest - others
    assert (base / new).stat().st_mode & 0o777 == 0o700
    (base / new).chmod(0o777)
    found, told = package.run()
    assert found == ["3.0", "0"], "the kernel must be compiled, not loaded from the cache"
    assert f"{base / new}: other users can write to it (0777): chmod go-w" in told
    (base / new).chmod(0o700)
    package.cache.chmod(0o777)  # This folder contains the folder with the kernels.
    found, told = package.run()
    assert found == ["3.0", "0"]
    assert f"{package.cache}: other users can write to it (0777): chmod go-w" in told


def test_two_processes_may_remove_old_folders_at_the_same_time(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    old = tmp_path / "kernels-0000000000000000"
    old.mkdir()
    is_link = Path.is_symlink

    def found(path: Path) -> bool:
        """Return the result after another process has removed the folder."""
        result = is_link(path)
        if path == old and old.exists():
            old.rmdir()
        return result

    monkeypatch.setattr(Path, "is_symlink", found)
    with kernel_folder.find_kernel_folder() as folder:
        assert folder.path.parent == tmp_path
    assert not old.exists()


def flipped(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


SPOILT: dict[str, Callable[[Path], object]] = {
    "a flipped bit": flipped,
    "torn": lambda file: os.truncate(file, 100),
    "empty": lambda file: os.truncate(file, 0),
    "another pickle": lambda file: file.write_bytes(b"\x80\x04N."),
    "another's": lambda file: os.chown(file, 54321, 54321),
}


def test_a_damaged_kernel_is_recompiled_with_a_warning(package, tmp_path):
    package.run()
    (file,) = package.cache.rglob("*.kernel")
    flipped(file)
    found, told = package.run()
    assert (found, told.count("will be recompiled")) == (["3.0", "0"], 1)
    assert package.run() == (["3.0", "1"], "")
    with OwnFolder(tmp_path / "kept") as folder:
        for name, spoil in SPOILT.items():
            if name == "another's" and os.geteuid() != 0:
                continue  # Only root can change the owner of a file.
            kernel_folder.keep(folder, "one", b"machine code")
            assert kernel_folder.kept(folder, "one") == b"machine code"
            spoil(folder.path / "one.kernel")
            with pytest.warns(RuntimeWarning, match="will be recompiled"):
                assert kernel_folder.kept(folder, "one") is None, name


def test_damaged_kernels_are_found_and_removed_with_their_marks(tmp_path):
    with OwnFolder(tmp_path / "kept") as folder:
        for name in ("one", "two"):
            kernel_folder.keep(folder, name, b"machine code")
        kernel_folder.mark(folder, "grip")
        assert kernel_folder.remove_damaged(folder) == 0
        assert kernel_folder.is_marked(folder, "grip")
        flipped(folder.path / "one.kernel")
        assert kernel_folder.damaged(folder) == ["one.kernel"]
        assert kernel_folder.remove_damaged(folder) == 1
        assert folder.names() == ["two.kernel"]


def test_a_folder_that_is_renamed_is_still_used_as_opened(tmp_path):
    path, theirs = tmp_path / "kept", tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "one.kernel").write_bytes(b"theirs")
    with OwnFolder(path) as folder:
        kernel_folder.keep(folder, "one", b"ours")
        path.rename(tmp_path / "away")
        theirs.rename(path)
        assert kernel_folder.kept(folder, "one") == b"ours"
        (tmp_path / "away" / "two.kernel").symlink_to(path / "one.kernel")
        with pytest.warns(RuntimeWarning, match="will be recompiled"):
            assert kernel_folder.kept(folder, "two") is None
