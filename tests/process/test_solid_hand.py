"""A hand with solid tips, recorded by a real daemon: what the tools make of the recording."""

from pathlib import Path

import pytest

from softfinger.daemon.wire import schema
from softfinger.tools.cli import main
from softfinger.tools.recordings.reader import Recording
from tests.conftest import own_addresses
from tests.harness.daemon_process import softfinger


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four virtual seconds of the demo: grasped, held, and turned.

    Virtual time waits for nobody: where the recorder of a busy machine falls behind, once more.
    """
    path = tmp_path_factory.mktemp("solid") / "hand.mcap"
    stream, commands = own_addresses()
    changes = {
        "loop.clock": "virtual",
        "task.name": "demo",
        "stream.address": stream,
        "commands.address": commands,
    }
    words = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    seconds = ("--duration", "4", "--record", str(path))
    while True:
        done = softfinger("run", "--config", "solid", *words, *seconds, timeout=600.0)
        assert done.returncode == 0, done.stderr
        if "lost on the way: none" in done.stderr:
            return path
        path.unlink()


def test_its_recording_recomputes_to_the_last_bit(recorded, capsys):
    assert main(["replay", "--recompute", str(recorded)]) == 0
    assert "identical to the last bit" in capsys.readouterr().out
    states = [each for _, each in Recording(recorded).messages([schema.STATE])]
    assert {"holding", "rotating"} <= {each["mode"] for each in states}
    assert max(abs(each["left"]["shear_x"]) for each in states) > 0.2


def test_analyse_and_plot_read_it(recorded, capsys):
    assert main(["analyse", str(recorded)]) == 0
    assert ", 0 not usable" in capsys.readouterr().out
    out = recorded.parent / "plots"
    assert main(["plot", str(recorded), "--out", str(out)]) == 0
    assert sorted(each.name for each in out.iterdir()) == ["angle.png", "landscape.png"]
