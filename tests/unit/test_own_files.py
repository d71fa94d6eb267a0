"""Test that softfinger neither uses nor overwrites another user's files at softfinger's paths."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from softfinger.daemon import own_files
from softfinger.daemon.diagnosis.ports import check_runtime_folder
from softfinger.daemon.own_files import runtime_folder, write_bytes, write_text
from softfinger.daemon.servos.base import Finding
from softfinger.daemon.simulation.emulator.folder import FolderError, LinkFolder
from softfinger.daemon.wire import local_stop
from softfinger.daemon.wire.local_stop import LocalStop
from softfinger.kinematics.compiled import own_folder
from softfinger.kinematics.compiled.own_folder import require_own
from softfinger.tools.cli import main
from softfinger.tools.processes.event_log import EventLog

STRANGER = 54321


@pytest.fixture
def strangers(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """Return a function that makes another user the owner of a file, or pretends to."""

    def give(path: Path) -> None:
        if os.geteuid() == 0:
            os.chown(path, STRANGER, STRANGER, follow_symlinks=False)
        else:
            monkeypatch.setattr(own_files.os, "geteuid", lambda: STRANGER)

    return give


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    """Create a shared folder like /tmp."""
    folder = tmp_path / "shared"
    folder.mkdir()
    folder.chmod(0o1777)
    return folder


@pytest.mark.parametrize("write", [write_text, write_bytes, lambda path: EventLog(file=path)])
@pytest.mark.parametrize("linked", [True, False])
def test_foreign_links_and_files_in_a_shared_folder_are_not_used(shared, strangers, write, linked):
    named = shared / "run.csv"
    victim = shared.parent / "victim" if linked else named
    victim.write_text("precious")
    if linked:
        named.symlink_to(victim)
    strangers(named)
    with pytest.raises(
        PermissionError, match="this link is owned by" if linked else "is owned by another user"
    ):
        write(named)
    assert victim.read_text() == "precious"


def test_own_files_and_links_are_written_normally(shared):
    file, link = shared / "run.csv", shared / "newest"
    link.symlink_to(file)
    with write_text(link) as made:
        made.write("a long first text")
    with write_text(file) as again:
        again.write("short")
    with write_text(file, append=True) as more:
        more.write(" and more")
    assert file.read_text() == "short and more"
    with write_bytes(Path(os.devnull)) as nothing:
        nothing.write(b"x")


@pytest.mark.parametrize("write", [write_text, write_bytes])
def test_an_error_during_writing_names_the_file(write):
    file = write(Path("/dev/full"))
    file.write("x" if write is write_text else b"x")
    with pytest.raises(OSError, match=r"No space left on device: .*/dev/full"):
        file.close()


def test_a_file_is_written_completely_or_not_at_all(tmp_path, monkeypatch):
    file = tmp_path / "kept"
    own_folder.write_whole(file, b"before")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(own_folder.os, "fsync", full)
    with pytest.raises(OSError, match=f"No space left on device: .*{file}"):
        own_folder.write_whole(file, b"after")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("kept", b"before")]


@pytest.mark.parametrize(
    ("mode", "told"),
    [
        (0o777, "other users can write to it"),
        (0o1777, "other users can write to it"),
        (0o700, "is owned by user"),
        (None, "found a link"),
    ],
)
def test_the_emulated_hand_refuses_a_folder_of_another_user(tmp_path, strangers, mode, told):
    folder = tmp_path / "hand"
    if mode is None:
        folder.symlink_to(tmp_path)
    else:
        folder.mkdir()
        folder.chmod(mode)
        if mode == 0o700:
            strangers(folder)
    with pytest.raises(FolderError, match=told):
        LinkFolder(folder)


def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path):
    victim, folder = tmp_path / "victim", tmp_path / "hand"
    victim.write_text("precious")
    folder.mkdir(mode=0o700)
    (folder / ".emulator.lock").symlink_to(victim)
    with pytest.raises(FolderError, match=os.strerror(errno.ELOOP)):
        LinkFolder(folder)
    assert victim.read_text() == "precious"


def test_the_runtime_folder_is_private(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime_folder() == tmp_path / "softfinger"
    monkeypatch.setenv("XDG_RUNTIME_DIR", "relative")
    monkeypatch.setattr(own_files.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(own_files.os, "access", lambda *_: False)
    folder = runtime_folder()
    assert folder == tmp_path / f"softfinger-{os.geteuid()}"
    LinkFolder(folder).close()
    require_own(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder.chmod(0o777)
    assert runtime_folder() == tmp_path / "cache" / "softfinger" / "run"


def test_a_runtime_folder_writable_by_others_is_refused_with_a_remedy(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / "softfinger"
    assert check_runtime_folder() == Finding("pass", "runtime folder", str(folder))
    folder.mkdir()
    folder.chmod(0o777)
    cure = f"chmod go-w {folder}"
    assert check_runtime_folder().text.endswith(cure)
    for words in (["emulate"], ["run", "--config", "hil"]):
        assert main(words) == 2
        assert f"{folder}: other users can write to it (0777): {cure}" in capsys.readouterr().err


def test_the_local_stop_falls_back_to_the_home_folder_and_reports_it(shared, monkeypatch, request):
    # The path is short enough for a socket address.
    home = TemporaryDirectory(prefix="softfinger-")
    request.addfinalizer(home.cleanup)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", home.name)
    theirs = shared / "theirs"
    theirs.mkdir()
    theirs.chmod(0o777)
    found = [theirs, *list(own_files.socket_folders())[-1:]]
    monkeypatch.setattr(local_stop, "socket_folders", lambda: iter(found))
    local = LocalStop("tcp://127.0.0.1:9873")
    try:
        cure = f"chmod go-w {theirs}"
        assert local.notice.startswith(
            f"{theirs}: other users can write to it (0777): {cure}; the local stop "
        )
        assert list(found[1].iterdir())
    finally:
        local.close()
