"""Measurements that lie on the emulated hand, over serial bytes: its own true force is bounded."""

import select
from collections.abc import Iterator
from statistics import fmean
from typing import Any

import pytest

from tests.conftest import until
from tests.soak.rig import Rig

pytestmark = pytest.mark.extended
FORCE = 6.0  # N
LOOK, SETTLED = 3.5, 0.5  # s of the emulated hand's time, in all and in the end

GAIN = "left:gain=0.6@0..2"
CURRENT = "left:current=2"
REFUSED = "left:shift-x=3"  # the hand lets go


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    """An emulated hand and its daemon, which share one time, and wait for a busy machine."""
    with Rig() as made:
        text = made.config.read_text(encoding="utf-8").replace('loop.clock = "real"\n', "")
        made.config.write_text(text, encoding="utf-8")
        made.start("--set", "servos.fault_after=1.0")  # of the hand's time
        yield made


def mode(rig: Rig) -> str:
    return str((rig.status(60.0) or {"mode": "none"})["mode"])


def reaches(rig: Rig, wanted: str) -> None:
    until(lambda: mode(rig) in (wanted, "fault"))
    assert mode(rig) == wanted, rig.log()[-5:]


def gripped(rig: Rig) -> None:
    """Let an honest hand hold the object at its place."""

    def done(command: str, **numbers: float) -> None:
        reply: dict[str, Any] = rig.ask({"command": command, **numbers}, 60.0)
        assert reply["ok"], reply

    rig.send("well")
    if mode(rig) == "fault":
        done("clear")
    elif mode(rig) != "disarmed":
        done("disarm")
    done("arm")
    done("release")
    reaches(rig, "armed")
    rig.send("place")
    done("grasp", force=FORCE)
    reaches(rig, "holding")


def watched(rig: Rig) -> Iterator[dict[str, Any]]:
    """Yield the emulated hand's reports until it has lived for so long, or nothing drives it."""
    begin = rig.report()["t"]
    while True:
        report = rig.report()
        yield report
        driven = any(servo["torque"] for servo in report["servos"])
        if report["t"] > begin + LOOK or not driven:
            return
        select.select([], [], [], 0.005)  # the processor is for those who grip


@pytest.mark.parametrize("lie", [GAIN, CURRENT, REFUSED])
def test_a_lie_is_bounded_and_nothing_else_is_named(rig, lie):
    false = f"witness.{lie.split(':')[0]}_{'current' if lie == CURRENT else 'sensor'}"
    gripped(rig)
    before = len(rig.log())
    rig.send(lie)
    reports = list(watched(rig))
    assert max(max(report["force"]) for report in reports) < 1.3 * FORCE
    if lie != GAIN:  # which may be believed in part, and need not be named
        until(lambda: any(false in line for line in rig.log()[before:]))
    assert not [line for line in rig.log()[before:] if "witness." in line and false not in line]
    if lie == REFUSED:
        until(lambda: mode(rig) == "fault")
        return
    assert mode(rig) == "holding"
    end = reports[-1]["t"] - SETTLED
    last = fmean(fmean(report["force"]) for report in reports if report["t"] > end)
    assert last == pytest.approx(FORCE, rel=0.2)
