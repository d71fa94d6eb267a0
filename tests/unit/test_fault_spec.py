"""Faults of the emulated hand in words: to which part, what, with which number, when."""

from __future__ import annotations

import pytest

from softfinger.daemon.simulation.faults import FaultError, parse_faults


def test_faults_in_words() -> None:
    words = [" silent=2@3 ", "silent", "left:torn=0.2", "right:frozen@1e1", "drop=0.1", "unplug@2"]
    assert parse_faults(words, (1, 2)) == [
        (0.0, "left", "silent", 1.0, 0.0),
        (0.0, "right", "silent", 1.0, 0.0),
        (0.0, "left", "torn", 0.2, 0.0),
        (0.0, "servos", "drop", 0.1, 0.0),
        (2.0, "servos", "unplug", 1.0, 0.0),
        (3.0, "servos", "silent", 2.0, 0.0),
        (10.0, "right", "frozen", 1.0, 0.0),
    ]
    assert parse_faults(["twist=-0.3@1", "push=15"], (1, 2)) == [
        (0.0, "object", "push", 15.0, 0.0),
        (1.0, "object", "twist", -0.3, 0.0),
    ]
    assert parse_faults(["well", "left:well@1", "right:plug", "noisy"], (1, 2)) == [
        (0.0, "servos", "well", 1.0, 0.0),
        (0.0, "left", "well", 1.0, 0.0),
        (0.0, "right", "well", 1.0, 0.0),
        (0.0, "right", "plug", 1.0, 0.0),
        (0.0, "left", "noisy", 0.1, 0.0),
        (0.0, "right", "noisy", 0.1, 0.0),
        (1.0, "left", "well", 1.0, 0.0),
    ]
    assert parse_faults(["left:gain=0.5@3..5", "current=2", "drift=-.2@.5...75"], (1, 2)) == [
        (0.0, "left", "current", 2.0, 0.0),
        (0.0, "right", "current", 2.0, 0.0),
        (0.5, "left", "drift", -0.2, 0.25),
        (0.5, "right", "drift", -0.2, 0.25),
        (3.0, "left", "gain", 0.5, 2.0),
    ]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "wrong-size"),
        ("melted", "wrong-size"),
        ("left:melted", "wrong-size"),
        ("left:drop=0.1", "wrong-size"),
        ("drop", "drop, late, .* =PROBABILITY"),
        ("middle:torn", "left: or right:"),
        ("push", "push, twist =NUMBER"),
        ("push=inf", "not a number"),
        ("gain", "gain, shift-x, .* =NUMBER"),
        ("gain=-1", "0 … 100"),
        ("drift=1.5", "-1 … 1"),
        ("replay=4", "0 … 3"),
        ("gain=2@3..1", "'1' is no time of 3 s or more"),
        ("gain=2@3..", "'' is no time of 3 s or more"),
        ("mirror=1@1..2", "mirror comes at once, at 1"),
        ("push=3@1..2", "push comes at once, at 1"),
        ("torn=2", "0 … 1"),
        ("left:silent=2", "0 … 1"),
        ("drop=7", "0 … 1"),
        ("torn=much", "not a number"),
        ("torn@never", "no time of 0 s or more"),
        ("torn@-1", "no time of 0 s or more"),
        ("drop=0.1@inf", "no time of 0 s or more"),
        ("silent=9", "no servo has that ID"),
        ("reboot=1.5", "no servo has that ID"),
    ],
)
def test_faults_that_can_not_be_understood(text: str, told: str) -> None:
    with pytest.raises(FaultError, match=told):
        parse_faults([text], (1, 2))
