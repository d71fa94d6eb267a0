"""Stress-strain laws of tip materials.

A law σ(ε) is a single polynomial for strains ε from 0 to 1. The stress σ(0) is 0, and the slope is
positive everywhere. The law is smooth and monotonic, so numerical integration converges quickly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from softfinger.kinematics.compiled.layout import FloatArray
from softfinger.kinematics.contact.material_fit import MaterialError, fit_law

__all__ = ["Material"]


# Measured tangent modulus [Pa] of the polyurethane tip versus strain, from Table I of the paper.
# The paper also lists the maximum modulus, 0.304 MPa, which occurs at strains above 100 %.
TABLE_I_STRAIN = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
TABLE_I_MODULUS = (0.135e6, 0.149e6, 0.182e6, 0.201e6, 0.207e6, 0.255e6)
TABLE_I_MAXIMUM = 0.304e6
# Exact coefficients c_1, c_2, … of σ [Pa]. The modulus is the lowest-degree polynomial that passes
# through the measured values and has zero slope at zero strain. The stress σ is the integral of the
# modulus.
_TABLE_I = "135000 0 610000/9 4671875/12 -3015625/3 14453125/18 -4296875/21"


@dataclass(frozen=True)
class Material:
    """Stress-strain law σ(ε) = Σ c_j ε^j with c_0 = 0.

    Create a material with `constant`, `table_i` or `from_points`. ``coefficients`` contains the
    exact values c_1, c_2, … [Pa]. Materials with equal coefficients compare equal.
    """

    coefficients: tuple[Fraction, ...]
    name: str = field(default="polynomial", compare=False)
    misfits: FloatArray | None = field(default=None, repr=False, compare=False)  # see from_points
    law: FloatArray = field(init=False, repr=False, compare=False)
    energy_law: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        c = tuple(Fraction(value) for value in self.coefficients)
        while len(c) > 1 and c[-1] == 0:
            c = c[:-1]
        if not c or c[0] <= 0:
            raise MaterialError("the law must have a positive modulus at zero strain")
        object.__setattr__(self, "coefficients", c)
        stress = (Fraction(0), *c)
        object.__setattr__(self, "law", _floats(stress))
        object.__setattr__(self, "energy_law", _floats(_integral(stress)))
        slope = np.polynomial.polynomial.polyval(
            np.linspace(0.0, 1.0, 513), [float(j * value) for j, value in enumerate(c, 1)]
        )
        if not np.all(slope > 0.0):
            worst = int(np.argmin(slope))
            raise MaterialError(
                "stress must increase with strain everywhere, but the slope is "
                f"{slope[worst]:.4g} Pa at strain {worst / 512:.3f}"
            )

    def __repr__(self) -> str:
        modulus = f"E₀ {1e-6 * self.reference_modulus:.4g} MPa"
        return f"Material: {self.name}, {modulus}, σ of degree {self.degree}"

    @classmethod
    def constant(cls, modulus: float) -> Material:
        """Return Hooke's law with modulus E [Pa]. Raises MaterialError unless 0 < E < ∞."""
        value = float(modulus)
        if not (value > 0.0 and math.isfinite(value)):
            raise MaterialError(f"the modulus must be positive and finite, got {modulus!r}")
        return cls((Fraction(value),), name="constant")

    @classmethod
    @cache
    def table_i(cls) -> Material:
        """Return a smooth law for the polyurethane measured in Table I of the paper.

        The paper lists slopes of the stress-strain curve ('Young's modulus, which corresponds to
        the slope'). These slopes are used as the tangent modulus dσ/dε. At strains of 0, 20, 40,
        60, 80 and 100 %, the modulus is 0.135, 0.149, 0.182, 0.201, 0.207 and 0.255 MPa. The
        modulus is interpolated by the lowest-degree polynomial with zero slope at zero strain. The
        zero slope is required because the paper calls the first value the smallest. The
        interpolating polynomial increases on [0, 1]. The largest modulus in the paper, 0.304 MPa,
        occurs above 100 % strain and is not used.
        """
        return cls(tuple(map(Fraction, _TABLE_I.split())), name="table_i")

    @classmethod
    def from_points(cls, strain: ArrayLike, stress: ArrayLike) -> Material:
        """Fit a smooth, monotonic law to measured points.

        Parameters
        ----------
        strain, stress
            Strain (a ratio) and stress [Pa]. The origin is implied. Points beyond strain 1 are
            ignored. If the points end before strain 1, the law continues with the slope at the last
            point.

        Returns
        -------
        Material
            Fitted material. The material's ``misfits`` [2, n] contain the strain of each point and
            the absolute difference between law and point [Pa].

        Raises
        ------
        MaterialError
            If there are too few points, or if they are not finite, not increasing, not zero at the
            origin, or too far from any valid law. The message lists all problems.
        """
        coefficients, misfits = fit_law(strain, stress)
        return cls(tuple(coefficients), name="points", misfits=misfits)

    @property
    def reference_modulus(self) -> float:
        """Modulus at zero strain, E₀ = dσ/dε [Pa]."""
        return float(self.coefficients[0])

    @property
    def fit_error(self) -> float:
        """Maximum difference between the law and the fitted points [Pa], or 0 without points."""
        return 0.0 if self.misfits is None else float(self.misfits[1].max())

    def force_error(self, ratio: ArrayLike) -> FloatArray:
        """Return the relative force error of an upright tip due to the misfit of the law.

        The force is F = 2π h² ∫ σ(ε)/(1 − ε)³ dε up to ε = d/a, with h = a − d. The force error is
        the same integral over the misfits, divided by F. The misfits are interpolated linearly,
        starting from 0 at zero strain. ``ratio`` is d/a in (0, 1]. The result is a number or an
        array of the shape of ``ratio``.
        """
        ratios = np.asarray(ratio, np.float64)
        if self.misfits is None:
            return np.zeros(ratios.shape)[()]
        ends = np.minimum(ratios[..., None], 0.999)
        strain = ends * (np.arange(200) + 0.5) / 200
        weight = (1.0 - strain) ** -3
        x, misses = np.concatenate([np.zeros((2, 1)), self.misfits], axis=1)
        missed = (np.interp(strain, x, misses) * weight).sum(axis=-1)
        error: FloatArray = missed / (self.stress(strain) * weight).sum(axis=-1)
        return error

    @property
    def worst_force_error(self) -> float:
        """Maximum relative force error due to the misfit of the law, for d/a from 0.05 to 1."""
        return float(self.force_error(np.linspace(0.05, 1.0, 20)).max())

    @property
    def is_linear(self) -> bool:
        """True for Hooke's law, for which the closed forms are exact."""
        return len(self.coefficients) == 1

    @property
    def degree(self) -> int:
        """Degree of the polynomial σ(ε)."""
        return len(self.coefficients)

    def stress(self, strain: ArrayLike) -> FloatArray:
        """Return the stress σ(ε) [Pa]; 0 for ε ≤ 0, linear for ε > 1, NaN for NaN input."""
        return _evaluate(self.law, strain, 1)

    def energy_density(self, strain: ArrayLike) -> FloatArray:
        """Return the energy density w(ε) = ∫₀^ε σ [J/m³]; 0 for ε ≤ 0, NaN for NaN input."""
        return _evaluate(self.energy_law, strain, 2)

    def expansions(self) -> FloatArray:
        """Return expansions of the law divided by E₀, float64 [7, order], which `quadrature` uses.

        Let S = σ/ε, W = 2w/ε² and T = dσ/dε, each divided by E₀ and therefore 1 at ε = 0. For each
        function X, let X_1 = (X − X(0))/ε and X_2 = (X_1 − X_1(0))/ε. The rows are S_1, W_1, T_1,
        S_2, S_2′, T_2 and T_2′. All expansions are polynomials, so there is no cancellation at
        small strain.
        """
        unit = [value / self.coefficients[0] for value in self.coefficients]
        secant = unit[1:]
        work = [2 * value / (j + 2) for j, value in enumerate(secant, 1)]
        tangent = [value * j for j, value in enumerate(secant, 2)]
        rows = [secant, work, tangent]
        for first in (secant, tangent):
            second = first[1:]
            rows += second, [value * j for j, value in enumerate(second)][1:]
        order = max(len(secant), 1)
        return np.stack([_floats([*row, *[Fraction(0)] * (order - len(row))]) for row in rows])


def _evaluate(law: FloatArray, strain: ArrayLike, order: int) -> FloatArray:
    """Evaluate ``law`` at ``strain``, with a Taylor series up to ``order`` above strain 1.

    The result is 0 for negative strains. It has the shape of ``strain``, or is a NumPy scalar if
    ``strain`` is a number.
    """
    x = np.asarray(strain, dtype=np.float64)
    value = np.polynomial.polynomial.polyval(np.clip(x, 0.0, 1.0), law)
    if (x > 1.0).any():
        beyond = np.maximum(x - 1.0, 0.0)
        last = np.polynomial.Polynomial(law)
        for n in range(1, order + 1):
            value = value + last.deriv(n)(1.0) / math.factorial(n) * beyond**n
    result: FloatArray = np.where(x <= 0.0, 0.0, value)[()]
    return result


def _integral(polynomial: Sequence[Fraction]) -> list[Fraction]:
    return [Fraction(0), *(value / (j + 1) for j, value in enumerate(polynomial))]


def _floats(polynomial: Sequence[Fraction]) -> FloatArray:
    return np.array([float(value) for value in polynomial])
