"""The rehearsal of a tick: it changes nothing, and is over when the deadline comes."""

from __future__ import annotations

import gc
from collections.abc import Mapping, Sequence
from types import MethodType
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

from softfinger.daemon.control.modes import Mode
from softfinger.daemon.loop import rehearsal as module
from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.loop.rehearsal import Likeness, Rehearsal, attributes
from softfinger.daemon.perception.finger_model import make_estimator
from softfinger.daemon.profile.factory import make_material
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.sensor.simulated_tactile import make_sensor_model
from softfinger.daemon.tactile.replay import GivenFrames
from softfinger.kinematics.estimation.estimator import ContactEstimator
from tests.harness.loop import Make, command, grasped

# Through every mode; the last grasp meets a board that went silent, which is a fault.
SCRIPT: dict[int, tuple[str, dict[str, float]]] = {
    10: ("tare", {}),
    100: ("arm", {}),
    110: ("move", {"left": 0.1, "right": 0.05}),
    200: ("grasp", {"force": 6.0}),
    640: ("rotate", {"angle": 0.1}),
    780: ("release", {}),
    1100: ("grasp", {"force": 5.0}),
}
SILENT = 1400
TICKS = 1700


class Machine:
    """In the place of `time`: each look at it takes ``look`` s, and time does not stand still."""

    def __init__(self, daemon: Daemon, look: float) -> None:
        self._clock, self.look = daemon.clock, look
        self.t = 0.0

    def monotonic(self) -> float:
        self.t = max(self.t, self._clock.now()) + self.look
        return self.t

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.t += seconds


def rehearsal_of(daemon: Daemon) -> Rehearsal:
    found = daemon.loop.rehearsal
    assert isinstance(found, Rehearsal)
    return found


def remembered(likeness: Likeness, which: int) -> str:
    """All that the loop's stages (0) or the twin's (1) remember, to the last bit."""
    values = [[getattr(each[which], name) for name in each[2]] for each in likeness.objects]
    lists = [pair[which] for pair in likeness.lists]
    return repr((values, lists, [pair[which].tobytes() for pair in likeness.arrays]))


def states_of(daemon: Daemon) -> list[tuple[str, str]]:
    """The mode and all of the state after each tick of the script."""
    states: list[tuple[str, str]] = []
    state = daemon.loop.state
    daemon.loop.heartbeat = lambda _: states.append((str(state.mode), repr(state)))
    for k in range(0, TICKS, 10):
        if k in SCRIPT:
            command(daemon, SCRIPT[k][0], **SCRIPT[k][1])
        if k == SILENT:
            for finger in daemon.loop.perception.fingers:
                finger.sensor = GivenFrames()
        daemon.loop.advance(10 * daemon.loop.period)
    return states


def test_a_rehearsal_changes_nothing_to_the_last_bit(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = states_of(make())
    assert {mode for mode, _ in expected} == set(Mode)
    daemon = make()
    monkeypatch.setattr(module, "time", Machine(daemon, 1.5e-4))
    daemon.rehearse(1e-3)
    rehearse, passes = rehearsal_of(daemon), 0

    def watched(due: float) -> None:
        nonlocal passes
        looked = daemon.loop.state.seq % 7 == 0  # no divisor of anything's period
        before = looked and remembered(rehearse.likeness, 0)
        rehearse(due)
        assert (looked and remembered(rehearse.likeness, 0)) == before
        passes += max(rehearse.twin.state.seq - daemon.loop.state.seq, 0)

    daemon.loop.rehearsal = watched
    assert states_of(daemon) == expected
    assert passes > TICKS


def test_the_twin_takes_all_that_the_loop_remembers_and_ticks_on_in_its_mode(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = make()
    monkeypatch.setattr(module, "time", Machine(daemon, 1e-4))
    daemon.rehearse(1e-3)
    rehearse = rehearsal_of(daemon)
    grasped(daemon, 8.0)
    assert remembered(rehearse.likeness, 1) != remembered(rehearse.likeness, 0)
    rehearse.likeness.take()
    assert remembered(rehearse.likeness, 1) == remembered(rehearse.likeness, 0)
    rehearse(daemon.clock.now() + 0.01)
    twin, real = rehearse.twin.state, daemon.loop.state
    assert twin.seq > real.seq + 5
    assert (twin.mode, twin.fault, twin.torque) == ("holding", "", True)
    assert [each.force for each in twin.contacts] == pytest.approx([8.0, 8.0], rel=0.05)
    for each in rehearse.likeness.objects:
        assert set(getattr(each[0], "__dict__", ())) <= set(attributes(type(each[0])))


def _reached(roots: Any) -> dict[int, Any]:
    """What can be written among all that the roots refer to, by identity."""
    found: dict[int, Any] = {}
    waiting = list(roots)
    while waiting:
        each = waiting.pop()
        kind = type(each)
        ours = kind.__module__.startswith("softfinger.") or isinstance(each, Sequence | Mapping)
        if id(each) in found or not (ours or isinstance(each, np.ndarray | MethodType)):
            continue
        if isinstance(each, str | bytes | type | BaseModel | Rehearsal):
            continue
        found[id(each)] = each
        waiting += [each.base] if isinstance(each, np.ndarray) else gc.get_referents(each)
    return found


def test_nothing_that_can_be_written_is_both_the_loops_and_the_twins(make: Make) -> None:
    daemon = make()
    daemon.rehearse(1e-3)
    twin = rehearsal_of(daemon).twin
    mine, its = _reached(daemon.loop.stages), _reached(twin.stages)
    both = [mine[k] for k in mine.keys() & its.keys()]
    estimators = [each._estimator for each in daemon.loop.perception.fingers]
    scratch = [array for each in estimators for array in (each.arena[0], each._frame)]
    tables = _reached(daemon.tables)
    for each in both:
        if isinstance(each, np.ndarray):
            assert id(each) in tables or any(np.may_share_memory(each, one) for one in scratch)
        else:
            assert type(each).__name__ in ("Limit", "tuple", "VirtualClock")


@pytest.mark.parametrize(
    "profile", [{}, {"tip": {"physics": "solid"}, "material": {"law": "constant"}}]
)
@pytest.mark.parametrize("blur", [0.0, 5e-4])
def test_no_frame_leaves_anything_in_the_scratch_that_two_estimators_share(
    profile: dict[str, dict[str, str]], blur: float
) -> None:
    settings = Settings.model_validate({**profile, "tactile": {"blur": blur}})
    model, law = make_sensor_model(settings, 0), make_material(settings.material)
    alone, mine, other = (make_estimator(settings, law) for _ in range(3))
    assert isinstance(mine, ContactEstimator)
    assert isinstance(other, ContactEstimator)
    other.share_scratch(mine)
    shape = settings.tactile.rows, settings.tactile.cols
    frames = [np.zeros(shape, np.uint16) for _ in range(6)]
    for k, frame in enumerate(frames[1:]):  # the first is without contact
        model.frame(1e-3 * (k + 1), 0.1 * k - 0.2, 0.05, frame)
    for k in range(24):
        frame = frames[k * 5 % 6]
        other.update(frames[k * k % 6], settings.tactile.pascal_per_count)
        expected = alone.update(frame, settings.tactile.pascal_per_count)
        found = mine.update(frame, settings.tactile.pascal_per_count)
        assert repr(found) == repr(expected)


@pytest.mark.parametrize("cost", [2e-5, 1.1e-4, 4e-4, 3e-3])
def test_a_pass_is_begun_only_where_there_is_time_for_it(
    make: Make, monkeypatch: pytest.MonkeyPatch, cost: float
) -> None:
    daemon = make()
    machine = Machine(daemon, 0.0)
    monkeypatch.setattr(module, "time", machine)
    daemon.rehearse(1e-3)
    rehearse, passes = rehearsal_of(daemon), 0

    def costly(_: bool) -> None:
        nonlocal passes
        passes += 1
        machine.t += cost

    monkeypatch.setattr(rehearse, "_pass", costly)
    for k in range(20):
        before, left = passes, (2e-3, 1e-3, 5e-4)[k % 3] if k % 4 else 3e-4  # some come late
        due = machine.monotonic() + left
        rehearse(due)
        if k >= 8:  # it has learnt by then what a pass takes
            assert machine.t <= due
            assert (passes - before) * cost <= 0.5 * left  # others have the processor half the time
    assert (passes > 10) == (cost < 1e-3)


def test_a_deadline_that_passes_while_the_twin_is_prepared_is_no_error(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = make()
    machine = Machine(daemon, 0.0)
    monkeypatch.setattr(module, "time", machine)
    daemon.rehearse(1e-3)
    rehearse, late = rehearsal_of(daemon), machine.monotonic() + 1e-3
    monkeypatch.setattr(rehearse.likeness, "take", lambda: machine.sleep(1e-3))
    monkeypatch.setattr(rehearse, "_pass", lambda _: pytest.fail("no time for it"))
    rehearse(late - 5e-4)
    assert machine.monotonic() == late


def test_an_error_of_the_twin_ends_the_rehearsal_and_nothing_else(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = make()
    monkeypatch.setattr(module, "time", Machine(daemon, 1e-4))
    daemon.rehearse(1e-3)
    events: list[tuple[str, str, str]] = []
    monkeypatch.setattr(daemon.loop, "_on_event", lambda *event: events.append(event))
    monkeypatch.setattr(rehearsal_of(daemon).twin, "tick", lambda _: 1 // 0)
    before = daemon.loop.state.seq
    daemon.loop.advance(0.02)
    assert daemon.loop.state.seq == before + 10
    assert daemon.loop.rehearsal is None
    assert [event[:2] for event in events] == [("warning", "rehearsal")]
    assert "ZeroDivisionError" in events[0][2]
