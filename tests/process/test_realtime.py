"""Test that real-time measures are applied and reverted, and that denials are reported."""

import ctypes
import json
import os
import struct
import time
from typing import Any
from unittest.mock import Mock

import pytest

from softfinger.daemon.clock import RealClock
from softfinger.daemon.loop import realtime
from softfinger.daemon.loop.realtime import _ATTRIBUTE_CALLS, RealTime, _set_slice
from softfinger.daemon.profile.settings import Settings
from softfinger.tools.benchmarks import tick
from tests.harness.daemon_process import PATIENCE, python

# Script that applies and reverts all real-time measures. The script prints the properties of its
# process before, during and after the use of the measures.
HELD = """
import json, os, sys, threading
from pathlib import Path
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings

over = threading.Event()
threading.Thread(target=over.wait, name="reader").start()
reader = [t.native_id for t in threading.enumerate() if t.name == "reader"][0]

def seen():
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    files = [os.readlink(f"/proc/self/fd/{n}") if os.path.lexists(f"/proc/self/fd/{n}") else ""
             for n in os.listdir("/proc/self/fd")]
    return {
        "policy": os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK,
        "priority": os.sched_getparam(0).sched_priority,
        "reader": os.sched_getparam(reader).sched_priority,
        "cpus": sorted(os.sched_getaffinity(0)),
        "others": sorted(os.sched_getaffinity(reader)),
        "locked": int(status["VmLck"].split()[0]),
        "latency": "/dev/cpu_dma_latency" in files,
        "slack": int(Path("/proc/self/timerslack_ns").read_text()),
        "switch": sys.getswitchinterval(),
    }

try:
    cpu = min(os.sched_getaffinity(0))
    settings = Settings.model_validate({"realtime": {"priority": 7, "cpus": (cpu,)}})
    told = [seen()]
    with RealTime(settings) as measures:
        told.append(seen())
        child = os.popen("grep -c . /dev/null; chrt -p $$ 2>/dev/null || true").read()
        events = measures.events()
    told.append(seen())
    print(json.dumps({"told": told, "events": events, "cpu": cpu, "child": child}))
finally:
    over.set()
"""

# Script that applies real-time measures without the necessary permissions.
REFUSED = """
import json, os, resource
from softfinger.daemon.loop.realtime import RealTime
from softfinger.daemon.profile.settings import Settings

settings = Settings.model_validate({"realtime": {"priority": 7, "cpus": (1023,)}})
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
if os.geteuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
with RealTime(settings) as measures:
    block = bytearray(1 << 24)  # what comes later can still be had
    print(json.dumps(measures.events()))
"""


def run(script: str) -> Any:
    done = python("-c", script)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_permitted_measures_are_applied_and_reverted():
    answer = run(HELD)
    before, during, after = answer["told"]
    had = answer["events"][0]
    assert had[:2] == ["info", "realtime"]
    if "SCHED_FIFO 7" in had[2]:
        assert (during["policy"], during["priority"], during["reader"]) == (os.SCHED_FIFO, 7, 6)
        assert "SCHED_FIFO" not in answer["child"], "child processes inherited the priority"
    else:
        assert during["priority"] == 0
        assert any("SCHED_FIFO" in event[2] for event in answer["events"][1:])
    assert during["cpus"] == [answer["cpu"]]
    assert during["others"] == before["others"]
    assert (during["locked"] > 0) == ("memory locked" in had[2])
    assert during["latency"] == ("deep idle states disabled" in had[2])
    assert during["switch"] == pytest.approx(2e-4)
    assert after == before


def test_refused_measures_are_reported_with_their_effect_and_remedy():
    events = run(REFUSED)
    assert events[0][:2] == ["info", "realtime"]
    assert "timer slack 1 ns" in events[0][2]
    assert "memory" not in events[0][2]
    refused = [text for level, kind, text in events[1:] if (level, kind) == ("warning", "realtime")]
    assert len(refused) == len(events) - 1
    for words in (
        ("SCHED_FIFO 7 denied", "other processes can delay a tick", "rtprio"),
        ("processor 1023 denied", "may move between processors"),
        ("memory lock denied", "can be swapped out", "memlock unlimited"),
    ):
        assert any(all(word in text for word in words) for text in refused), (words, refused)
    if os.access("/dev/cpu_dma_latency", os.F_OK):
        assert any("/dev/cpu_dma_latency denied" in text and "udev" in text for text in refused)


NOTHING = {
    "freeze_collector": False,
    "lock_memory": False,
    "hold_latency": False,
    "timer_slack": 0.0,
    "spin": 0.0,
    "slice": 0.0,
}


def test_a_thread_may_exit_while_a_denied_priority_is_reverted(monkeypatch):
    outcomes = (None, PermissionError(1, "not permitted"), ProcessLookupError(3, "no such process"))
    monkeypatch.setattr(os, "sched_setscheduler", Mock(side_effect=outcomes))
    monkeypatch.setattr(realtime, "_threads", lambda: [0, 0])
    settings = Settings.model_validate({"realtime": NOTHING | {"priority": 7}})
    with RealTime(settings) as measures:
        assert measures.granted == []
        assert measures.refused[0].startswith("SCHED_FIFO 7 denied")


def test_disabled_measures_are_not_requested():
    settings = Settings.model_validate({"realtime": NOTHING})
    with RealTime(settings) as measures:
        assert measures.events() == []
    settings = Settings.model_validate(
        {"loop": {"clock": "virtual"}, "realtime": {"priority": 7, "cpus": (0,)}}
    )
    affinity = os.sched_getaffinity(0)
    with RealTime(settings) as measures:  # Virtual time never waits.
        assert (measures.granted, measures.refused) == (["garbage collector frozen"], [])
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
        assert os.sched_getaffinity(0) == affinity


def test_a_short_time_slice_is_set_if_supported_and_reverted():
    calls = _ATTRIBUTE_CALLS.get(os.uname().machine)
    if calls is None or not _set_slice(calls, 0, 3_000_000):
        pytest.skip("this kernel takes no slices")
    _set_slice(calls, 0, 0)
    with RealTime(Settings.model_validate({"realtime": {"slice": 2e-4}})) as measures:
        assert "slices of 0.2 ms" in measures.events()[0][2]
        assert _slice(calls[1]) == 200_000
    assert _slice(calls[1]) not in (0, 200_000)
    with RealTime(Settings.model_validate({"realtime": {"slice": 1e-6}})) as measures:
        assert "slices of 0.1 ms" in measures.events()[0][2]


def _slice(get_call: int) -> int:
    """Return the calling thread's time slice as reported by the kernel [ns]."""
    told = ctypes.create_string_buffer(48)
    assert ctypes.CDLL(None).syscall(get_call, 0, told, 48, 0) == 0
    return int(struct.unpack("=IIQiIQQQ", told.raw)[5])


@pytest.mark.parametrize("spin", [0.0, 2e-4])
def test_a_sleep_never_ends_early_and_includes_the_spin(spin):
    clock, before = RealClock(spin), time.thread_time()
    for _ in range(20):
        deadline = clock.now() + 1e-3
        clock.sleep_until(deadline)
        assert clock.now() >= deadline
    assert time.thread_time() - before < 20 * 9e-4, "the clock was busy during the whole sleep"


def test_ticks_over_ptys_alternate_with_their_exchanges():
    patient = [f"{key}={value}" for key, value in PATIENCE.items()]
    report = tick.in_the_loop("paced", 2, 2_000_000, patient, patience=150)
    assert [row["n"] for row in report.rows] == [40] * 3
    assert all(row["median"] > 0.0 for row in report.rows)
