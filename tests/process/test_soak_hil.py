"""The soak in real time, in short: it runs, and judges wire and memory."""

from __future__ import annotations

import pytest

from tests.soak import hil


def test_the_soak_in_real_time_judges_wire_and_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hil, "_LOOK", 0.5)
    account = hil.soak(2.0)
    assert account.wrong == []
    assert account.ticks > 20
    assert account.memory
    assert account.done["arm"] >= 1
    assert "wrong: nothing" in str(account)
