"""The measurements of the servos' cycle run, and their figures are of the right kind."""

from __future__ import annotations

import os
import time
from dataclasses import replace

import pytest

from softfinger.tools.bench import MEASUREMENTS, ON_DEMAND
from softfinger.tools.benchmarks import blame, servo_rig, servos, sustained
from softfinger.tools.benchmarks.blame import Cycle


def test_a_paced_cycle_takes_its_bytes_time(monkeypatch):
    monkeypatch.setattr(servos, "_PACED", 60)
    whole, share, busy = servos._paced(1_000_000)
    # Fast sync read of 2 × 10 bytes, and a sync write of 2 × 6: 16 + 36 + 28 bytes.
    assert "800 µs on the wire" in whole.name
    assert share.median == pytest.approx(whole.median / 800.0)
    assert share.median > 0.95
    assert 0.0 < busy.median < whole.median


def test_ours_and_the_plain_sdk_take_turns(monkeypatch):
    monkeypatch.setattr(servos, "_ROUNDS", 2)
    monkeypatch.setattr(servos, "_CYCLES", 5)
    monkeypatch.setattr(servos, "_must_have_worked", lambda *_: None)
    rows = servos._unpaced()
    assert [each.count for each in rows] == [10, 2] * 3
    assert all(each.median > 0.0 for each in rows)


def test_a_missing_reply_costs_its_deadline(monkeypatch):
    monkeypatch.setattr(servos, "_MISSES", 5)
    (extra,) = servos._missing()
    assert extra.median > 0.0


def test_a_sustained_run_counts_what_was_missed(monkeypatch):
    monkeypatch.setattr(sustained, "_SECONDS", 0.1)
    before = os.sched_getscheduler(0)
    work, *others = sustained.measure()
    assert os.sched_getscheduler(0) == before
    rows = {each.name.strip(): each for each in others}
    assert work.name.startswith("500 Hz for 0.1 s at 2 Mbaud")
    assert work.count > 0
    assert work.median > 400.0 * 0.5  # µs: the read's share of the wire's time
    missed = rows[f"cycles of {work.count} that ended after the next was due"].median
    through = [each.median for name, each in rows.items() if name.startswith("through ")]
    assert sum(through) == missed
    assert rows["the bytes' own time on the wire"].median == pytest.approx(400.0)
    assert rows["the emulated servos' processor time"].median > 0.0


def test_a_missed_cycle_is_laid_at_the_door_of_what_held_it_up():
    def judged(**seconds: float) -> str:
        usual = Cycle(0.0, 0.0005, 0.0001, 0.0, 0.0002, 0.0)
        return blame.cause(replace(usual, **seconds), 0.002, 0.0004, 0.0002)

    # Computing and the wire alone fill the period, whatever else happened.
    assert judged(work=0.004, computing=0.0017, put_aside=0.002) == blame.OWN
    assert judged(work=0.004, put_aside=0.003) == blame.PUT_ASIDE
    assert judged(late=0.003, put_aside=0.0029) == blame.PUT_ASIDE
    assert judged(late=0.003) == blame.TIMER
    assert judged(work=0.004, servos_put_aside=0.003) == blame.SERVOS_PUT_ASIDE
    assert judged(work=0.004, servos_computing=0.003) == blame.SERVOS
    assert judged(work=0.004) == blame.BETWEEN
    assert judged(work=0.004, put_aside=0.0008, servos_put_aside=0.0010) == blame.BETWEEN


def test_accounts_of_this_thread():
    # In the thread that the accounts are of, as the bench does.
    with sustained.Accounts("thread-self") as accounts:
        begin = time.thread_time()
        while time.thread_time() - begin < 0.01:
            pass
        computing, put_aside = accounts.since()
    assert computing >= 0.009
    assert put_aside >= 0.0


def test_too_many_failures_are_no_measurement():
    servos._must_have_worked(2, 100)
    with pytest.raises(RuntimeError, match="3 of 100"):
        servos._must_have_worked(3, 100)


def test_what_takes_a_minute_is_run_on_demand_only():
    assert "servos" in MEASUREMENTS
    assert "sustained" in ON_DEMAND
    assert "sustained" not in MEASUREMENTS


def test_traffic():
    assert servo_rig.Traffic(16, 36, 28).seconds(2_000_000) == pytest.approx(400e-6)
