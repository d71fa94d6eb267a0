"""Test that the wheel is complete, and that the package works in any environment and folder."""

import contextlib
import os
import shutil
import subprocess
import tomllib
import zipfile
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from tests.harness.daemon_process import python

ROOT = Path(__file__).parents[2]
_FOREIGN = 'raise ImportError("a package of somebody else, imported in the place of ours")\n'
_PUBLIC = """
import sys
from softfinger import AsyncHand, Hand, HandFault, Refused
assert issubclass(Refused, Exception) and issubclass(HandFault, Exception)
loaded = [name for name in sys.modules if name.startswith(("numba", "softfinger.daemon.loop"))]
assert not loaded, loaded
from softfinger import ContactEstimator, ContactTable, Fingertip, Material, SensorGrid
tip, material = Fingertip(radius=0.020), Material.constant(0.304e6)
assert SensorGrid(rows=8, cols=8, pitch=0.005).pressure(tip, material, 0.004, 0.1, 0.0).max() > 1e3
"""
_FIXTURE = f"""
def test_it(recorded_hand):
    assert recorded_hand({str(ROOT / "tests" / "golden" / "grasp_and_turn.mcap")!r}).state().seq > 0
"""


_SOURCES = ("MANIFEST.in", "Makefile", "README.md", "constraints.txt", "pyproject.toml", "setup.py")
_FOLDERS = ("config", "daemon", "docs", "kinematics", "research", "softfinger", "tests", "tools")


def copied(source: Path) -> Path:
    source.mkdir()
    for name in _FOLDERS:
        shutil.copytree(
            ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in ("LICENSE", *_SOURCES):
        shutil.copy(ROOT / name, source)
    return source


def build(what: str, source: Path, into: Path) -> subprocess.CompletedProcess[str]:
    words = f"import setuptools.build_meta as backend; backend.build_{what}({str(into)!r})"
    return python("-c", words, cwd=source)


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the sdist from a clone; return the unpacked folder."""
    folder = tmp_path_factory.mktemp("sdist")
    built = build("sdist", copied(folder / "source"), folder)
    assert built.returncode == 0, built.stderr
    (packed,) = folder.glob("softfinger-*.tar.gz")
    shutil.unpack_archive(packed, folder / "unpacked")
    (unpacked,) = (folder / "unpacked").iterdir()
    return unpacked


@pytest.fixture(scope="module")
def wheel(sdist: Path) -> Path:
    built = build("wheel", sdist, sdist.parent)
    assert built.returncode == 0, built.stderr
    (packed,) = sdist.parent.glob("softfinger-*.whl")
    return packed


@pytest.mark.extended
def test_the_sdist_contains_the_files_of_its_tests_and_pages(sdist):
    assert all((sdist / name).is_file() for name in _SOURCES)
    for folder in ("docs", "tests"):
        files = [each for each in (ROOT / folder).rglob("*") if each.is_file()]
        missing = [each for each in files if not (sdist / each.relative_to(ROOT)).exists()]
        assert not [each for each in missing if each.suffix != ".pyc"]


@pytest.mark.extended
@pytest.mark.parametrize("found", ["a file", "nothing"])
def test_a_clone_without_symlinks_is_not_built(found, tmp_path):
    source = copied(tmp_path / "source")
    link = source / "softfinger" / "daemon"
    link.unlink()
    if found == "a file":
        link.write_text("../daemon", encoding="utf-8")
    else:
        shutil.rmtree(source / "daemon")
    told = build("wheel", source, tmp_path)
    assert told.returncode == 1
    assert f"softfinger/daemon: found {found}, expected a link to ../daemon: " in told.stderr
    assert not list(tmp_path.glob("*.whl"))


@pytest.mark.extended
def test_the_wheel_contains_one_package_with_all_its_data(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name.split("/")[0].split("-")[0] for name in names} == {"softfinger"}
    for package in ("daemon", "kinematics", "tools"):
        for module in (ROOT / package).rglob("*.py"):
            assert f"softfinger/{module.relative_to(ROOT)}" in names
    for profile in (ROOT / "config").glob("*.toml"):
        assert f"softfinger/config/{profile.name}" in names
    data = (
        "py.typed",
        "config/schema.json",
        "daemon/wire/STREAM.md",
        "tools/viewing/foxglove_layout.json",
    )
    assert {f"softfinger/{name}" for name in data} <= names
    assert not any(name.startswith("softfinger/tests") for name in names)


@pytest.mark.extended
def test_a_script_next_to_an_editable_clone_finds_the_package(tmp_path):
    """A folder named softfinger (the clone) precedes the installed package on the path."""
    source = copied(tmp_path / "softfinger")
    assert build("editable", source, tmp_path).returncode == 0
    (packed,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(packed).extractall(tmp_path / "site")
    script = tmp_path / "script.py"
    begin = f"import site; site.addsitedir({str(tmp_path / 'site')!r})\n"
    script.write_text(begin + "from softfinger import Refused, __file__ as at; print(at)\n")
    alone = os.environ | {"PYTHONPATH": ""}  # Exclude the site-packages of this test run.
    told = python("-S", script, cwd=tmp_path, env=alone)
    assert told.stdout.strip() == str(source / "softfinger" / "__init__.py"), told.stderr


@pytest.mark.extended
def test_folders_with_the_names_of_subpackages_do_not_interfere(wheel, tmp_path):
    site, here = tmp_path / "site", tmp_path / "here"
    zipfile.ZipFile(wheel).extractall(site)
    for folder in (site / "daemon", here / "tools", here / "daemon", here / "config"):
        folder.mkdir(parents=True)
        (folder / "__init__.py").write_text(_FOREIGN, encoding="utf-8")

    def run(*words: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(site)}
        done = python(*words, cwd=here, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert run("-c", "import softfinger; print(softfinger.__file__)").startswith(str(site))
    run("-c", _PUBLIC)
    assert run("-m", "softfinger", "--version").startswith("softfinger ")
    assert "tip.force" in run("-m", "softfinger", "limits")
    assert run("-m", "softfinger", "config", "reference", "tip.radius").endswith(
        "= 0.02 # m, 0.0001 to 1\n"
    )
    (here / "test_it.py").write_text(_FIXTURE, encoding="utf-8")
    assert "1 passed" in run("-m", "pytest", "-q", "-p", "no:cacheprovider")


def test_pinned_versions_support_the_oldest_supported_python():
    """Check that every package in constraints.txt supports the oldest supported Python."""
    oldest = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    assert oldest.startswith(">=")
    looked_at = 0
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        with contextlib.suppress(PackageNotFoundError):  # This package is not installed here.
            wanted = metadata(line.split("==")[0]).get("Requires-Python") or ""
            assert SpecifierSet(wanted).contains(oldest.removeprefix(">=")), f"{line}: {wanted}"
            looked_at += 1
    assert looked_at > 40
