"""Run the example programs unchanged, including those for the Gymnasium environments."""

import re

import pytest
from matplotlib.image import imread

from softfinger import Hand
from tests.harness.daemon_process import python


@pytest.mark.extended
def test_grasp_and_turn_example(start, profile, addresses, tmp_path):
    daemon = start("--config", str(profile("")))
    stream, commands = addresses
    picture = tmp_path / "picture.png"
    # Users may run the program after another program that has armed the hand.
    with Hand(stream, commands, timeout=60.0) as hand:
        hand.arm()
    where = ("--stream", stream, "--commands", commands, "--picture", picture)
    done = python("-m", "softfinger.tools.examples.grasp_and_turn", *where)
    assert done.returncode == 0, done.stderr
    assert re.sub(r"no .* from .* yet; waiting up to .* s\n", "", done.stderr) == ""
    ((states, lost),) = re.findall(r"(\d+) states, (\d+) lost", done.stdout)
    assert int(states) > 50
    assert int(lost) < int(states)  # The gateway drops messages if it gets no processor time.
    force = float(re.findall(r"while holding: ([\d.]+) N", done.stdout)[0])
    assert force == pytest.approx(8.0, rel=0.1)
    pixels = imread(picture)[..., :3]
    assert pixels.shape[:2] == (504, 1080)
    # Colours of the left finger, the right finger and the object.
    for colour in ((0, 114, 178), (213, 94, 0), (0, 158, 115)):
        near = abs(pixels * 255.0 - colour).max(axis=2) < 25.0
        assert near.sum() > 300, colour
    assert daemon.end() == 0


@pytest.mark.extended
def test_the_gym_example_gets_its_table_from_several_processes():
    done = python("-m", "softfinger.gym", "3", "--processes", "2")
    assert done.returncode == 0, done.stderr
    found = re.findall(r"^(\w+) +(\w+) +([\d.]+) ± [\d.]+", done.stdout, re.MULTILINE)
    returns = {(task, agent): float(value) for task, agent, value in found}
    assert len(returns) == 6
    assert all(returns[task, "law"] > returns[task, "random"] for task, _ in returns)
