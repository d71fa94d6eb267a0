"""Test the tools on a virtual-time recording of a hand with solid tips."""

from pathlib import Path

import pytest

from softfinger.daemon.wire import schema
from softfinger.tools.cli import main
from softfinger.tools.recordings.reader import Recording
from tests.harness.recorded_hand import record_hand


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record four virtual seconds of the demo: grasp, hold and turn."""
    path = tmp_path_factory.mktemp("solid") / "hand.mcap"
    record_hand(path, {}, 4.0, ("task.name=demo",), profile="solid")
    return path


@pytest.mark.extended
def test_the_recording_recomputes_bitwise(recorded, capsys):
    assert main(["replay", "--recompute", str(recorded)]) == 0
    assert "all states are bit-identical" in capsys.readouterr().out
    states = [each for _, each in Recording(recorded).messages([schema.STATE])]
    assert {"holding", "rotating"} <= {each["mode"] for each in states}
    assert max(abs(each["left"]["shear_x"]) for each in states) > 0.2


@pytest.mark.extended
def test_analyse_and_plot_read_the_recording(recorded, capsys):
    assert main(["analyse", str(recorded)]) == 0
    assert ", 0 invalid" in capsys.readouterr().out
    out = recorded.parent / "plots"
    assert main(["plot", str(recorded), "--out", str(out)]) == 0
    assert sorted(each.name for each in out.iterdir()) == ["angle.png", "landscape.png", "time.png"]
