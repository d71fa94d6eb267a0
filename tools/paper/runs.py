"""The paper's two experiments run in simulation: plant, sensor, estimator and table, as the daemon
chains them.

Each run gives what is true and what was estimated from the frames, one row a frame; nothing is
drawn here. The sensor is the paper's: 44 × 44 cells on 58 mm, 40 ms a scan, with noise of 0.5 % of
the modulus in each cell.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from softfinger.daemon.loop.build import Daemon
from softfinger.daemon.profile.settings import Settings
from softfinger.daemon.simulation.physics.simulated_hand import SimulatedHand
from softfinger.daemon.types import Contact
from softfinger.tools.paper.sheets import FloatArray

Sections = dict[str, dict[str, Any]]
Row = tuple[tuple[float, float], tuple[float, ...]]  # true d and θ; `_estimates`

MODULUS = 0.304e6  # Pa
RADIUS = 0.020  # m
SCAN = 0.040  # s
TILTED = math.radians(11.5)  # by the finger's rotation about its root
ROLLED = math.radians(20.7)  # by the object's rolling, back
_SPEED = 0.002  # m/s, of compression
_GAP = 0.5e-3  # m before compression
_DEEPEST = 0.4 * RADIUS
_ROOT_DEPTH = 0.004  # m, that the finger's rotation ends at
_GIVES = math.radians(3.0)
_WIDTH = 0.040
_HALF_SEPARATION = 0.050
_ROLL_STEPS = 104  # frames in which the object rolls
_LATE = 2  # frames that are on their way


@dataclass(frozen=True)
class SimulatedRun:
    """One row a frame: truth and estimate of d [m], θ [rad], force [N] and energy [J]."""

    d: FloatArray
    theta: FloatArray
    force: FloatArray
    energy: FloatArray
    d_found: FloatArray
    theta_found: FloatArray
    force_found: FloatArray
    energy_found: FloatArray


def solid(modulus: float) -> Sections:
    """Return settings of a bonded solid tip of ``modulus`` [Pa] whose face is frictionless."""
    return {
        "tip": {"physics": "solid", "poisson": 0.49, "base": "bonded"},
        "material": {"modulus": modulus},
        "estimator": {"free_gain": False},
        "safety": {"d_max": _DEEPEST},
        "simulation": {"tip_friction": 0.0},
    }


def compression(tilt: float, tip: Sections | None = None) -> SimulatedRun:
    """Press the object, its face tilted by ``tilt`` [rad], onto the tip until d is 8 mm.

    ``tip`` are settings of another tip than the paper's springs.
    """
    x = -_HALF_SEPARATION + (RADIUS + 0.5 * _WIDTH + _GAP) / math.cos(tilt)
    sections: Sections = {
        "servos": {"backend": "none"},
        "simulation": {
            "object_position": (x, 0.080),
            "object_angle": tilt,
            "compression_speed": _SPEED,
        },
    }
    seconds = (_DEEPEST + _GAP) / math.cos(tilt) / _SPEED
    with _daemon(sections, tip) as daemon:
        return _collect(_frames(daemon, round(seconds / SCAN)), daemon)


def rotation() -> SimulatedRun:
    """Turn the finger by 11.5° about its root against a fixed object, from first touch on.

    The root is so far that d is 4 mm at the end. The servo moves the joint; d and θ are
    predicted from it between frames.
    """
    length = _ROOT_DEPTH / math.sin(TILTED)
    sections: Sections = {
        "hand": {"finger_length": length},
        "control": {"move_speed": 0.05},
        "simulation": {
            "object_position": (-_HALF_SEPARATION + RADIUS + 0.5 * _WIDTH, length),
            "object_height": 0.2,
        },
    }
    with _daemon(sections) as daemon:
        loop = daemon.loop
        loop.advance(0.3)
        loop.command({"command": "arm"})
        # The servo gives way under the force: its goal lies beyond.
        loop.command({"command": "move", "left": TILTED + _GIVES})
        assert daemon.hand is not None
        rows: list[Row] = []
        while loop.state.mode == "moving" or not rows:
            loop.advance(0.5 * SCAN)
            truth = float(daemon.hand.d[0]), float(daemon.hand.theta[0])
            if truth[1] > TILTED:
                break
            rows.append((truth, _estimates(loop.state.contacts[0])))
        return _collect(iter(rows), daemon)


def rolling(d: float, tip: Sections | None = None) -> SimulatedRun:
    """Roll the object on the fixed finger from 11.5° by 20.7° to −9.2°, ``d`` [m] held.

    ``tip`` as for :func:`compression`.
    """
    sections: Sections = {
        "servos": {"backend": "none"},
        "hand": {"open_angle": (TILTED, 0.0)},
        "simulation": {"object_height": 0.2, "compression_speed": 0.0},
    }

    def place(hand: SimulatedHand, fraction: float) -> None:
        _roll(hand, d, -ROLLED * fraction)

    with _daemon(sections, tip) as daemon:
        return _collect(_frames(daemon, _ROLL_STEPS, place), daemon)


def _daemon(*more: Sections | None) -> Daemon:
    merged: Sections = {
        "scene": {"fingers": ("left",)},
        "tip": {"radius": RADIUS},
        "material": {"law": "constant", "modulus": MODULUS},
        # A calibrated sensor: what its frames are higher is the tip, which is stiffer.
        "tactile": {"rate": 1.0 / SCAN, "noise": 0.005 * MODULUS, "gain_error": 1e-3},
        "loop": {"clock": "virtual"},
        "simulation": {
            "tactile_delay": SCAN,
            "tactile_noise": 0.005 * MODULUS,
            "object_height": 0.2,
        },
    }
    for sections in more:
        for name, values in (sections or {}).items():
            merged[name] = merged.get(name, {}) | values
    return Daemon(Settings.model_validate(merged), wire=False)


def _frames(
    daemon: Daemon, count: int, place: Callable[[SimulatedHand, float], None] | None = None
) -> Iterator[Row]:
    """Truth at each frame's instant, and the estimate from that frame alone."""
    hand, loop = daemon.hand, daemon.loop
    assert hand is not None
    if place is not None:
        place(hand, 0.0)
        loop.advance(3.0 * SCAN)  # frames of before have come
    last = loop.state.contacts[0].seq
    for k in range(count + _LATE):
        if place is not None:
            place(hand, min(k / (count - 1), 1.0))
        loop.advance(SCAN)
        contact = loop.state.contacts[0]
        if contact.seq == last:
            continue
        last = contact.seq
        sample = hand.sample(contact.seq - 1)
        truth = float(sample.d[0]), float(sample.theta[0])
        yield truth, _estimates(contact)


def _estimates(contact: Contact) -> tuple[float, ...]:
    if not contact.contact:
        return 0.0, math.nan, 0.0, 0.0
    return contact.d, contact.theta, contact.force, contact.energy


def _collect(rows: Iterator[Row], daemon: Daemon) -> SimulatedRun:
    found = list(rows)
    truth = np.array([each for each, _ in found])
    estimates = np.array([each for _, each in found])
    d, theta = np.maximum(truth[:, 0], 0.0), truth[:, 1]
    contact = daemon.tables[0](d, theta)
    return SimulatedRun(d, theta, contact.force, contact.energy, *estimates.T)


def _roll(hand: SimulatedHand, d: float, angle: float) -> None:
    """Put the held object where it has rolled to ``angle`` [rad] with ``d`` [m] held."""
    q = float(hand.q[0])
    parameters = hand.plant.parameters
    length = parameters.length
    tip = -_HALF_SEPARATION + length * math.sin(q), length * math.cos(q)
    out = RADIUS + 0.5 * _WIDTH - d
    along = (RADIUS - d) * angle  # the tip's place on the face, by rolling
    parameters.script_x = tip[0] + out * math.cos(angle) + along * math.sin(angle)
    hand.object_pose[:] = (
        parameters.script_x,
        tip[1] + out * math.sin(angle) - along * math.cos(angle),
        angle,
    )
    hand.refresh()
