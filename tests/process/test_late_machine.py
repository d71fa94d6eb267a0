"""Test the demo while the demo's process is suspended for a second."""

import select
import signal
from collections.abc import Iterator

import pytest

from softfinger import Hand, HandState
from softfinger.daemon.client.hand import Subscription
from softfinger.daemon.wire.schema import Event
from tests.conftest import Addresses
from tests.harness.daemon_process import Running

STILL = 1.0  # duration of a stall [s], far above the watchdog time and the frame age limit
PATIENCE = 60.0  # timeout for an event on a busy machine [s]


@pytest.fixture
def hand(addresses: Addresses) -> Iterator[Hand]:
    with Hand(*addresses, timeout=PATIENCE) as hand:
        yield hand


def stand_still(running: Running) -> None:
    running.process.send_signal(signal.SIGSTOP)
    select.select([], [], [], STILL)
    running.process.send_signal(signal.SIGCONT)


def after(states: Subscription[HandState], mode: str) -> HandState:
    return next(state for state in states if state.mode == mode or state.fault)


def told(events: Subscription[Event], kind: str, text: str) -> str:
    return next(each.text for each in events if each.kind == kind and text in each.text)


def test_a_simulated_hand_survives_a_suspended_machine(start, profile, hand):
    running = start("--config", str(profile('task.name = "demo"\n')))
    with hand.stream(PATIENCE) as states, hand.events(PATIENCE) as events:
        before = after(states, "holding")
        stand_still(running)
        for mode in ("rotating", "holding", "releasing", "grasping"):
            state = after(states, mode)
            assert state.fault == ""
        # The hand's clock advances only while the hand's process runs.
        assert state.behind_s >= before.behind_s + 0.9 * STILL
        passed = 1e-9 * (state.mono_ns - before.mono_ns)
        assert passed == pytest.approx((state.seq - before.seq) / 100.0)
        assert told(events, "late", "the simulated hand paused for")
    assert running.end() == 0


@pytest.mark.extended
def test_on_real_time_a_stall_is_a_fault_and_the_task_restarts(start, profile, hand):
    running = start("--config", str(profile('task.name = "demo"\nloop.clock = "real"\n')))
    with hand.stream(PATIENCE) as states, hand.events(PATIENCE) as events:
        # The demo may already have restarted after a fault.
        next(state for state in states if state.mode == "holding")
        stand_still(running)
        fault = told(events, "servos.bus", "watchdog")
        assert fault.startswith("this machine was busy for ")
        told(events, "task", "task clears the fault and restarts")
        told(events, "mode", "armed → grasping")
    assert running.end() in (0, 1)  # A busy machine may cause a fault at any time.
