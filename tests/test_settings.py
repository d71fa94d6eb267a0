"""Settings: profiles load, and whatever is wrong with one is told in one report."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from daemon.settings import Settings, SettingsError, load

CONFIG = Path(__file__).parent.parent / "config"


def report(tmp_path: Path, text: str, directory: Path | None = None) -> list[str]:
    path = tmp_path / "profile.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError) as caught:
        load(path, directory)
    lines = str(caught.value).split("\n")
    assert all(line.startswith(f"{path}: ") for line in lines)
    return [line.removeprefix(f"{path}: ") for line in lines]


def test_no_file_is_the_built_in_simulated_hand() -> None:
    assert load() == Settings()
    assert load().servos.backend == "simulated"


def test_sim_profile_equals_the_built_in_hand_and_names_every_key() -> None:
    path = CONFIG / "sim.toml"
    assert load(path) == Settings()
    written = tomllib.loads(path.read_text(encoding="utf-8"))
    for name, section in Settings():
        assert list(written[name]) == list(type(section).model_fields), name


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.toml")), ids=lambda path: path.name)
def test_every_profile_loads(path: Path, tmp_path: Path) -> None:
    settings = load(path, tmp_path)
    assert "{dir}" not in settings.servos.port + "".join(settings.tactile.port)


def test_all_errors_stand_in_one_report_with_key_found_and_expected(tmp_path: Path) -> None:
    lines = report(
        tmp_path,
        """
        [hand]
        pivot_seperation = 0.1
        finger_length = "long"
        q_min = [1, 2, 3]
        [servos]
        baud = 1.5
        ids = [1, 300]
        backend = "dynamxl"
        [tip]
        radius = -1
        [lop]
        rate = 3
        [tactile]
        noise = nan
        [scene]
        fingers = "left"
        object_model = 1
        """,
    )
    assert sorted(lines) == sorted(
        [
            "hand.pivot_seperation: found an unknown key, expected a known one; "
            "nearest: pivot_separation",
            'hand.finger_length: found "long", expected a number',
            "hand.q_min: found [1, 2, 3], expected at most 2 items, not 3",
            "servos.baud: found 1.5, expected a whole number",
            "servos.ids.1: found 300, expected less than or equal to 252",
            "servos.backend: found \"dynamxl\", expected 'simulated', 'dynamixel' or 'none'",
            "tip.radius: found -1, expected greater than 0",
            "lop: found an unknown key, expected a known one; nearest: loop",
            "tactile.noise: found nan, expected a finite number",
            'scene.fingers: found "left", expected an array',
            "scene.object_model: found 1, expected a boolean",
        ]
    )


def test_contradictions_between_keys_are_all_told(tmp_path: Path) -> None:
    lines = report(
        tmp_path,
        """
        [scene]
        fingers = ["left", "left"]
        [hand]
        q_min = [0.5, -0.5]
        q_max = [0.2, 1.0]
        open_angle = [0.0, 2.0]
        [servos]
        backend = "dynamixel"
        ids = [3, 3]
        port = "{dir}/servos"
        [loop]
        clock = "virtual"
        [material]
        law = "points"
        strain = [0.0, 0.1]
        stress = [0.0]
        """,
    )
    keys = [line.split(":")[0] for line in lines]
    assert keys == [
        "scene.fingers",
        "hand.q_max",
        "hand.open_angle",
        "servos.ids",
        "material.stress",
        "loop.clock",
        "servos.port",
    ]


def test_a_scene_without_anything_is_refused(tmp_path: Path) -> None:
    text = '[servos]\nbackend = "none"\n[tactile]\nbackend = "none"\n'
    (line,) = report(tmp_path, text)
    assert line.endswith("found none and none, expected at least one")


def test_a_file_that_is_not_toml_is_told_with_its_line(tmp_path: Path) -> None:
    (line,) = report(tmp_path, "[loop]\nrate = = 3\n")
    assert line.startswith("not TOML: ")
    assert "line 2" in line


def test_a_file_that_is_not_text_or_not_there_is_told(tmp_path: Path) -> None:
    path = tmp_path / "profile.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SettingsError, match="not UTF-8 text"):
        load(path)
    with pytest.raises(SettingsError, match=r"absent\.toml: can't be read"):
        load(tmp_path / "absent.toml")


def test_dir_fills_the_ports(tmp_path: Path) -> None:
    path = tmp_path / "profile.toml"
    path.write_text(
        '[servos]\nport = "{dir}/servos"\n[tactile]\nport = ["{dir}/a", "/dev/b"]\n',
        encoding="utf-8",
    )
    settings = load(path, Path("/tmp/hand"))
    assert settings.servos.port == "/tmp/hand/servos"
    assert settings.tactile.port == ("/tmp/hand/a", "/dev/b")
