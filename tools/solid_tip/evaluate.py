"""What the data file says at a press, in plain NumPy: for checks and pictures, not for the loop."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from softfinger.tools.solid_tip.meridian import FloatArray


class SolidTip:
    """One block of the file's arrays at one ν, for E = a = 1."""

    def __init__(
        self, arrays: Mapping[str, NDArray[np.generic]], block: str, poisson: float
    ) -> None:
        low, high = arrays["nu_range"]
        y = (2 * poisson - low - high) / (high - low)
        self.poisson = poisson
        self.s_max, self.theta_max = float(arrays["s_max"]), float(arrays["theta_max"])
        self.push, self.energy, self.coef = (
            chebyshev.chebval(y, np.moveaxis(arrays[f"{block}.{name}"].astype(float), -1, 0))
            for name in ("push", "energy", "coef")
        )
        self.m = arrays[f"{block}.m"].astype(int)
        self.basis = arrays[f"{block}.basis"].astype(float)
        self.edges = arrays["ring_edges"].astype(float)

    def press(self, d: float, theta: float) -> tuple[float, float, FloatArray]:
        """Push N, energy U and the base pressure's harmonics (H, R) as means over the rings."""
        s = np.sqrt(d)
        x = 2 * s / self.s_max - 1
        w = 2 * (np.sin(theta) / np.sin(self.theta_max)) ** 2 - 1
        hertz = 4 / (3 * (1 - self.poisson**2)) * s**3
        push = hertz * (1 + s * chebyshev.chebval2d(x, w, self.push))
        energy = 0.4 * hertz * s**2 * (1 + s * chebyshev.chebval2d(x, w, self.energy))
        amplitude = (
            chebyshev.chebval2d(x, w, self.coef.transpose(1, 2, 0)) * np.sin(theta) ** self.m
        )
        amplitude[0] = np.cos(theta) * (1 - np.sin(theta) ** 2 * amplitude[0])  # F/N
        pressure = np.zeros((self.m.max() + 1, self.edges.size - 1))
        np.add.at(pressure, self.m, push * amplitude[:, None] * self.basis)
        return push, energy, pressure

    def frame(self, pressure: FloatArray, pitch: float, cells: int) -> FloatArray:
        """Means over a square grid of cells centred under the tip, rows along y."""
        parts, turns = 10, 2000  # each ring goes to the cells in so many pieces
        edges = np.interp(
            np.arange(parts * (self.edges.size - 1) + 1) / parts,
            np.arange(self.edges.size),
            self.edges,
        )
        r = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2)[:, None]
        phi = 2 * np.pi * (np.arange(turns) + 0.5) / turns
        share = np.repeat(pressure, parts, axis=1).T @ np.cos(
            np.arange(len(pressure))[:, None] * phi
        )
        share *= (np.diff(edges**2) * np.pi / turns / pitch**2)[:, None]
        column, row = (
            np.floor(r * f(phi) / pitch).astype(int) + cells // 2 for f in (np.cos, np.sin)
        )
        out = np.zeros((cells, cells))
        np.add.at(out, (row, column), share)
        return out


def rms_difference(one: ArrayLike, other: ArrayLike) -> float:
    """Root mean square of the difference over that of ``other``."""
    return float(np.linalg.norm(np.subtract(one, other)) / np.linalg.norm(other))
