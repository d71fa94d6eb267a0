"""Finite elements of a linear elastic hemisphere, one Fourier harmonic around its axis at a time.

A displacement of harmonic m is (U cos mφ, V sin mφ, W cos mφ) with U, V, W on the meridian plane
(r, z): a quarter disc. Elements are quadrilaterals with nine nodes; the volume strain is projected
on linear functions inside each (the pair Q2/P1, discontinuous pressure, eliminated), which does not
lock towards ν = ½.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

GAUSS = np.polynomial.legendre.leggauss(3)


def quadratic(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The three quadratic shape functions on [−1, 1] at ``x``, and their derivatives: (n, 3)."""
    values = np.stack([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2], axis=-1)
    return values, np.stack([x - 0.5, -2 * x, x + 0.5], axis=-1)


def graded(last: float, widest: float, growth: float, length: float) -> FloatArray:
    """Ends of elements on [0, length], ``last`` wide at its far end and ``widest`` elsewhere."""
    widths = [last]
    while sum(widths) < length:
        widths.append(min(widths[-1] * growth, widest))
    ends = np.concatenate([[0.0], np.cumsum(widths[::-1])])
    return np.asarray(ends * (length / ends[-1]))


class Meridian:
    """Mesh of the quarter disc: ``rings`` elements along the arc where contact may be."""

    def __init__(self, rings: int) -> None:
        step = np.pi / 2 / rings
        # Towards the rim both directions get finer: a bonded base has singular stress there.
        radii = graded(step / 8, min(2.5 * step, 0.08), 1.6, 1.0)
        angles = graded(step / 8, step, 2.0, np.pi / 2)
        self.layers, self.arcs = len(radii) - 1, len(angles) - 1
        radius, angle = (
            np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2])) for ends in (radii, angles)
        )
        # Node (i, j) is at radius i and polar angle j; all j of i = 0 are the origin, node 0.
        number = np.arange(radius.size * angle.size).reshape(radius.size, angle.size)
        number = np.maximum(number - angle.size + 1, 0)
        self.number = number
        self.nodes = np.zeros((number[-1, -1] + 1, 2))
        self.nodes[number, 0] = radius[:, None] * np.sin(angle)
        self.nodes[number, 1] = radius[:, None] * np.cos(angle)
        self.nodes[number[:, 0], 0] = 0.0
        self.nodes[number[:, -1], 1] = 0.0
        self.elements: IntArray = np.array(
            [
                number[2 * i : 2 * i + 3, 2 * j : 2 * j + 3].ravel()
                for i in range(self.layers)
                for j in range(self.arcs)
            ]
        )
        self.axis: IntArray = np.unique(number[:, 0])
        self.base: IntArray = number[:, -1]  # from the origin to the rim

    @cached_property
    def _geometry(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Shape values (9, 9), their gradients (e, q, 9, 2), r (e, q) and weights r dA (e, q)."""
        points, weights = GAUSS
        value, slope = quadratic(points)
        shape = np.einsum("pa,qb->pqab", value, value).reshape(9, 9)
        local = np.stack(
            [np.einsum("pa,qb->pqab", slope, value), np.einsum("pa,qb->pqab", value, slope)], -1
        ).reshape(9, 9, 2)
        corners = self.nodes[self.elements]
        jacobian = np.einsum("qnk,enx->eqxk", local, corners)
        gradient = np.einsum("qnk,eqkx->eqnx", local, np.linalg.inv(jacobian))
        r = np.einsum("qn,en->eq", shape, corners[:, :, 0])
        area = np.abs(np.linalg.det(jacobian)) * np.outer(weights, weights).ravel()
        return shape, gradient, r, area * r

    def stiffness(self, m: int, poisson: float) -> sparse.csc_matrix:
        """Stiffness of harmonic ``m`` for E = 1; degrees of freedom are 3 node + (0 U, 1 V, 2 W).

        The energy is integrated over r and z alone: π (2π for m = 0) is left out, as in the loads.
        """
        shear, lame = 0.5 / (1 + poisson), poisson / ((1 + poisson) * (1 - 2 * poisson))
        shape, gradient, r, weight = self._geometry
        count = len(self.elements)
        over_r = shape / r[:, :, None]
        d_r, d_z = gradient[..., 0], gradient[..., 1]
        strain = np.zeros((count, 9, 6, 9, 3))  # rr, φφ, zz, and √½ of the engineering shears
        strain[:, :, 0, :, 0] = d_r
        strain[:, :, 1, :, 0], strain[:, :, 1, :, 1] = over_r, m * over_r
        strain[:, :, 2, :, 2] = d_z
        strain[:, :, 3, :, 0], strain[:, :, 3, :, 2] = d_z, d_r
        strain[:, :, 4, :, 0], strain[:, :, 4, :, 1] = -m * over_r, d_r - over_r
        strain[:, :, 5, :, 1], strain[:, :, 5, :, 2] = d_z, -m * over_r
        strain[:, :, 3:] *= np.sqrt(0.5)
        volume = strain[:, :, :3].sum(axis=2).reshape(count, 9, 27)
        strain *= np.sqrt(2 * shear * weight)[:, :, None, None, None]
        rows = strain.reshape(count, 54, 27)
        matrices = rows.transpose(0, 2, 1) @ rows
        corners = self.nodes[self.elements]
        place = np.einsum("qn,enx->eqx", shape, corners) - corners.mean(axis=1)[:, None]
        linear = np.concatenate([np.ones((count, 9, 1)), place * 20.0], axis=2)
        weighted = (linear * weight[:, :, None]).transpose(0, 2, 1)
        moments = weighted @ volume
        matrices += lame * (
            moments.transpose(0, 2, 1) @ np.linalg.solve(weighted @ linear, moments)
        )
        places = (3 * self.elements[:, :, None] + np.arange(3)).reshape(count, 27)
        row, column = np.repeat(places, 27, axis=1), np.tile(places, (1, 27))
        size = 3 * len(self.nodes)
        return sparse.csc_matrix((matrices.ravel(), (row.ravel(), column.ravel())), (size, size))
