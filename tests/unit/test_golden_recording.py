"""The golden recording through today's code: no change of the hand's behaviour goes unnoticed."""

from __future__ import annotations

import json

from softfinger.tools.recordings.reader import Recording
from softfinger.tools.recordings.recomputed import recompute
from tests.harness.golden_recording import MADE_ON, RECORDING, machine_class


def test_the_golden_recording_gives_the_same_states() -> None:
    result = recompute(Recording(RECORDING))
    assert result.from_start
    assert (result.ticks, result.states) == (1000, 1000)
    assert (result.missing_ticks, result.missing_frames) == (0, 0)
    if json.loads(MADE_ON.read_text(encoding="utf-8")) == machine_class():
        assert result.differences == {}, "not identical to the last bit"
    for name, difference in result.differences.items():
        assert isinstance(difference.recorded, float), f"{name}: {difference}"
        assert difference.worst < 1e-9, f"{name}: {difference}"
