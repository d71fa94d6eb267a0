"""Compute the response of a hemisphere's rings and base to ring loads (Green's functions).

Each ring is one element along the meridian arc. The load is a traction that is constant along the
ring's arc and varies as harmonic m around the axis. The response consists of the mean displacement
of every ring and the pressure on the base.

The functions are computed with finite elements of the linear elastic hemisphere, one Fourier
harmonic at a time. A displacement of harmonic m is (U cos mφ, V sin mφ, W cos mφ). U, V and W are
functions on a quarter disc in the meridian plane (r, z). The elements are quadrilaterals with nine
nodes. The volumetric strain is projected onto linear functions in each element (the Q2/P1 pair with
the discontinuous pressure eliminated). This projection avoids locking as ν approaches ½.
"""

from __future__ import annotations

from functools import cached_property, reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Ring edges on the base. The rings are narrow at the rim, where the stress of a bonded base is
# singular. The rings are mirrored beyond the rim, because a base that is not bonded spreads.
RING_EDGES = np.sin(np.linspace(0, np.pi / 2, 97))
RING_EDGES = np.concatenate([RING_EDGES, 2 - RING_EDGES[RING_EDGES > 0.8][-2::-1]])
MIDDLES = (RING_EDGES[1:] + RING_EDGES[:-1]) / 2

GAUSS: tuple[FloatArray, FloatArray] = np.polynomial.legendre.leggauss(3)


def quadratic(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the quadratic shape functions on [−1, 1] and their derivatives at ``x``, (n, 3)."""
    values = np.stack([x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2], axis=-1)
    return values, np.stack([x - 0.5, -2 * x, x + 0.5], axis=-1)


def shape_functions(dimensions: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the products of quadratic shape functions in several dimensions at the Gauss points.

    Returns
    -------
    Values [points, nodes], gradients [points, nodes, dimensions] and weights [points].
    """
    kron: Any = np.kron
    value, slope = quadratic(GAUSS[0])
    axes = range(dimensions)
    rows = [[slope if k == axis else value for k in axes] for axis in axes]
    gradients = np.stack([reduce(kron, row) for row in rows], axis=-1)
    return reduce(kron, [value] * dimensions), gradients, reduce(kron, [GAUSS[1]] * dimensions)


def graded(last: float, widest: float, growth: float, length: float) -> FloatArray:
    """Return graded element ends on [0, length]; widths decrease from ``widest`` to ``last``."""
    widths = [last]
    while sum(widths) < length:
        widths.append(min(widths[-1] * growth, widest))
    ends = np.concatenate([[0.0], np.cumsum(widths[::-1])])
    return np.asarray(ends * (length / ends[-1]))


class Meridian:
    """Mesh of the quarter disc with ``rings`` elements along the arc, which may be in contact."""

    def __init__(self, rings: int, finer: float = 8.0, widest: float = 0.08) -> None:
        step = np.pi / 2 / rings
        # Refine in both directions towards the rim, where the stress of a bonded base is singular.
        radii = graded(step / finer, min(2.5 * step, widest), 1.6, 1.0)
        angles = graded(step / finer, step, 2.0, np.pi / 2)
        self.layers, self.arcs = len(radii) - 1, len(angles) - 1
        radius, angle = (
            np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2])) for ends in (radii, angles)
        )
        # Node (i, j) has the i-th radius and the j-th polar angle. All nodes with i = 0 are at the
        # origin and share the number 0.
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
        self.base: IntArray = number[:, -1]  # base nodes from the origin to the rim

    @cached_property
    def _geometry(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return shape values (9, 9), gradients (e, q, 9, 2), r (e, q) and weights r dA (e, q)."""
        shape, local, weights = shape_functions(2)
        corners = self.nodes[self.elements]
        jacobian = np.einsum("qnk,enx->eqxk", local, corners)
        gradient = np.einsum("qnk,eqkx->eqnx", local, np.linalg.inv(jacobian))
        r = np.einsum("qn,en->eq", shape, corners[:, :, 0])
        area = np.abs(np.linalg.det(jacobian)) * weights
        return shape, gradient, r, area * r

    def stiffness(self, m: int, poisson: float) -> sparse.csc_matrix:
        """Return the stiffness matrix of harmonic ``m`` for E = 1.

        The degrees of freedom U, V and W of node k have the indices 3k, 3k + 1 and 3k + 2. The
        energy is integrated only over r and z. The matrix and the loads omit the factor π (2π for m
        = 0).
        """
        shear, lame = 0.5 / (1 + poisson), poisson / ((1 + poisson) * (1 - 2 * poisson))
        shape, gradient, r, weight = self._geometry
        count = len(self.elements)
        over_r = shape / r[:, :, None]
        d_r, d_z = gradient[..., 0], gradient[..., 1]
        strain = np.zeros((count, 9, 6, 9, 3))  # rr, φφ, zz, and engineering shear strains times √½
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


STIFF = 1e4  # stiffness of the springs that suppress rigid motions of harmonic 1, in units of E
CONTACT_END = np.radians(85.0)  # maximum polar angle of the rings that may be in contact
CAP = 0.2  # polar angle of the cap on which the shear force acts [rad]


class Green(NamedTuple):
    """Green's functions of rings and base, with components (r, φ, z); ring 0 is at the pole."""

    place: FloatArray  # mean r and z of each ring [a], shape (R, 2)
    weight: FloatArray  # ∫ r ds of each ring [a²], shape (R,)
    cells: IntArray  # number of cells around each ring (even), shape (R,)
    rings: FloatArray  # weight × mean displacement for unit traction, shape (M + 1, 3, R, 3, R)
    base_radius: FloatArray  # radii of the base nodes [a], shape (B,)
    base: FloatArray  # base pressure at these nodes for unit traction, shape (H, B, 3, R)


def arc_loads(mesh: Meridian) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return each ring's position (R, 2), ∫ r ds (R,), nodal weights ∫ N r ds (R, 3) and angle."""
    points, gauss = GAUSS
    value, slope = quadratic(points)
    arc = mesh.number[-1]
    nodes = mesh.nodes[np.stack([arc[2 * j : 2 * j + 3] for j in range(mesh.arcs)])]
    where = np.einsum("qa,rax->rqx", value, nodes)
    length = np.linalg.norm(np.einsum("qa,rax->rqx", slope, nodes), axis=2) * gauss
    share = length * where[:, :, 0]
    weight = share.sum(axis=1)
    place = np.einsum("rq,rqx->rx", share, where) / weight[:, None]
    return place, weight, share @ value, np.arctan2(place[:, 0], place[:, 1])


def base_mass(radius: FloatArray) -> sparse.csc_matrix:
    """Return the mass matrix ∫ N N r dr of quadratic base elements with nodes at ``radius``."""
    points, gauss = GAUSS
    value, slope = quadratic(points)
    rows, columns, entries = [], [], []
    for j in range(0, radius.size - 2, 2):
        r, stretch = value @ radius[j : j + 3], slope @ radius[j : j + 3]
        matrix = np.einsum("q,qa,qb->ab", gauss * r * stretch, value, value)
        index = np.arange(j, j + 3)
        rows.append(np.repeat(index, 3))
        columns.append(np.tile(index, 3))
        entries.append(matrix.ravel())
    each = (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csc_matrix(each, (radius.size, radius.size))


def fixed(mesh: Meridian, m: int, bonded: bool) -> IntArray:
    """Return the fixed degrees of freedom: base, axis and, for axisymmetric loads, the twist."""
    base = 3 * mesh.base[:, None] + (np.arange(3) if bonded else np.array([2]))
    axis = 3 * mesh.axis[:, None] + {0: [0, 1], 1: [2]}.get(m, [0, 1, 2])
    twist = 3 * np.arange(len(mesh.nodes) if m == 0 else 0) + 1
    return np.unique(np.concatenate([base.ravel(), axis.ravel(), twist]))


def supports(mesh: Meridian, m: int, bonded: bool) -> sparse.csc_matrix | float:
    """Return the stiffness matrix of the springs that constrain harmonic 1.

    The springs enforce U + V = 0 on the axis and prevent a lying base from moving as a whole.
    """
    if m != 1:
        return 0.0
    size = 3 * len(mesh.nodes)
    rows = [
        sparse.csc_matrix(([1.0, 1.0], ([0, 0], [3 * k, 3 * k + 1])), (1, size)) for k in mesh.axis
    ]
    if not bonded:
        share = np.asarray(base_mass(mesh.nodes[mesh.base, 0]).sum(axis=0)).ravel()
        places = np.concatenate([3 * mesh.base, 3 * mesh.base + 1])
        rows.append(
            sparse.csc_matrix(
                (np.concatenate([share, -share]), (np.zeros(places.size, int), places)), (1, size)
            )
        )
    hold = sparse.vstack(rows)
    return (STIFF * hold.T @ hold).tocsc()


def green(rings: int, poisson: float, bonded: bool, base_harmonics: int = 12) -> Green:
    """Compute the Green's functions for ``rings`` elements along the arc, with square cells."""
    mesh = Meridian(rings)
    place, weight, nodal, angle = arc_loads(mesh)
    count = int(np.sum(angle < CONTACT_END))
    place, weight, nodal = place[:count], weight[:count], nodal[:count]
    cells = 2 * np.maximum(np.round(place[:, 0] * 2 * rings).astype(np.int64), 3)
    harmonics = int(cells.max()) // 2
    arc = mesh.number[-1]
    size = 3 * len(mesh.nodes)
    base_z = 3 * mesh.base + 2
    base_radius = mesh.nodes[mesh.base, 0]
    to_pressure = splu(base_mass(base_radius))
    out = np.zeros((harmonics + 1, 3, count, 3, count))
    base = np.zeros((base_harmonics + 1, mesh.base.size, 3, count))
    for m in range(harmonics + 1):
        active = np.flatnonzero(cells // 2 >= m)
        matrix = mesh.stiffness(m, poisson)
        free = np.setdiff1d(np.arange(size), fixed(mesh, m, bonded))
        held = (matrix + supports(mesh, m, bonded)).tocsc()[free][:, free]
        factors = splu(
            held, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        loads = np.zeros((size, 3 * active.size))  # columns sorted by component, then by ring
        for k, ring in enumerate(active):
            for c in range(3):
                loads[3 * arc[2 * ring : 2 * ring + 3] + c, c * active.size + k] = nodal[ring]
        moved = np.zeros_like(loads)
        moved[free] = factors.solve(loads[free])
        response = (loads.T @ moved).reshape(3, active.size, 3, active.size)
        out[m][:, active[:, None], :, active] = response.transpose(1, 3, 0, 2)
        if m <= base_harmonics:
            pressure = to_pressure.solve(matrix[base_z] @ moved)
            base[m][:, :, active] = pressure.reshape(-1, 3, active.size)
    return Green(place, weight, cells, out, base_radius, base)


def shear_response(rings: int, poisson: float, bonded: bool) -> tuple[FloatArray, FloatArray]:
    """Return the base radii, and harmonic 1 of the base pressure under a unit shear on the cap."""
    mesh = Meridian(rings)
    _, _, nodal, angle = arc_loads(mesh)
    load = np.zeros(3 * len(mesh.nodes))
    for k in np.flatnonzero(angle < CAP):
        nodes = mesh.number[-1, 2 * k : 2 * k + 3]
        share = nodal[k] * np.sqrt(1 - (angle[k] / CAP) ** 2)
        load[3 * nodes] += share
        load[3 * nodes + 1] -= share
    force = np.pi * (load[0::3].sum() - load[1::3].sum())
    matrix = mesh.stiffness(1, poisson)
    free = np.setdiff1d(np.arange(load.size), fixed(mesh, 1, bonded))
    moved = np.zeros_like(load)
    held = (matrix + supports(mesh, 1, bonded)).tocsc()[free][:, free]
    moved[free] = splu(held).solve(load[free] / force)
    radius = mesh.nodes[mesh.base, 0]
    return radius, splu(base_mass(radius)).solve(matrix[3 * mesh.base + 2] @ moved)
