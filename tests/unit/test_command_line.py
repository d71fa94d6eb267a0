"""Test the command line without a daemon, including errors, profiles and numbers with units."""

import json
import math
import tomllib
from pathlib import Path

import pytest

from softfinger.daemon.profile.load import find, names
from softfinger.tools.cli import SUBCOMMANDS, make_parser


def test_without_arguments_the_first_steps_are_shown_and_help_lists_all_subcommands(inline):
    first = inline()
    assert (first.returncode, first.stderr) == (0, "")
    assert "softfinger run --monitor" in first.stdout
    shown = inline("help")
    assert shown.returncode == 0
    assert all(f"\n    {name}" in shown.stdout for name in SUBCOMMANDS)
    assert "Exit status: 0 " in shown.stdout
    for word, hint in (
        ("recrod", "nearest: record"),
        ("versoin", "nearest: --version"),
        ("--verison", "nearest: --version"),
        ("7", "run `softfinger help` to list them"),
    ):
        wrong = inline(word, "run.mcap")
        assert wrong.returncode == 2
        assert f"found {word!r}, expected a subcommand; {hint}" in wrong.stderr


def test_the_closest_subcommand_is_suggested(inline):
    for words, word, near in (
        (("run", "--cofnig", "hil"), "--cofnig", "--config"),
        (("send", "grap", "force=3"), "grap", "grasp"),
        (("calibrate", "tar", "left.json"), "tar", "tare"),
    ):
        wrong = inline(*words)
        assert wrong.returncode == 2
        assert f"unknown word {word!r}; nearest: {near}" in wrong.stderr
    assert max(map(len, inline("limits").stdout.splitlines())) <= 120
    assert "unrecognized arguments: --zzz" in inline("run", "--zzz").stderr
    # The message lists only the missing command, not the options.
    assert inline("send").stderr.endswith("required: COMMAND\n")


def test_the_fraction_of_a_warning_applies_to_the_limit_and_not_to_its_settings(inline):
    """The tilt limit is asin(1 − d/a) minus a margin, and only the margin is a setting."""
    text = inline("limits").stdout
    assert "at 0.9 × the limit" in text
    assert "× safety" not in text
    assert "× object" not in text


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("grasp force=5deg", "force=5deg: found the unit 'deg', expected N or mN"),
        ("rotate angle=8N", "angle=8N: found the unit 'N', expected rad or deg or °"),
        ("grasp force=5mm", "force=5mm: found the unit 'mm', expected N or mN"),
        ("grasp force=nan", "found 'force=nan', expected key=number"),
        ("grasp 5", "found '5', expected key=number"),
        ("gasp", "unknown word 'gasp'; nearest: grasp"),
        ("arm --client \udcff", r"argument --client: found '\udcff', expected UTF-8 text"),
    ],
)
def test_invalid_commands_are_not_sent(inline, words, said):
    done = inline("send", *words.split(), "--timeout", "0.1")
    assert done.returncode == 2
    assert said in done.stderr
    assert "no reply" not in done.stderr


@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        (["angle=8°"], {"angle": math.radians(8)}),
        (["angle=-8deg", "force=10N"], {"angle": math.radians(-8), "force": 10.0}),
        (["left=0.1 rad", "right=1e-1"], {"left": 0.1, "right": 0.1}),
        (["force=2500mN"], {"force": 2.5}),
    ],
)
def test_numbers_may_have_units(words, numbers):
    from softfinger.tools.terminal.send import si_numbers

    assert si_numbers(words) == pytest.approx(numbers)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--baud", "0"), "expected a baud rate of 1 or more, found '0'"),
        (("--baud", "-9600"), "expected a baud rate of 1 or more, found '-9600'"),
        (("--wait", "nan"), "expected a time above 0 s, found 'nan'"),
    ],
)
def test_scan_rejects_numbers_that_no_port_supports(inline, words, reason):
    done = inline("scan", "/dev/does-not-exist", *words)
    assert (done.returncode, reason in done.stderr) == (2, True)


def test_profiles_and_keys_are_shown_from_any_folder(inline, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hil").mkdir()  # A user's project may contain a folder with the same name.
    listed = inline("config", "list").stdout.splitlines()
    assert [line.split()[0] for line in listed] == names()
    assert all(len(line.split()) > 2 for line in listed), "each profile must have a description"
    assert inline("config", "show", "hil").stdout == find(Path("hil")).read_text("utf-8")
    every = tomllib.loads(inline("config", "reference").stdout)
    assert (
        tomllib.loads(inline("config", "reference", "tactile").stdout)["tactile"]
        == every["tactile"]
    )
    meaning, key = inline("config", "reference", "tactile.full_count").stdout.splitlines()
    assert meaning == "# Count at which a cell is saturated."
    assert key == "tactile.full_count = 65535 # counts, integer, 1 to 65535"
    schema = json.loads(inline("config", "schema").stdout)
    assert schema == json.loads(find(Path("sim")).with_name("schema.json").read_text("utf-8"))
    assert set(schema["properties"]) == set(every)
    missing = inline("config", "reference", "tactile.radius")
    assert missing.returncode == 2
    assert "tactile.radius: unknown section or key" in missing.stderr


@pytest.mark.parametrize(
    ("text", "stream", "commands"),
    [
        ("tcp://10.0.0.7", "tcp://10.0.0.7:9872", "tcp://10.0.0.7:9873"),
        ("ipc:///a,ipc:///b", "ipc:///a", "ipc:///b"),
        ("tcp://10.0.0.7:1234", "tcp://10.0.0.7:1234", "tcp://10.0.0.7:1234"),
    ],
)
def test_one_address_suits_every_client(text, stream, commands):
    for words in (["send", "status"], ["status"], ["record", "a.mcap"], ["monitor"], ["view"]):
        parser, _ = make_parser({words[0]})
        assert parser.parse_args([*words, "--address", text]).address == (stream, commands)


@pytest.mark.parametrize(
    ("text", "status", "shown"),
    [
        ("", 0, ["FILE: 0 errors, 0 warnings"]),
        (
            "tactile.rows = 20\n",
            0,
            [
                "warning: FILE: tactile.rows, cols, pitch: found a sensor",
                "FILE: 0 errors, 1 warning",
            ],
        ),
        (
            "tactile.rows = 20\nloop.rat = 3\nsafety.d_max = 0.03\n",
            1,
            [
                "error: FILE: loop.rat: unknown key",
                "error: FILE: safety.d_max: found 0.03 m, expected at most 0.02 m",
                "warning: FILE: tactile.rows",
                "FILE: 2 errors, 1 warning",
            ],
        ),
        (
            "tip.radius = 20\ntactile.rows = 20\n",
            1,
            ["error: FILE: tip.radius", "FILE: 1 error, 0"],
        ),
        (
            'material.law = "points"\nservos.ids = [3, 3]\n',
            1,
            [
                "error: FILE: servos.ids: found [3, 3]",
                "error: FILE: material.strain, material.stress: the stress-strain points can't be",
                "FILE: 2 errors, 0 warnings",
            ],
        ),
        ("loop = [", 1, ["error: FILE: not TOML", "FILE: 1 error, 0 warnings"]),
        (
            'tactile.calibration = ["absent.json", ""]\n',
            1,
            ["error: absent.json: can't be read", "FILE: 1 error, 0 warnings"],
        ),
        (
            "".join(f"x{k} = 1\n" for k in range(30)),
            1,
            [*30 * ["error: FILE: x"], "FILE: 30 errors, 0 warnings"],
        ),
    ],
)
def test_a_profile_is_checked_for_all_errors_and_warnings(inline, tmp_path, text, status, shown):
    file = tmp_path / "my.toml"
    file.write_text(text, encoding="utf-8")
    done = inline("config", "check", file)
    lines = done.stdout.splitlines()
    assert (done.returncode, done.stderr, len(lines)) == (status, "", len(shown)), lines
    for line, start in zip(lines, shown, strict=True):
        assert line.startswith(start.replace("FILE", str(file))), line


@pytest.mark.parametrize("name", names())
def test_the_profiles_of_the_package_are_without_errors_and_warnings(inline, tmp_path, name):
    done = inline("config", "check", name, "--dir", tmp_path)
    assert (done.returncode, done.stdout) == (0, f"{name}: 0 errors, 0 warnings\n")


def test_a_change_of_a_checked_profile_is_checked_with_it(inline):
    done = inline("config", "check", "sim", "--set", "tip.radius=0.01")
    assert done.returncode == 1
    assert done.stdout.startswith("error: sim: safety.d_max: found 0.012 m, expected at most 0.01")
