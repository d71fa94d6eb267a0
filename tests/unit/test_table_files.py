"""Contact tables in files: kept whole, replaced when damaged, built without a place to keep."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softfinger import ContactTable, Fingertip, Material
from softfinger.daemon.errors import SettingsError
from softfinger.daemon.profile import factory
from softfinger.daemon.profile.factory import (
    load_or_build,
    load_table,
    make_table,
    save_table,
    table_file,
)
from softfinger.daemon.profile.settings import Settings
from softfinger.kinematics.compiled import own_folder
from softfinger.kinematics.contact.lookup import TableError

TIP = Fingertip(0.020)
CONSTANT = Material.constant(0.304e6)
TABLE_I = Material.table_i()


@pytest.fixture
def said() -> list[str]:
    return []


def kept(folder: Path, said: list[str], tolerance: float = 1e-9) -> ContactTable:
    return load_or_build(folder, TIP, CONSTANT, tolerance, said.append)


def test_built_once_and_then_read(
    tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "new" / "cache"
    first = kept(folder, said)
    kept(folder, said, 1e-8)
    assert len(list(folder.iterdir())) == 2
    monkeypatch.setattr(ContactTable, "build", None)
    again = kept(folder, said)
    np.testing.assert_array_equal(first.data, again.data)
    assert said == []


def test_a_file_appears_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "tip.table"
    table = ContactTable.build(TIP, CONSTANT)
    save_table(file, table, TIP, CONSTANT)
    before = file.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(own_folder.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_table(file, ContactTable.build(TIP, CONSTANT, 1e-3), TIP, CONSTANT)
    assert [path.name for path in tmp_path.iterdir()] == ["tip.table"]
    assert file.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"# notes", None])
def test_a_damaged_or_foreign_file_is_replaced(
    tmp_path: Path, said: list[str], content: bytes | None
) -> None:
    kept(tmp_path, said)
    file = table_file(tmp_path, TIP, CONSTANT, 1e-9)
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]) if content is None else content)
    with pytest.raises(TableError, match=rf"{file.name}: it (is damaged|holds no)"):
        load_table(file, TIP, CONSTANT, 1e-9)
    assert kept(tmp_path, said).form == "closed"
    assert len(said) == 1
    assert "built again" in said[0]
    assert str(file) in said[0]
    load_table(file, TIP, CONSTANT, 1e-9)


def test_a_table_of_another_tip_under_this_name_is_replaced(
    tmp_path: Path, said: list[str]
) -> None:
    other = Fingertip(0.021)
    file = table_file(tmp_path, TIP, CONSTANT, 1e-9)
    save_table(file, ContactTable.build(other, CONSTANT), other, CONSTANT)
    assert kept(tmp_path, said).tip == TIP
    assert "another tip" in said[0]


def test_without_a_place_the_table_is_built_all_the_same(tmp_path: Path, said: list[str]) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert kept(blocked / "cache", said).form == "closed"
    assert "can't be kept" in said[-1]


def test_the_daemon_keeps_its_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings()
    asked = []
    monkeypatch.setattr(
        factory, "table_file", lambda *words: asked.append(words) or tmp_path / "one.table"
    )
    table = make_table(settings, CONSTANT, tmp_path)
    assert asked == [(tmp_path, Fingertip(settings.tip.radius), CONSTANT, settings.table.tolerance)]
    assert (tmp_path / "one.table").read_bytes()[-table.data.nbytes :] == table.data.tobytes()


def test_hands_of_one_process_share_their_table() -> None:
    table = make_table(Settings(), CONSTANT, None)
    assert make_table(Settings(), CONSTANT, None) is table
    finer = make_table(Settings.model_validate({"table": {"tolerance": 1e-12}}), TABLE_I, None)
    assert finer.max_error <= 1e-12 < make_table(Settings(), TABLE_I, None).max_error


def test_what_is_wrong_becomes_an_event_or_a_settings_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    events: list[tuple[str, ...]] = []
    make_table(Settings(), CONSTANT, blocked, lambda *words: events.append(words))
    ((level, kind, text),) = events
    assert (level, kind) == ("warning", "table")
    assert "can't be kept" in text
    finer = Settings.model_validate({"table": {"tolerance": 1e-13}})
    for folder in (tmp_path, None):
        with pytest.raises(SettingsError, match=r"table\.tolerance: no .* reaches 1e-13"):
            make_table(finer, TABLE_I, folder)
