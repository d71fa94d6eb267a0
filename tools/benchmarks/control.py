"""The error that each grip law leaves of the angle at which an object was put between the fingers.

Judged by the plant's truth, not by the daemon's estimates, over plants that differ from the
settings. The sensor is the ideal one, or one of those with flaws. On virtual time: nothing here
depends on the machine's speed. Beside the daemon's laws stands one of the literature, equal
torques: the law upright without its spring and dither.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from softfinger.tools.benchmarks.measuring import Report, figure
from softfinger.tools.benchmarks.rigs import SENSORS, SOLID, Sections, merged
from softfinger.tools.watched import Watched

_FORCE = 10.0  # N
_ASKEW = math.radians(5.0)
_DRAWS = 12  # of how the plant differs from the settings, the same for all laws
_FOUND = 5.0  # s from the command to grasp on, when the object's angle is read
_STEERED = "energy, steered to 0"  # by its measured angle
EQUAL_TORQUES = {"law": "upright", "dither_time": 0.0, "joint_stiffness": 1e-9}
_RELAXING: Sections = {"simulation": {"tip_creep_time": 20.0, "tip_micro_slip": True}}
# Settings of `control`, tips, aim for what is left [°].
WAYS: dict[str, tuple[dict[str, Any], Sections, float | None]] = {
    "equal torques (blind)": (EQUAL_TORQUES, {}, None),
    "equal torques, tips that relax": (EQUAL_TORQUES, _RELAXING, None),
    "equal torques, solid tips": (EQUAL_TORQUES, SOLID, None),
    "energy": ({}, {}, None),
    _STEERED: ({}, {}, 0.2),
    "upright (blind)": ({"law": "upright"}, {}, 0.5),
    "upright, tips that relax": ({"law": "upright"}, _RELAXING, 0.5),
    "upright, solid tips": ({"law": "upright"}, SOLID, 0.5),
    **{f"{_STEERED}, {sensor}": ({}, flaws, 1.0) for sensor, flaws in SENSORS.items()},
}


def measure(brief: bool = False) -> list[Report]:
    """Return the angles that are left [°]; p99 of a few draws is about the worst of them."""
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
        for k in range(2 if brief else _DRAWS)
    ]
    rows = []
    for name, (law, tips, aim) in WAYS.items():
        left = []
        for draw in drawn:
            with Watched(merged({"simulation": draw, "control": law}, tips)) as hand:
                hand.grasp(_FORCE)
                hand.run(_FOUND - 2.0)
                if name.startswith(_STEERED):
                    hand.command("rotate", angle=0.0)
                hand.run(2.0)
                left.append(math.degrees(abs(float(hand.plant.object_pose[2]))))
        rows.append(figure(name, "°", left, aim))
    return [Report(f"left of {math.degrees(_ASKEW):g}° after {_FOUND:g} s at {_FORCE:g} N", rows)]
