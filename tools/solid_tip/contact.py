"""A rigid plane without friction on the hemisphere: a linear complementarity problem on its cells.

A cell's unknown is its push q ≥ 0 along the plane's normal n = (sin θ, 0, cos θ), both mirror
images y and −y together. With the compliance C the cells move by C q; the plane overlaps them by
δ = X·n − (a − d); so q ≥ 0, C q − δ ≥ 0, q·(C q − δ) = 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from softfinger.tools.solid_tip.green import Green
from softfinger.tools.solid_tip.meridian import FloatArray

BEYOND = 0.06  # cells may touch that far outside of the undeformed overlap [a]


class Press(NamedTuple):
    """One press, for E = a = 1."""

    d: float
    theta: float
    push: float  # N along the plane's normal
    energy: float  # U
    base: FloatArray  # (H, B) base pressure's cosine harmonics at the base's nodes


class TiltedPlane:
    """The plane at tilt θ [rad]; presses up to depth ``d_max`` [a]."""

    def __init__(self, green: Green, theta: float, d_max: float) -> None:
        self.green, self.theta = green, theta
        sine, cosine = np.sin(theta), np.cos(theta)
        m = np.arange(len(green.rings))[:, None]
        rings, reach = [], []
        self.parts = []  # of each ring: slice of cells, loads (3, M, n), shares (M, 1)
        count = 0
        for ring, (cells, (r, z)) in enumerate(zip(green.cells, green.place, strict=True)):
            phi = 2 * np.pi * (np.arange(cells // 2) + 0.5) / cells
            height = r * np.cos(phi) * sine + z * cosine
            near = height > 1 - d_max - BEYOND
            phi, half = phi[near], cells // 2
            # n in cylindrical components, and its harmonics up to what the ring's cells resolve.
            load = np.array(
                [
                    sine * np.cos(phi) * np.cos(m * phi),
                    -sine * np.sin(phi) * np.sin(m * phi),
                    cosine * np.cos(m * phi),
                ]
            )
            share = np.where((m == 0) | (m == half), 1.0, 2.0) * (m <= half) / (2 * np.pi)
            where = slice(count, count + phi.size)
            self.parts.append((where, load / green.weight[ring], share))
            rings.append(np.full(phi.size, ring))
            reach.append(height[near])
            count += phi.size
        self.ring, self.reach = np.concatenate(rings), np.concatenate(reach)
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
        self.push = np.zeros(count)

    def press(self, d: float) -> Press:
        """Solve at depth ``d``, beginning with the cells that touched at the last press.

        Raises RuntimeError where the active sets do not settle.
        """
        overlap = self.reach - (1 - d)
        touching = self.push > 0 if self.push.any() else overlap > 0.4 * d
        for _ in range(60):
            held = np.ix_(touching, touching)
            factors = cho_factor(self.compliance[held], check_finite=False)
            push = np.zeros_like(overlap)
            push[touching] = cho_solve(factors, overlap[touching], check_finite=False)
            now = np.where(touching, push > 0, self.compliance @ push < overlap)
            if (now == touching).all():
                break
            touching = now
        else:
            raise RuntimeError(f"no contact found at d = {d} a, θ = {self.theta} rad")
        self.push = push
        base = np.zeros(self.green.base.shape[:2])
        for ring in np.unique(self.ring):
            where, load, share = self.parts[ring]
            each = (load @ push[where] * share[:, 0])[:, : len(base)]
            base -= np.einsum("mba,am->mb", self.green.base[..., ring], each)
        energy = float(push @ overlap / 2)
        return Press(d, self.theta, float(push.sum()), energy, base)
