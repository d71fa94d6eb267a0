"""The command line's first steps, profile display, and numbers with units."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any

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
        ("7", "`softfinger help` lists them"),
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
        assert f"found {word!r}, expected a known word; nearest: {near}" in wrong.stderr
    assert max(map(len, inline("limits").stdout.splitlines())) <= 120
    assert "unrecognized arguments: --zzz" in inline("run", "--zzz").stderr
    # Names the missing command only, not missing options.
    assert inline("send").stderr.endswith("required: COMMAND\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("grasp force=5deg", "found 'force=5deg' in 'deg', expected N or mN"),
        ("rotate angle=8N", "found 'angle=8N' in 'N', expected rad or deg or °"),
        ("grasp force=5 mm", "found 'force=5 mm' in 'mm', expected N or mN"),
        ("grasp force=nan", "found 'force=nan', expected key=number"),
        ("grasp 5", "found '5', expected key=number"),
        ("gasp", "found 'gasp', expected a known word; nearest: grasp"),
    ],
)
def test_invalid_numbers_are_not_sent(inline, words, said):
    done = inline("send", *words.split(), "--timeout", "0.1")
    assert done.returncode == 2
    assert said in done.stderr
    assert "no answer" not in done.stderr


@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        (["angle=8°"], {"angle": math.radians(8)}),
        (["angle=-8", "deg", "force=10N"], {"angle": math.radians(-8), "force": 10.0}),
        (["left=0.1 rad", "right=1e-1"], {"left": 0.1, "right": 0.1}),
        (["force=2500mN"], {"force": 2.5}),
    ],
)
def test_numbers_may_have_units(words, numbers):
    from softfinger.tools.terminal.send import si_numbers

    assert si_numbers(words) == pytest.approx(numbers)


def test_profiles_and_keys_are_shown_from_any_folder(inline, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hil").mkdir()  # a project may have such a folder
    listed = inline("config", "list").stdout.splitlines()
    assert [line.split()[0] for line in listed] == names()
    assert all(len(line.split()) > 2 for line in listed), "each says what it is"
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
    assert "tactile.radius: found no such section or key" in missing.stderr


@pytest.mark.parametrize(
    ("text", "stream", "commands"),
    [
        ("tcp://10.0.0.7", "tcp://10.0.0.7:9872", "tcp://10.0.0.7:9873"),
        ("ipc:///a,ipc:///b", "ipc:///a", "ipc:///b"),
        ("tcp://10.0.0.7:1234", "tcp://10.0.0.7:1234", "tcp://10.0.0.7:1234"),
    ],
)
def test_one_address_suits_every_client(text, stream, commands):
    def parsed(*words: str) -> Any:
        return make_parser({words[0]})[0].parse_args([*words, "--address", text]).address

    assert parsed("send", "status") == commands
    for words in (["status"], ["record", "a.mcap"]):
        assert parsed(*words) == stream
    for words in (["monitor"], ["view"]):
        assert parsed(*words) == (stream, commands)
