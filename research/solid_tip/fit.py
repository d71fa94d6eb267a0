"""Fit a polynomial to the energies of presses, and modes to the base pressures.

One polynomial for U/U_Hertz is fitted to energies and normal forces together, so N = ∂U/∂d holds
exactly. For each harmonic, the modes are the singular vectors of the base pressure divided by N.
The mode amplitudes are also polynomials. All polynomials are Chebyshev series in s = √(d/a), sin²θ
and ν. The notes in the file describe the layout of the coefficients. `SolidTip` needs only NumPy to
read the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from research.solid_tip.contact import Press
from research.solid_tip.green import GAUSS, RING_EDGES, FloatArray, quadratic

# The plane stays above the base because sin 36° < 1 − D_MAX.
D_MAX, THETA_MAX = 0.4, np.radians(36.0)
NU = (0.45, 0.4995)
S_MAX = np.sqrt(D_MAX)
ORDERS = (11, 6)  # number of coefficients in s, and in sin²θ
HARMONICS = 9
# Cells beyond this radius are down-weighted. A bonded tip has a stress singularity at the rim, and
# the base of a lying tip ends at the rim.
RIM = 0.95


def chebyshev_nodes(low: float, high: float, count: int) -> FloatArray:
    """Return Chebyshev points of the first kind on [low, high] in ascending order."""
    return (low + high) / 2 - (high - low) / 2 * np.cos(np.pi * (np.arange(count) + 0.5) / count)


class Samples(NamedTuple):
    """Arrays with one row per press, for one base type and one ν."""

    d: FloatArray
    theta: FloatArray
    push: FloatArray
    energy: FloatArray
    shear: FloatArray
    base: FloatArray  # harmonics of the base pressure, averaged over rings (n, H, R)

    @classmethod
    def of(cls, presses: list[Press], base_radius: FloatArray) -> Samples:
        """Collect ``presses``; ``base_radius`` contains the radii of the base nodes."""
        rings = ring_means(base_radius)
        d, theta, push, energy, shear = (
            np.array([getattr(each, name) for each in presses])
            for name in ("d", "theta", "push", "energy", "shear")
        )
        base = np.array([each.base[:HARMONICS] @ rings.T for each in presses])
        return cls(d, theta, push, energy, shear, base)


def ring_means(base_radius: FloatArray) -> FloatArray:
    """Return the matrix (R, B) that averages the nodal values of quadratic elements over rings."""
    points, gauss = GAUSS
    ends = base_radius[::2]
    cuts = np.unique(np.concatenate([RING_EDGES, ends]))
    cuts = cuts[cuts <= ends[-1]]
    out = np.zeros((RING_EDGES.size - 1, base_radius.size))
    for low, high in pairwise(cuts):
        r = (low + high) / 2 + (high - low) / 2 * points
        middle = (low + high) / 2
        j = int(np.searchsorted(ends, middle)) - 1
        ring = int(np.searchsorted(RING_EDGES, middle)) - 1
        local = 2 * (r - ends[j]) / (ends[j + 1] - ends[j]) - 1
        out[ring, 2 * j : 2 * j + 3] += (gauss * r * (high - low)) @ quadratic(local)[0]
    return out / np.diff(RING_EDGES**2)[:, None]


def terms(
    s: FloatArray, theta: FloatArray, orders: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return the products T_i T_j at each point, shape (n, I·J), and their derivatives in s."""
    x, w = 2 * s / S_MAX - 1, 2 * (np.sin(theta) / np.sin(THETA_MAX)) ** 2 - 1
    first, second = chebyshev.chebvander(x, orders[0] - 1), chebyshev.chebvander(w, orders[1] - 1)
    slope = chebyshev.chebval(x, chebyshev.chebder(np.eye(orders[0]))).T * (2 / S_MAX)
    value, rise = (np.einsum("ni,nj->nij", each, second) for each in (first, slope))
    return np.asarray(value.reshape(s.size, -1)), np.asarray(rise.reshape(s.size, -1))


def energy_terms(s: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the contribution of each energy coefficient to U/U_Hertz and N/N_Hertz."""
    value, slope = terms(s, theta, ORDERS)
    return s[:, None] * value, s[:, None] * (1.2 * value + 0.2 * s[:, None] * slope)


def fit_energy(samples: Samples, poisson: float, step: float) -> FloatArray:
    """Fit the coefficients (I, J) of V in U = U_Hertz (1 + s V); ``step`` is the cell width."""
    s = np.sqrt(samples.d)
    hertz = 4 / (3 * (1 - poisson**2)) * s**3
    of_energy, of_push = energy_terms(s, samples.theta)
    # Scatter of U and N between meshes, for this cell width and each contact radius s.
    scatter = 1e-4 + np.concatenate([0.05 * (step / s) ** 2, 0.2 * (step / s) ** 2 + 5e-4])
    right = np.concatenate([samples.energy / (0.4 * hertz * s**2) - 1, samples.push / hertz - 1])
    left = np.concatenate([of_energy, of_push])
    found = np.linalg.lstsq(left / scatter[:, None], right / scatter, rcond=None)[0]
    return np.asarray(found.reshape(ORDERS), dtype=np.float64)


def push_of(energy: FloatArray) -> FloatArray:
    """Convert coefficients of V to coefficients of Q = 6/5 V + s/5 ∂V/∂s; N = N_Hertz (1 + s Q)."""
    slope = chebyshev.chebder(energy, axis=0) * (2 / S_MAX)
    s = np.array([S_MAX / 2, S_MAX / 2])  # Chebyshev series of the variable s
    product = np.apply_along_axis(lambda row: chebyshev.chebmul(s, row), 0, slope)
    return np.asarray(1.2 * energy + 0.2 * product[: len(energy)])


def over_nu(values: FloatArray) -> FloatArray:
    """Convert values at the ν nodes (first axis) to Chebyshev coefficients (last axis)."""
    count = len(values)
    x = chebyshev_nodes(-1, 1, count)
    inverse = np.linalg.inv(chebyshev.chebvander(x, count - 1))
    return np.asarray(np.einsum("ln,n...->...l", inverse, values))


def fit(
    all_samples: list[Samples], nodes: FloatArray, step: float, tolerance: float
) -> dict[str, FloatArray]:
    """Fit the arrays of one base type; ``nodes`` are the samples' ν values (Chebyshev points)."""
    energy = np.array(
        [fit_energy(one, nu, step) for one, nu in zip(all_samples, nodes, strict=True)]
    )
    push = np.array([push_of(each) for each in energy])
    areas = np.pi * np.diff(RING_EDGES**2)
    patterns = np.array([one.base / one.push[:, None, None] for one in all_samples])
    s, theta = np.sqrt(all_samples[0].d), all_samples[0].theta
    design = terms(s, theta, ORDERS)[0]
    # The shear force along the plane is T = N sin θ cos θ Q, so F = N cos θ (1 − sin² θ Q).
    slope = np.sin(theta) * np.cos(theta)
    ratio = np.array([one.shear / one.push for one in all_samples])
    stick = np.linalg.lstsq(design * slope[:, None], ratio.T, rcond=None)[0].T
    force = np.cos(theta) - ratio * np.sin(theta)
    first = np.mean(patterns[:, :, 0] / force[..., None], axis=(0, 1))
    first /= areas @ first
    patterns[:, :, 0] -= force[..., None] * first
    scale = np.sqrt(areas @ first**2)
    ms, basis, coef = [0], [first], [over_nu(stick.reshape(-1, *ORDERS))]
    levers = np.pi * np.diff(RING_EDGES**3) / 3
    for m in range(HARMONICS):
        weight = np.sqrt(areas * (1.0 if m == 0 else 0.5)) * np.where(RING_EDGES[1:] > RIM, 0.05, 1)
        flat = patterns[:, :, m] * weight
        # Include the base moment, so that the modes reproduce this moment despite the low weights
        # at the rim.
        moment = (m == 1) * 2.0 * patterns[:, :, m] @ levers
        flat = np.concatenate([flat, moment[..., None]], axis=-1)
        _, size, rows = np.linalg.svd(flat.reshape(-1, areas.size + 1), full_matrices=False)
        # RMS amplitude of the truncated modes.
        left = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / flat[..., 0].size) / scale
        turned = design * np.sin(theta)[:, None] ** m
        for row in rows[: int(np.sum(left > tolerance))]:
            ms.append(m)
            basis.append(row[:-1] / weight)
            each = np.linalg.lstsq(turned, (flat @ row).T, rcond=None)[0].T.reshape(-1, *ORDERS)
            coef.append(over_nu(each))
    return {
        "push": over_nu(push),
        "energy": over_nu(energy),
        "m": np.array(ms, dtype=np.int32),
        "basis": np.array(basis, dtype=np.float32),
        "coef": np.array(coef, dtype=np.float32),
    }


class SolidTip:
    """Solid tip with E = a = 1 at one ν, from one block of the data file."""

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
        """Return the normal force N, the energy U and the harmonics of the base pressure (H, R)."""
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

    def shear(self, d: float, theta: float) -> float:
        """Return T/N for a sticking face; T is the force on the tip along (cos θ, 0, −sin θ)."""
        x = 2 * np.sqrt(d) / self.s_max - 1
        w = 2 * (np.sin(theta) / np.sin(self.theta_max)) ** 2 - 1
        stick = float(chebyshev.chebval2d(x, w, self.coef[0]))
        return stick * float(np.sin(theta) * np.cos(theta))


def cell_means(pressure: FloatArray, pitch: float, cells: int) -> FloatArray:
    """Average the base pressure over the cells of a square grid, with rows along y."""
    parts, turns = 10, 2000  # numbers of radial and angular pieces per ring
    edges = np.interp(
        np.arange(parts * (RING_EDGES.size - 1) + 1) / parts,
        np.arange(RING_EDGES.size),
        RING_EDGES,
    )
    r = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2)[:, None]
    phi = 2 * np.pi * (np.arange(turns) + 0.5) / turns
    share = np.repeat(pressure, parts, axis=1).T @ np.cos(np.arange(len(pressure))[:, None] * phi)
    share *= (np.diff(edges**2) * np.pi / turns / pitch**2)[:, None]
    column, row = (np.floor(r * f(phi) / pitch).astype(int) + cells // 2 for f in (np.cos, np.sin))
    out = np.zeros((cells, cells))
    np.add.at(out, (row, column), share)
    return out


def rms_difference(one: ArrayLike, other: ArrayLike) -> float:
    """Return the RMS difference divided by the RMS of ``other``."""
    return float(np.linalg.norm(np.subtract(one, other)) / np.linalg.norm(other))
