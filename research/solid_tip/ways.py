"""What a sticking face does on its way: pressed down at a tilt, rotated, rolled.

``python -m research.solid_tip.ways tools/paper/solid_ways.npz`` writes it: an array for
each way, with columns d, θ and `Forces`, for E = a = 1. What comes to touch stays at its point of
the plane until it is pulled. So forces depend on the way, which no function of d and θ tells;
`solid_tip.npz` has one way alone, straight along the plane's normal.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from research.solid_tip.contact import TiltedPlane
from research.solid_tip.green import FloatArray, Green, green

TILTED, ROLLED = np.radians(11.5), np.radians(20.7)  # the paper's path
TILTS = range(0, 35, 5)  # [°]
DEPTHS = (0.2, 0.3)  # held while rolling [a]
D_MAX = 0.4
UP = np.array([1.0, 0.0, 0.0])  # vectors are (z, x, y)


class Pose(NamedTuple):
    """Where the plane is: tilt θ [rad] and the place of its own origin."""

    theta: float
    origin: FloatArray

    @property
    def axes(self) -> FloatArray:
        """Normal, and both directions along the plane, as rows."""
        sine, cosine = np.sin(self.theta), np.cos(self.theta)
        return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])

    def local(self, places: FloatArray) -> FloatArray:
        """Places in the plane's own coordinates."""
        return np.asarray((places - self.origin) @ self.axes.T)


class Forces(NamedTuple):
    """Of one pose, for E = a = 1: as in `contact.Press`, and F on the base."""

    push: float
    shear: float
    force: float
    energy: float


class StickingPlane:
    """A plane that holds what it touches, on its way; ``reach`` [a] as deep as cells may touch."""

    def __init__(self, surface: Green, reach: float) -> None:
        upright = TiltedPlane(surface, 0.0, reach, sticking=True)
        self.compliance, self.places = upright.compliance, upright.places
        self.touching = np.zeros(len(self.places), dtype=np.bool_)
        self.moved = np.zeros_like(self.places)
        self.held = np.zeros_like(self.places)  # in the plane's coordinates
        self.pose = Pose(0.0, UP)

    def go(self, pose: Pose) -> Forces:
        """Take a small step to ``pose``. Raises RuntimeError where the contact does not settle."""
        normal, along = pose.axes[0], pose.axes[1:]
        before = self.pose.local(self.places + self.moved)
        touching = self.touching if self.touching.any() else pose.local(self.places)[:, 0] > 0
        held = np.where(self.touching[:, None], self.held, pose.local(self.places))
        released = np.zeros_like(touching)
        for attempt in range(60):
            active = np.repeat(touching, 3)
            wanted = self.places - pose.origin - held[:, 1:] @ along
            factors = cho_factor(self.compliance[np.ix_(active, active)], check_finite=False)
            force = np.zeros_like(wanted)
            force[touching] = cho_solve(
                factors, wanted.ravel()[active], check_finite=False
            ).reshape(-1, 3)
            moved = -(self.compliance @ force.ravel()).reshape(-1, 3)
            now = pose.local(self.places + moved)
            # At last a cell that was released within this step is left alone.
            free_to = (now[:, 0] > 1e-12) & ~(released & (attempt > 15))
            next_one = np.where(touching, force @ normal > 0, free_to)
            if (next_one == touching).all():
                break
            new = next_one & ~touching
            share = np.clip(before[new, :1] / (before[new, :1] - now[new, :1]), 0.0, 1.0)
            held[new] = before[new] + share * (now[new] - before[new])
            released |= touching & ~next_one
            touching = next_one
        else:
            raise RuntimeError(f"no contact found at {pose}")
        self.touching, self.moved, self.held, self.pose = touching, moved, held, pose
        total = force.sum(axis=0)
        energy = float(-np.sum(force * moved) / 2)
        return Forces(float(total @ normal), float(total @ along[0]), float(total[0]), energy)


def straight(plane: StickingPlane, theta: float, d: float) -> Iterator[tuple[float, Forces]]:
    """Press along the plane's normal, up to ``d``."""
    normal = Pose(theta, UP).axes[0]
    for root in np.linspace(0.06, np.sqrt(d), 16):
        yield root**2, plane.go(Pose(theta, normal * (1 - root**2)))


def vertical(plane: StickingPlane, theta: float) -> Iterator[tuple[float, Forces]]:
    """Press along the tip's axis, as the paper's machine does; d is along the normal still."""
    normal = Pose(theta, UP).axes[0]
    for root in np.linspace(0.06, np.sqrt(D_MAX), 25):
        yield root**2, plane.go(Pose(theta, normal - UP * root**2 / np.cos(theta)))


def rotated(plane: StickingPlane, d: float) -> Iterator[tuple[float, Forces]]:
    """Rotate the finger from first touch until it is tilted and pressed by ``d``."""
    root = np.array([0.0, -d / np.sin(TILTED), 0.0])
    for theta in TILTED * np.arange(1, 24) / 23:
        pose = Pose(theta, UP)
        yield theta, plane.go(Pose(theta, root + (UP - root) @ pose.axes))


def rolled(
    plane: StickingPlane, d: float, by: float, steps: int = 45
) -> Iterator[tuple[float, Forces]]:
    """Roll the plane by an angle, ``d`` held: it turns about the foot of the tip's middle on it."""
    start, height = plane.pose, 1 - d
    at = start.local(height * start.axes[0])[1]
    for theta in start.theta + by * np.arange(1, steps + 1) / steps:
        axes = Pose(theta, UP).axes
        place = at + height * (theta - start.theta)
        yield theta, plane.go(Pose(theta, height * axes[0] - place * axes[1]))


def rows(surface: Green) -> Iterator[tuple[str, float, float, Forces]]:
    """Way, d, θ [rad] and forces."""
    new = partial(StickingPlane, surface)
    for tilt in np.radians(TILTS):
        for d, found in vertical(new(0.8), tilt):
            yield "pressed_down", d, tilt, found
    for d in DEPTHS:
        ways = {"pressed_straight": new(0.65), "rolled_there": new(0.65), "rotated": new(0.65)}
        *_, (_, found) = straight(ways["pressed_straight"], TILTED, d)
        firsts = {"pressed_straight": found}
        for _ in straight(ways["rolled_there"], 0.0, d):
            pass
        *_, (_, firsts["rolled_there"]) = rolled(ways["rolled_there"], d, TILTED, 25)
        *_, (_, firsts["rotated"]) = rotated(ways["rotated"], d)
        for name, plane in ways.items():
            yield name, d, TILTED, firsts[name]
            for theta, found in rolled(plane, d, -ROLLED):
                yield name, d, theta, found


def main() -> None:
    """Compute all ways of a bonded tip of ν = 0.49 and write them."""
    parser = argparse.ArgumentParser(prog="python -m research.solid_tip.ways", description=__doc__)
    parser.add_argument("out", type=Path, help="file to write, .npz")
    parser.add_argument("--rings", type=int, default=32, help="elements along the arc")
    arguments = parser.parse_args()
    surface = green(arguments.rings, 0.49, bonded=True, base_harmonics=1)
    found: dict[str, list[tuple[float, ...]]] = {}
    for way, d, theta, forces in rows(surface):
        found.setdefault(way, []).append((d, theta, *forces))
    arrays: dict[str, Any] = {way: np.array(each) for way, each in found.items()}
    np.savez_compressed(arguments.out, **arrays)


if __name__ == "__main__":
    main()
