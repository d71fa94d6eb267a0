"""Test how a machine's delays affect clocks, simulated hands, real hands and messages."""

import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfinger.daemon.clock import HandClock, RealClock, VirtualClock, make_clock
from softfinger.daemon.loop import build as build_module
from softfinger.daemon.loop import timing
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.timing import ATTRIBUTION_TIME, REPORT_INTERVAL, Lateness
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.types import Timing
from tests.harness.loop import LateMachine, advance_to, grasped, state_message

MOMENT = ("timestamp", "tick_s", "compute_s", "wake_late_s", "overruns", "behind_s")
Build = Callable[..., tuple[Daemon, LateMachine, list[tuple[str, str, str]]]]


@pytest.fixture
def on_late_machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Build]:
    """Return a function that creates a daemon, a machine with chosen delays, and an event list."""

    def build(clock: str, **sections: Any) -> tuple[Daemon, LateMachine, list[Any]]:
        machine, events = LateMachine(), []
        made = machine if clock == "real" else HandClock(machine)
        monkeypatch.setattr(build_module, "make_clock", lambda _: made)
        chosen = Settings.model_validate({"loop": {"clock": clock}, **sections})
        daemon = Daemon(chosen, wire=False, on_event=lambda *event: events.append(event))
        return stack.enter_context(daemon), machine, events

    with ExitStack() as stack:
        yield build


def ticked(daemon: Daemon, count: int) -> dict[str, Any]:
    """Run ``count`` ticks; return the state without machine-dependent values."""
    loop = daemon.loop

    def end_in_time(_: float) -> None:
        if loop.state.seq >= count:
            loop.end()

    loop.heartbeat = end_in_time
    loop.advance()
    message = state_message(daemon)
    return {key: value for key, value in message.items() if key not in MOMENT}


TICKS = 1600  # number of ticks in which the demo holds and turns the object


@pytest.fixture(scope="module")
def undisturbed() -> dict[str, Any]:
    chosen = Settings.model_validate({"loop": {"clock": "virtual"}, "task": {"name": "demo"}})
    with Daemon(chosen, wire=False) as daemon:
        return ticked(daemon, TICKS)


@settings(max_examples=5)
@given(late=st.lists(st.sampled_from([0.0, 0.0, 0.0, 1e-4, 0.0019, 0.01, 0.3, 5.0]), max_size=300))
def test_a_simulated_hand_behaves_the_same_for_any_delays(undisturbed, late):
    with pytest.MonkeyPatch.context() as patch:
        machine = LateMachine()
        patch.setattr(build_module, "make_clock", lambda _: HandClock(machine))
        chosen = Settings.model_validate({"task": {"name": "demo"}})
        with Daemon(chosen, wire=False) as hand:
            machine.late_by = list(itertools.chain.from_iterable((each, 0.0) for each in late))
            assert ticked(hand, TICKS) == undisturbed
    assert undisturbed["mode"] == "rotating"
    assert undisturbed["object"]["valid"]


def test_a_simulated_hand_waits_for_the_machine_and_reports_it_occasionally(
    on_late_machine, monkeypatch
):
    monkeypatch.setattr(timing, "REPORT_INTERVAL", 5.0)
    daemon, machine, events = on_late_machine("auto", task={"name": "demo"})
    machine.work(60.0)  # The construction time does not count as a delay.
    machine.late_by = [0.0] * 100 + [0.4] + [0.0] * 50 + [0.5]
    daemon.loop.advance(4.0)
    state = daemon.loop.state
    assert state.fault == ""
    assert state.timing.behind_s == pytest.approx(0.9 - 2 * 0.002)
    assert state.timing.late_in_row == 0
    told = [text for level, kind, text in events if kind == "late"]
    assert told == ["this machine is busy: the simulated hand paused for 0.40 s, 0.4 s in total"]
    daemon.loop.advance(2.0)
    told = [text for level, kind, text in events if kind == "late"]
    assert told[1:] == [
        "this machine is busy: the simulated hand paused for 0.50 s, 0.9 s in total"
    ]


def test_a_duration_uses_the_time_of_the_machine(on_late_machine):
    daemon, machine, _ = on_late_machine("auto")
    begin = machine.now()
    machine.late_by = [0.0] * 100 + [3.0]
    daemon.loop.advance(5.0)
    assert machine.now() - begin == pytest.approx(5.0, abs=0.02)


def test_a_fault_caused_by_a_busy_machine_names_this_cause(on_late_machine):
    daemon, machine, events = on_late_machine("real")
    daemon.loop.advance(0.3)
    grasped(daemon, 6.0)
    machine.late_by = [0.0] * 5 + [0.148]
    advance_to(daemon, "fault", 1.0)
    state = daemon.loop.state
    assert state.fault.startswith("this machine was busy for 148 ms: the bus watchdog stopped the")
    assert state.fault_name == "servos.bus"
    late = [event for event in events if event[1] == "late"]
    assert late == [
        ("warning", "late", "this machine is busy: ticks were 0.15 s late, 0.1 s in total")
    ]


def test_other_faults_do_not_mention_a_busy_machine(on_late_machine):
    daemon, machine, _ = on_late_machine("real")
    daemon.loop.advance(0.3)
    grasped(daemon, 6.0)
    machine.late_by = [0.0, 0.08]
    daemon.loop.advance(0.1)
    assert daemon.loop.state.timing.busy_s == pytest.approx(0.08)
    daemon.hand.servo_heat[0].warm(75.0)
    advance_to(daemon, "fault", 3.0)
    assert daemon.loop.state.fault_name == "servos.temperature"
    assert "busy" not in daemon.loop.state.fault
    daemon.loop.advance(ATTRIBUTION_TIME)
    assert daemon.loop.state.timing.busy_s == 0.0


def test_long_work_is_also_named_except_for_commands(on_late_machine):
    daemon, machine, _ = on_late_machine("real", task={"name": "demo"})
    servos, state = daemon.loop.torque.servos, daemon.loop.state
    really = servos.torque_on

    def slowly() -> None:
        really()
        machine.work(0.3)  # The bus is slow.

    servos.torque_on = slowly
    advance_to(daemon, "fault", 2.0)  # The demo task arms the hand.
    assert (state.fault_name, state.timing.busy_s) == ("servos.bus", 0.0)
    assert state.fault.startswith("the bus watchdog")
    servos.torque_on = really
    advance_to(daemon, "grasping", 5.0)
    sensor = daemon.loop.perception.fingers[0].sensor
    latest = sensor.latest

    def held_up() -> Any:
        sensor.latest = latest
        machine.work(0.25)
        return latest()

    sensor.latest = held_up
    advance_to(daemon, "fault", 0.5)
    assert state.fault.startswith("this machine was busy for 250 ms: the bus watchdog")


METAL = Settings.model_validate({"servos": {"backend": "dynamixel"}})


def looked(late: float, seconds: float) -> list[tuple[str, str, str]]:
    """Return a real hand's events if every tick takes ``late`` [s] longer than its period."""
    timing = Timing(tick_s=0.002 + late)
    lateness = Lateness(METAL, timing, waits=False)
    ticks = round(seconds / 0.002)
    found = [lateness.look(0.002 * k, False) for k in range(ticks)]
    return [event for event in found if event is not None]


def test_a_delay_is_reported_again_after_doubling_intervals():
    told = [event for event in looked(0.06, 17.0 * REPORT_INTERVAL) if event[1] == "late"]
    assert len(told) == 6  # after 0, 1, 2, 4, 8 and 16 times REPORT_INTERVAL


def test_virtual_time_advances_only_by_waiting_and_never_decreases():
    clock = VirtualClock(3.0)
    assert clock.now() == clock.wall() == clock.host() == 3.0
    assert clock.sleep_until(4.5) == 0.0
    assert clock.now() == clock.wall() == clock.host() == 4.5
    clock.sleep_until(1.0)
    assert clock.now() == 4.5


def test_the_time_of_a_hand_is_constant_between_sleeps_and_ends_them_on_time():
    machine = LateMachine(100.0)
    clock = HandClock(machine)
    machine.work(0.001)
    assert (clock.now(), clock.host()) == (100.0, 100.001)
    machine.late_by = [0.0015]
    assert clock.sleep_until(100.002) == pytest.approx(0.0015)
    assert clock.now() == 100.002
    assert clock.host() == pytest.approx(100.0035)
    clock.sleep_until(100.004)  # The wait is shorter by the delay.
    assert (clock.now(), clock.host()) == (100.004, 100.004)
    assert clock.behind == 0.0


def test_the_time_of_a_hand_excludes_stalls_of_the_machine():
    machine = LateMachine(100.0)
    clock = HandClock(machine)
    machine.late_by = [5.0]  # The machine was suspended.
    assert clock.sleep_until(100.002) == pytest.approx(5.0)
    assert clock.sleep_until(100.004) == 0.0, "a missed deadline must not cause a sleep"
    assert clock.now() == 100.004
    assert clock.behind == pytest.approx(4.998)
    machine.work(1.0)
    clock.sleep_until(100.006)
    assert clock.behind == pytest.approx(5.996)
    clock.sleep_until(100.008)
    assert clock.host() == pytest.approx(100.008 + clock.behind)
    clock.sleep_until(50.0)
    assert clock.now() == 100.008, "the clock must not run backwards"


@pytest.mark.parametrize(
    ("sections", "kind"),
    [
        ({}, HandClock),
        ({"loop": {"clock": "hand"}}, HandClock),
        ({"loop": {"clock": "real"}}, RealClock),
        ({"loop": {"clock": "virtual"}}, VirtualClock),
        ({"servos": {"backend": "none"}}, HandClock),
        ({"servos": {"backend": "dynamixel"}, "tactile": {"backend": "none"}}, RealClock),
        ({"servos": {"backend": "none"}, "tactile": {"backend": "flexitac"}}, RealClock),
    ],
)
def test_only_a_simulated_hand_has_its_own_time(sections, kind):
    assert type(make_clock(Settings.model_validate(sections))) is kind
