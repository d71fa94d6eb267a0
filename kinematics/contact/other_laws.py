"""Other contact laws, for comparison only: radial springs, Hertz, and the Xydas-Kao power law.

Each gives the normal force N [N] and the energy U [J] of a tip of radius a pressed in by d. None of
them knows the face's tilt: their energy is flat in θ, where the model of parallel springs has a
minimum. Array functions; d ≤ 0 gives zeros and NaN gives NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray

from softfinger.kinematics.contact.closed_form import Fingertip

FloatArray = NDArray[np.float64]


def _displacement(d: ArrayLike, radius: float) -> FloatArray:
    """d with d ≤ 0 as 0. Raises ValueError past the tip's radius."""
    depth = np.asarray(d, dtype=np.float64)
    if np.any(depth > radius):
        raise ValueError(f"displacement exceeds the tip's radius of {radius} m")
    return np.where(depth < 0.0, 0.0, depth)


@dataclass(frozen=True)
class RadialModel:
    """Springs that point at the tip's centre (Nguyen and Arimoto), modulus E [Pa].

    N = πE d² and U = πa³E[1 − κ² + 2κ ln κ] with κ = (a − d)/a, whatever the tilt.
    """

    tip: Fingertip
    modulus: float

    def force(self, d: ArrayLike) -> FloatArray:
        """N [N], shape of d."""
        depth = _displacement(d, self.tip.radius)
        return np.asarray(math.pi * self.modulus * depth**2)

    def energy(self, d: ArrayLike) -> FloatArray:
        """U [J], shape of d."""
        delta = _displacement(d, self.tip.radius) / self.tip.radius
        # 2 Σ δ^k/(k(k − 1)) from k = 3 on is the bracket, without its cancellation.
        series = np.zeros_like(delta)
        small = np.minimum(delta, 0.3)
        for k in range(34, 2, -1):
            series = series * small + 2.0 / (k * (k - 1.0))
        series = series * small**3
        kappa = np.maximum(1.0 - np.maximum(delta, 0.3), np.finfo(float).tiny)
        direct = 1.0 - kappa**2 + 2.0 * kappa * np.log(kappa)
        bracket = np.where(delta <= 0.3, series, direct)
        return np.asarray(math.pi * self.tip.radius**3 * self.modulus * bracket)


@dataclass(frozen=True)
class HertzModel:
    """A linear elastic sphere on a rigid plane: N = (4/3)E*√a d^(3/2), E* = E/(1 − ν²).

    ``modulus`` E [Pa], ``poisson`` ν; small displacements only.
    """

    tip: Fingertip
    modulus: float
    poisson: float = 0.5

    def force(self, d: ArrayLike) -> FloatArray:
        """N [N], shape of d."""
        depth = _displacement(d, self.tip.radius)
        stiffness = self.modulus / (1.0 - self.poisson**2)
        return np.asarray(4.0 / 3.0 * stiffness * math.sqrt(self.tip.radius) * depth**1.5)

    def energy(self, d: ArrayLike) -> FloatArray:
        """U = ∫N dd = (2/5) N d [J], shape of d."""
        return np.asarray(0.4 * self.force(d) * _displacement(d, self.tip.radius))


@dataclass(frozen=True)
class PowerLawModel:
    """The soft-finger power law of Xydas and Kao: contact radius r_c = c N^γ, 0 ≤ γ ≤ 1/3.

    ``coefficient`` c [m/N^γ], ``exponent`` γ, ``shape`` k of the pressure
    p(r) = C_k N/(πr_c²)·[1 − (r/r_c)^k]^(1/k). The contact radius is taken as that of the sphere
    cut at depth d, r_c² = 2ad − d², which makes N a function of d. Raises ValueError for other γ
    or k.
    """

    tip: Fingertip
    coefficient: float
    exponent: float = 1.0 / 3.0
    shape: float = 2.0

    def __post_init__(self) -> None:
        if not 0.0 < self.exponent <= 1.0 / 3.0:
            raise ValueError(f"the exponent must lie in (0, 1/3], not {self.exponent}")
        if not (self.coefficient > 0.0 and self.shape > 0.0):
            raise ValueError("the coefficient and the pressure's shape must be positive")

    @classmethod
    def through(
        cls, tip: Fingertip, d: float, force: float, exponent: float = 1.0 / 3.0, shape: float = 2.0
    ) -> PowerLawModel:
        """The law that gives ``force`` [N] at displacement ``d`` [m]."""
        radius = math.sqrt(d * (2.0 * tip.radius - d))
        return cls(tip, radius / force**exponent, exponent, shape)

    @property
    def pressure_factor(self) -> float:
        """C_k = 3kΓ(3/k)/(2Γ(1/k)Γ(2/k)), 1.5 for k = 2."""
        k = self.shape
        gamma = math.gamma
        return 1.5 * k * gamma(3.0 / k) / (gamma(1.0 / k) * gamma(2.0 / k))

    def contact_radius(self, d: ArrayLike) -> FloatArray:
        """r_c [m], shape of d."""
        depth = _displacement(d, self.tip.radius)
        return np.asarray(np.sqrt(depth * (2.0 * self.tip.radius - depth)))

    def force(self, d: ArrayLike) -> FloatArray:
        """N = (r_c/c)^(1/γ) [N], shape of d."""
        return np.asarray((self.contact_radius(d) / self.coefficient) ** (1.0 / self.exponent))

    def energy(self, d: ArrayLike) -> FloatArray:
        """U = ∫N dd [J], shape of d; Gauss quadrature in √d, to rounding for γ = 1/3."""
        depth = _displacement(d, self.tip.radius)
        points, weights = leggauss(40)
        roots = 0.5 * (points + 1.0)
        forces = self.force(depth[..., None] * roots**2)
        return np.asarray((forces * roots * weights).sum(axis=-1) * depth)

    def pressure(self, radius: ArrayLike, d: ArrayLike) -> FloatArray:
        """p(r) [Pa] at ``radius`` r [m] from the contact's centre; zero outside the contact."""
        edge = self.contact_radius(d)
        with np.errstate(divide="ignore", invalid="ignore"):
            inner = np.asarray(radius, dtype=np.float64) / edge
            mean = self.force(d) / (math.pi * edge**2)
        fall = np.maximum(1.0 - inner**self.shape, 0.0) ** (1.0 / self.shape)
        return np.asarray(np.where(edge > 0.0, self.pressure_factor * mean * fall, 0.0))
