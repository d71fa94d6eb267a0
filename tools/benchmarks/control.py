"""What each grip law reaches on the simulated hand: how fast, how exact, and what angle it leaves.

Judged by the plant's truth, not by the daemon's estimates: forces on the tips' bases, the object's
angle, the friction that is left. On virtual time: nothing here depends on the machine's speed.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import numpy as np

from softfinger.tools.benchmarks.measuring import Report, figure
from softfinger.tools.benchmarks.rigs import merged
from softfinger.tools.watched import Watched

Sections = dict[str, dict[str, Any]]

_FORCE = 10.0  # N
_ANGLE = math.radians(10.0)
_NEAR_FORCE = 0.02  # share: settled
_NEAR_ANGLE = math.radians(0.2)
_WATCHED = 4.0  # s after a command
_STEADY = 1.0  # s at the end of that
# True mass and modulus over the settings'.
_OFF = ((1.0, 1.0), (0.7, 0.7), (0.7, 1.3), (1.3, 0.7), (1.3, 1.3))
_PAPER: Sections = {
    "material": {"law": "constant", "modulus": 0.304e6},
    "tactile": {"rate": 25.0},
    "simulation": {"tactile_delay": 0.040},
}
_ALONE = {"law": "position", "force_bandwidth": 0.0, "rotate_bandwidth": 0.0}
# Laws that grasp and turn: settings.
CASES: dict[str, Sections] = {
    "100 Hz frames": {},
    "paper, 25 Hz frames": _PAPER,
    "paper, two_phase": {**_PAPER, "control": {"law": "two_phase"}},
    "paper, position": {**_PAPER, "control": {"law": "position"}},
    "paper, position alone": {**_PAPER, "control": _ALONE},
}
# What is judged of each: unit and aim.
FIGURES = {
    "grasp, overshoot of either tip": ("%", 10.0),
    "grasp, settled within 2 % after contact": ("s", 1.0),
    "grasp, steady error of the mean force": ("%", 2.0),
    "rotate by 10°, settled within 0.2°": ("s", 1.5),
    "rotate by 20°, settled within 0.2°": ("s", 1.5),
    "rotate, steady error": ("°", 0.2),
    "rotate, either tip's force off its target": ("%", 10.0),
    "rotate, friction used, 1 slips": ("1", 1.0),
    "grasps or turns that failed": ("1", 0.0),
}
_ASKEW = math.radians(5.0)  # how an object is put between the fingers
_DRAWS = 12  # of how the plant differs from the settings, the same for all laws
_FOUND = 5.0  # s from the command to grasp on, when the object's angle is read
_RELAXING: Sections = {"simulation": {"tip_creep_time": 20.0, "tip_micro_slip": True}}
_SOLID: Sections = {
    "tip": {"physics": "solid"},
    "material": {"law": "constant", "modulus": 0.15e6},
    "estimator": {"free_gain": False},
}
# How an object that was put askew may come upright: law, tips, aim for what is left [°].
STEERED = "energy, steered to 0"  # by its measured angle
WAYS: dict[str, tuple[dict[str, Any], Sections, float | None]] = {
    "equal torques (blind)": ({"law": "blind"}, {}, None),
    "equal torques, tips that relax": ({"law": "blind"}, _RELAXING, None),
    "equal torques, solid tips": ({"law": "blind"}, _SOLID, None),
    "position alone": (_ALONE, {}, None),
    "two_phase": ({"law": "two_phase"}, {}, None),
    "energy": ({"law": "energy"}, {}, None),
    STEERED: ({"law": "energy"}, {}, 0.2),
    "upright (blind)": ({"law": "upright"}, {}, 0.5),
    "upright, tips that relax": ({"law": "upright"}, _RELAXING, 0.5),
    "upright, solid tips": ({"law": "upright"}, _SOLID, 0.5),
}


def measure(brief: bool = False) -> list[Report]:
    """All that the laws are judged by; p99 of a few trials is about the worst of them."""
    tables = []
    for name, sections in list(CASES.items())[: 1 if brief else None]:
        samples: defaultdict[str, list[float]] = defaultdict(list)
        for mass, modulus in _OFF[: 1 if brief else None]:
            plant = {"object_mass": 0.10 * mass, "modulus_scale": modulus}
            with Watched(merged({"simulation": plant}, sections)) as hand:
                held = _one_trial(hand, samples)
            samples["grasps or turns that failed"].append(float(not held))
        rows = [
            figure(text, unit, samples[text], aim)
            for text, (unit, aim) in FIGURES.items()
            if samples[text]
        ]
        tables.append(Report(f"control, {name}", rows))
    return [*tables, _upright(2 if brief else _DRAWS)]


def _one_trial(hand: Watched, samples: defaultdict[str, list[float]]) -> bool:
    """Grasp, and turn to both sides: whether the hand held to the end."""
    hand.grasp(_FORCE)
    seen = hand.watch(_WATCHED)
    touched = np.flatnonzero((seen.force > 0.3).all(axis=1))
    if not len(touched):
        return False
    seen = seen.since(int(touched[0]))
    mean = seen.force.mean(axis=1)
    last = mean[seen.t > seen.t[-1] - _STEADY]
    over = max(float(seen.force.max()) / _FORCE - 1.0, 0.0)
    settled = seen.settled(np.abs(mean - _FORCE) > _NEAR_FORCE * _FORCE)
    samples["grasp, overshoot of either tip"].append(100.0 * over)
    samples["grasp, settled within 2 % after contact"].append(settled)
    error = 100.0 * abs(float(last.mean()) / _FORCE - 1.0)
    samples["grasp, steady error of the mean force"].append(error)
    for angle, way in ((_ANGLE, 10), (-_ANGLE, 20)):
        if hand.mode != "holding":
            return False
        hand.command("rotate", angle=angle)
        seen = hand.watch(_WATCHED)
        settled = seen.settled(np.abs(seen.angle - angle) > _NEAR_ANGLE)
        samples[f"rotate by {way}°, settled within 0.2°"].append(settled)
        last = seen.angle[seen.t > seen.t[-1] - _STEADY]
        samples["rotate, steady error"].append(math.degrees(abs(float(last.mean()) - angle)))
        kept = 100.0 * float(np.abs(seen.force / _FORCE - 1.0).max())
        samples["rotate, either tip's force off its target"].append(kept)
        samples["rotate, friction used, 1 slips"].append(float(seen.slip.max()))
    return hand.mode == "holding"


def _upright(draws: int) -> Report:
    """What is left of the angle at which an object was put between the fingers."""
    rng = np.random.default_rng(16)
    drawn = [
        {
            "seed": k,
            "object_angle": _ASKEW * (-1.0) ** k,
            "object_position": (rng.uniform(-0.003, 0.003), 0.080),
            "modulus_scale": rng.uniform(0.7, 1.3),
            "tip_friction": rng.uniform(0.2, 0.8),
            "object_mass": 0.10 * 2.0 ** rng.uniform(-1.0, 1.0),
        }
        for k in range(draws)
    ]
    rows = []
    for name, (law, tips, aim) in WAYS.items():
        left = []
        for draw in drawn:
            with Watched(merged({"simulation": draw, "control": law}, tips)) as hand:
                hand.grasp(_FORCE)
                hand.run(_FOUND - 2.0)
                if name == STEERED:
                    hand.command("rotate", angle=0.0)
                hand.run(2.0)
                left.append(math.degrees(abs(float(hand.plant.object_pose[2]))))
        rows.append(figure(name, "°", left, aim))
    return Report(f"left of {math.degrees(_ASKEW):g}° after {_FOUND:g} s at {_FORCE:g} N", rows)
