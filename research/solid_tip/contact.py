"""Solve contact between a rigid plane and the hemisphere as a linear complementarity problem.

Without friction, each surface cell has one unknown force q ≥ 0 along the plane's normal n = (sin θ,
0, cos θ). The same force acts on the cell's mirror image at −y. The cells move by C q, where C is
the compliance. The plane overlaps a cell at X by δ = X·n − (a − d). Contact therefore requires q ≥
0, C q − δ ≥ 0 and q·(C q − δ) = 0.

On a sticking face, two additional forces along the plane hold each cell at its point of first
contact. The result then depends on the plane's path. The plane moves straight along n. Stuck points
therefore do not move along the plane, and the tangential forces do no work. The relation N = ∂U/∂d
therefore holds with and without friction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from research.solid_tip.green import FloatArray, Green

# Maximum distance of contact cells from the undeformed overlap [a].
BEYOND = 0.06


class Press(NamedTuple):
    """Result of one press, for E = a = 1."""

    d: float
    theta: float
    push: float  # normal force N
    energy: float  # U
    base: FloatArray  # cosine harmonics of the base pressure at the base nodes (H, B)
    shear: float  # force on the tip along (cos θ, 0, −sin θ), or 0 without friction


class TiltedPlane:
    """Plane at tilt θ [rad] for presses up to depth ``d_max`` [a], with or without sticking."""

    def __init__(self, green: Green, theta: float, d_max: float, sticking: bool = False) -> None:
        self.green, self.theta = green, theta
        sine, cosine = np.sin(theta), np.cos(theta)
        axes = np.array([[sine, 0.0, cosine], [cosine, 0.0, -sine], [0.0, 1.0, 0.0]])
        self.axes = axes = axes if sticking else axes[:1]
        m = np.arange(len(green.rings))[:, None, None]
        rings, places = [], []
        self.parts = []  # for each ring: slice of the forces, loads (3, M, n), shares (M, 1)
        count = 0
        for ring, (cells, (r, z)) in enumerate(zip(green.cells, green.place, strict=True)):
            phi = 2 * np.pi * (np.arange(cells // 2) + 0.5) / cells
            height = r * np.cos(phi) * sine + z * cosine
            near = height > 1 - d_max - BEYOND
            phi, half = phi[near, None], cells // 2
            # Convert the axes to cylindrical components of each harmonic.
            x, y, upright = axes.T
            load = np.stack(
                np.broadcast_arrays(
                    (x * np.cos(phi) + y * np.sin(phi)) * np.cos(m * phi),
                    (y * np.cos(phi) - x * np.sin(phi)) * np.sin(m * phi),
                    upright * np.cos(m * phi),
                )
            ).reshape(3, len(m), -1)
            share = np.where((m == 0) | (m == half), 1.0, 2.0) * (m <= half) / (2 * np.pi)
            where = slice(count, count + load.shape[2])
            self.parts.append((where, load / green.weight[ring], share[:, 0]))
            rings.append(np.full(phi.size, ring))
            places.append(np.hstack([0 * phi + z, r * np.cos(phi), r * np.sin(phi)]))
            count += load.shape[2]
        self.ring = np.concatenate(rings)
        self.places = np.concatenate(places)  # coordinates (z, x, y) of each cell
        self.reach = self.places @ (cosine, sine, 0.0)
        self.compliance = np.zeros((count, count))
        used = np.unique(self.ring)
        for i in used:
            at_i, left, _ = self.parts[i]
            for j in used[used >= i]:
                at_j, right, _ = self.parts[j]
                top = min(green.cells[i], green.cells[j]) // 2 + 1
                share = np.sqrt(self.parts[i][2] * self.parts[j][2])[:top]
                response = green.rings[:top, :, i, :, j]
                moved = np.einsum("mab,bmk->amk", response, right[:, :top]) * share
                block = np.tensordot(left[:, :top], moved, axes=([0, 1], [0, 1]))
                self.compliance[at_i, at_j] = block
                self.compliance[at_j, at_i] = block.T
        self.touching = np.zeros(self.reach.size, dtype=np.bool_)
        self.moved = np.zeros(count)
        self.depth = 0.0

    def press(self, d: float) -> Press:
        """Solve at depth ``d``, starting from the contact cells of the last press.

        With a sticking face, the result depends on the plane's path, so increase the depth in small
        steps. A cell that comes into contact during a step sticks at an interpolated position.
        Raises RuntimeError if the active sets do not converge.
        """
        overlap, step = self.reach - (1 - d), len(self.axes)
        before = self.moved
        room = before[::step] - overlap + (d - self.depth)
        touching = self.touching if self.touching.any() else overlap > 0.4 * d
        wanted = before.copy()
        wanted[::step] = overlap
        for _ in range(60):
            active = np.repeat(touching, step)
            factors = cho_factor(self.compliance[np.ix_(active, active)], check_finite=False)
            force = np.zeros_like(wanted)
            force[active] = cho_solve(factors, wanted[active], check_finite=False)
            moved = self.compliance @ force
            now = np.where(touching, force[::step] > 0, moved[::step] < overlap)
            if (now == touching).all():
                break
            new = now & ~touching
            share = room[new] / (room + overlap - moved[::step])[new]
            for k in range(1, step):
                was = before[k::step][new]
                wanted[k::step][new] = was + share * (moved[k::step][new] - was)
            touching = now
        else:
            raise RuntimeError(f"no contact found at d = {d} a, θ = {self.theta} rad")
        self.touching, self.moved, self.depth = touching, moved, d
        base = np.zeros(self.green.base.shape[:2])
        for ring in np.unique(self.ring):
            where, load, share = self.parts[ring]
            each = (load @ force[where] * share[:, 0])[:, : len(base)]
            base -= np.einsum("mba,am->mb", self.green.base[..., ring], each)
        push, energy = float(force[::step].sum()), float(force @ moved / 2)
        shear = float(force[1::step].sum()) if step > 1 else 0.0
        return Press(d, self.theta, push, energy, base, shear)
