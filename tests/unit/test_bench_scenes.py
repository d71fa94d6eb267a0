"""`bench scenes` and `bench tick` in short: a step can be switched off, and what it saves."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.tools.benchmarks import scenes
from softfinger.tools.benchmarks.scenes import IDLE, SCENES, STEPS, TWO


def test_scenes_tick_and_steps_can_be_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenes, "SCENES", {name: SCENES[name] for name in (IDLE, TWO)})
    chosen = ("no contact, no fit", "topics without subscribers are not packed")
    monkeypatch.setattr(scenes, "STEPS", {name: STEPS[name] for name in chosen})
    costs, savings = scenes.measure(rounds=1)
    assert [row["name"] for row in costs.rows] == [IDLE, TWO]
    assert [row["name"] for row in savings.rows] == list(chosen)
    assert all(row["median"] > 0.0 for row in costs.rows)


def test_a_saving_is_told_from_chance() -> None:
    noise = np.random.default_rng(2).normal(0.0, 1.0, (3, 400))
    nothing = scenes.saving("none", 10.0 + noise[0], 10.0 + noise[1])
    one = scenes.saving("some", 10.0 + noise[0], 11.0 + noise[2])
    assert not nothing["measurable"]
    assert one["measurable"]
    assert one["saves"] == pytest.approx(1.0, abs=0.3)
    assert one["±"] == pytest.approx(1.2533 * np.sqrt(2.0 / 400), rel=0.3)
