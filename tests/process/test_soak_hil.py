"""The soak in real time, in short: it runs, and judges wire, memory and what is lost."""

from __future__ import annotations

import pytest

from tests.soak import hil


def test_the_soak_in_real_time_judges_wire_memory_and_streams(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hil, "_LOOK", 0.5)
    monkeypatch.setattr(hil, "_FLAT", 30.0)  # MB: all of them are still warming up
    account = hil.soak(4.0)
    # A busy machine may hold up the emulated hand itself, whose watchdog then comes late.
    assert [each for each in account.wrong if "without a packet" not in each] == []
    assert account.ticks > 0
    assert {"daemon", "hand", "recorder", "subscriber 3"} <= account.memory.keys()
    assert account.done["arm"] >= 1
    assert all(received > 0 for received, _ in (*account.received, account.recorded))
    assert all(each >= 0.0 for each in account.lateness())
    assert "subscribers' states, and lost" in str(account)


def test_a_process_that_grows_is_told() -> None:
    account = hil.Account(seconds=30.0)
    account.looked = [(t, 0) for t in range(0, 30, 5)]
    account.memory = {"leaky": [10.0 + t for t in range(6)], "flat": [10.0] * 6}
    account.received = [(5, 0)]
    account.recorded = (5, 0)
    hil._conclude(account)
    assert [each.split()[0] for each in account.wrong] == ["leaky"]
