"""Compute large deformations of a neo-Hookean hemisphere under a rigid plane (finite elements).

The strain energy is W = μ/2 (J^(−2/3) tr FᵀF − 3) + κ/2 (J − 1)² with μ = E/(2 + 2ν) and κ = E/(3 −
6ν). E and ν are the small-strain values. Elements have 27 nodes. In the volumetric part, J − 1 is
projected onto linear functions in each element (mean dilatation to first order). This projection
avoids locking as ν approaches ½. Revolving a meridian mesh creates the mesh of the tip. For a
tilted plane, the mesh covers half a turn and ends at the symmetry plane y = 0. For an upright
plane, the mesh is one thin wedge, and all nodes at the same r and z have the same motion.

Contact is modelled at the nodes. An active node lies in the plane and transmits a normal force.
Unless the face is sticking, an active node moves freely along the plane. Each Newton step also
updates the set of active nodes. The linear solver is pypardiso.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pypardiso import PyPardisoSolver
from scipy import sparse
from scipy.interpolate import LinearNDInterpolator
from scipy.sparse.linalg import spsolve

from research.solid_tip.green import (
    MIDDLES,
    FloatArray,
    IntArray,
    Meridian,
    base_mass,
    quadratic,
    shape_functions,
)

WEDGE = 0.1  # angle of the wedge [rad]
# Stiffness of the spring that constrains the mean position of an unbonded base, in units of E.
STIFF = 1e3
HARMONICS = 9
AZIMUTHS = 48  # number of azimuths for evaluating the base pressure
SLICES = 8
ROOTS = np.linspace(0.2, np.sqrt(0.4), 8)  # √(d/a) of each press
REACHED = 0.5  # minimum undeformed height of nodes that the plane may touch [a]
CHUNK = 64  # number of elements that are processed at once


class Strained(NamedTuple):
    """Result of one press for E = a = 1, with nonlinear or linear elements."""

    d: float
    push: float  # normal force N
    shear: float  # force on the tip along (cos θ, 0, −sin θ)
    energy: float
    base: FloatArray  # harmonics of the base pressure as a function of the radius, shape (H, R)


class State(NamedTuple):
    """Current state of a press."""

    depth: float
    motion: FloatArray  # displacement of each degree of freedom
    touching: NDArray[np.bool_]  # True for each face node in contact
    held: FloatArray  # in-plane positions of the sticking nodes


class Body:
    """Mesh of a tip at one ν for a plane at ``theta`` [rad]; axisymmetric if ``theta`` is None."""

    def __init__(
        self,
        mesh: Meridian,
        poisson: float,
        bonded: bool,
        theta: float | None,
        slices: int = 1,
        linear: bool = False,
        sticking: bool = False,
    ) -> None:
        self.theta, self.sticking = theta or 0.0, sticking
        self.shear, self.bulk = 0.5 / (1 + poisson), 1 / (3 - 6 * poisson)
        whole = theta is not None
        phis = np.linspace(0, np.pi if whole else WEDGE, 2 * slices + 1)
        self.times = 2.0 if whole else 2 * np.pi / WEDGE
        sine, cosine = np.sin(self.theta), np.cos(self.theta)
        self.axes = np.array([[sine, 0.0, cosine], [cosine, 0.0, -sine], [0.0, 1.0, 0.0]])
        self._revolve(mesh, phis)
        gradient = self._geometry()
        turns = self._free_nodes(bonded) if whole else self._axisymmetric(mesh, bonded)
        # This matrix converts an element's degrees of freedom to displacement gradients at the
        # quadrature points.
        size = self.places.shape[1]
        self.strain = np.zeros((len(self.elements), 243, size))
        for k in range(3):
            turn = turns.reshape(-1, 27, 3, size)[:, :, k]
            for x in range(3):
                self.strain[:, 3 * k + x :: 9] = gradient[..., x] @ turn
        self._sparsity()
        self.at_rest: FloatArray | None = None
        self.moves: FloatArray | None = None
        if linear:
            still = np.zeros(self.count)
            _, _, rest = self.forces(still, self.pressures(still, still))
            assert rest is not None
            self.at_rest = rest
            parts = (self.normal[:, None], self.along) if sticking else (self.normal,)
            self.pushed = np.setdiff1d(np.concatenate([each.ravel() for each in parts]), self.fixed)
            loads = np.zeros((self.count, self.pushed.size))
            loads[self.pushed, np.arange(self.pushed.size)] = 1.0
            known = np.full(self.count, np.nan)
            known[self.fixed] = 0.0
            loads[self.fixed] = 0.0
            self.moves = self.solve(rest, loads, known)

    def _revolve(self, mesh: Meridian, phis: FloatArray) -> None:
        """Revolve ``mesh`` to the angles ``phis``; nodes on the axis are shared by all angles."""
        count = len(mesh.nodes)
        on_axis = mesh.nodes[:, 0] < 1e-12
        number = np.zeros((count, phis.size), dtype=np.int64)
        number[on_axis] = np.arange(on_axis.sum())[:, None]
        rest = np.arange((~on_axis).sum() * phis.size) + on_axis.sum()
        number[~on_axis] = rest.reshape(-1, phis.size)
        r, z = mesh.nodes.T
        self.nodes = np.zeros((on_axis.sum() + rest.size, 3))
        self.nodes[number] = np.stack(
            [r[:, None] * np.cos(phis), r[:, None] * np.sin(phis), z[:, None] + 0 * phis], axis=-1
        )
        self.meridian, self.slice = np.zeros((2, len(self.nodes)), dtype=np.int64)
        self.meridian[number] = np.arange(count)[:, None]
        self.slice[number] = np.arange(phis.size)
        self.elements: IntArray = np.concatenate(
            [
                number[mesh.elements][:, :, 2 * k : 2 * k + 3].reshape(-1, 27)
                for k in range(phis.size // 2)
            ]
        )
        faces = [mesh.base[2 * i : 2 * i + 3] for i in range(mesh.layers)]
        self.base: IntArray = np.concatenate(
            [number[faces][:, :, 2 * k : 2 * k + 3].reshape(-1, 9) for k in range(phis.size // 2)]
        )
        self.below = np.unique(self.base)
        face = np.setdiff1d(np.unique(number[mesh.number[-1]]), self.below)
        self.face = face[self.nodes[face] @ self.axes[0] > REACHED]
        self.lines = number[mesh.base].T  # base nodes from the centre to the rim

    def _geometry(self) -> FloatArray:
        """Set weights and linear functions; return the shape-function gradients (e, q, 27, 3)."""
        shape, local, weights = shape_functions(3)
        corners = self.nodes[self.elements]
        jacobian = np.einsum("qnk,enx->eqxk", local, corners)
        gradient = np.einsum("qnk,eqkx->eqnx", local, np.linalg.inv(jacobian))
        self.weight = np.abs(np.linalg.det(jacobian)) * weights
        place = np.einsum("qn,enx->eqx", shape, corners) - corners.mean(axis=1)[:, None]
        self.linears = np.concatenate([np.ones((*place.shape[:2], 1)), 10 * place], axis=2)
        weighted = (self.linears * self.weight[..., None]).transpose(0, 2, 1)
        self.squares = weighted @ self.linears
        self.project = np.linalg.solve(self.squares, weighted)  # (e, 4, q)
        return np.asarray(gradient)

    def _free_nodes(self, bonded: bool) -> FloatArray:
        """Define three dofs per node: along the plane's axes on the face, otherwise x, y, z."""
        frames = np.tile(np.eye(3), (len(self.nodes), 1, 1))
        frames[self.face] = self.axes.T
        turns = np.zeros((len(self.elements), 27, 3, 27, 3))
        for k in range(27):
            turns[:, k, :, k] = frames[self.elements[:, k]]
        self.places = (3 * self.elements[..., None] + np.arange(3)).reshape(-1, 81)
        self.frames = frames
        self.count = 3 * len(self.nodes)
        plane = np.flatnonzero(np.abs(self.nodes[:, 1]) < 1e-12)
        across = np.where(np.isin(plane, self.face), 2, 1)
        base = 3 * self.below[:, None] + (np.arange(3) if bonded else np.array([2]))
        self.fixed = np.unique(np.concatenate([3 * plane + across, base.ravel()]))
        self.normal = 3 * self.face
        self.along = np.stack([3 * self.face + 1, 3 * self.face + 2], axis=1)
        self.reach = self.nodes[self.face] @ self.axes[0]
        self.hold = np.zeros(self.count)
        if not bonded:
            self.hold[3 * self.below] = np.bincount(
                self.base.ravel(), self._base_mass(self.nodes).sum(axis=2).ravel(), len(self.nodes)
            )[self.below]
            self.hold /= self.hold.sum()
        return turns

    def _axisymmetric(self, mesh: Meridian, bonded: bool) -> FloatArray:
        """Define two dofs per meridian node, along z and r."""
        self.frames = np.zeros((len(self.nodes), 3, 2))
        phi = np.arctan2(self.nodes[:, 1], self.nodes[:, 0])
        self.frames[:, 2, 0] = 1.0
        self.frames[:, 0, 1], self.frames[:, 1, 1] = np.cos(phi), np.sin(phi)
        turns = np.zeros((len(self.elements), 9, 3, 3, 9, 2))
        for k in range(27):
            turns[:, k // 3, k % 3, :, k // 3] = self.frames[self.elements[:, k]]
        self.places = (2 * mesh.elements[..., None] + np.arange(2)).reshape(-1, 18)
        self.count = 2 * len(mesh.nodes)
        base = 2 * mesh.base[:, None] + (np.arange(2) if bonded else np.array([0]))
        self.fixed = np.unique(np.concatenate([2 * mesh.axis + 1, base.ravel()]))
        face = np.unique(self.meridian[self.face])
        self.normal, self.along = 2 * face, 2 * face[:, None] + 1
        self.reach = mesh.nodes[face, 1]
        self.hold = np.zeros(self.count)
        return turns

    def _sparsity(self) -> None:
        """Set the sparsity pattern of the tangent's upper triangle, and the entries' positions."""
        size = self.places.shape[1]
        row, column = np.repeat(self.places, size, 1).ravel(), np.tile(self.places, size).ravel()
        self.upper = np.flatnonzero(row <= column)
        held = np.flatnonzero(self.hold)
        more = np.array([(i, j) for i in held for j in held if i <= j], int).reshape(-1, 2)
        keys, where = np.unique(
            np.concatenate(
                [row[self.upper] * self.count + column[self.upper], more @ (self.count, 1)]
            ),
            return_inverse=True,
        )
        self.into, self.held_into = where[: self.upper.size], where[self.upper.size :]
        self.held_with = STIFF * self.hold[more[:, 0]] * self.hold[more[:, 1]]
        self.rows, self.columns = keys // self.count, keys % self.count
        self.starts = np.searchsorted(self.rows, np.arange(self.count + 1))
        self.solver = PyPardisoSolver(mtype=-2)
        self.analysed = False

    def _strain(self, part: slice, motion: FloatArray) -> FloatArray:
        """Return the displacement gradient (e, q, 3, 3) at the points of the elements ``part``."""
        moved = self.strain[part] @ motion[self.places[part]][..., None]
        return np.asarray(moved.reshape(-1, 27, 3, 3))

    def pressures(self, motion: FloatArray, change: FloatArray) -> FloatArray:
        """Return the pressure coefficients (e, 4), updated to first order for ``change``."""
        moved = self._strain(slice(None), motion)
        more = self._strain(slice(None), change)
        f = moved + np.eye(3)
        j = np.linalg.det(f)
        volume = j - 1 + j * np.einsum("eqij,eqji->eq", np.linalg.inv(f), more)
        return np.asarray(self.bulk * (self.project @ volume[..., None])[..., 0])

    def least_volume(self, motion: FloatArray) -> float:
        """Return the minimum J over all points."""
        return float(np.linalg.det(self._strain(slice(None), motion) + np.eye(3)).min())

    def forces(
        self, motion: FloatArray, pressures: FloatArray | None = None
    ) -> tuple[float, FloatArray, FloatArray | None]:
        """Return energy, dof forces and, given ``pressures``, the tangent's upper triangle.

        ``pressures`` contains the coefficients (e, 4) of the linear functions of each element. Each
        Newton step updates the coefficients, as in a mixed method. Recomputed pressures would
        contain κ times the second-order volume change and would distort the next tangent.
        """
        if self.at_rest is not None:
            out = self.times_tangent(self.at_rest, motion)
            return float(motion @ out) / 2, out, self.at_rest
        mean = float(self.hold @ motion)
        energy, out = STIFF * mean**2 / 2, STIFF * mean * self.hold
        matrices = []
        for low in range(0, len(self.elements), CHUNK):
            part = slice(low, low + CHUNK)
            given = None if pressures is None else pressures[part]
            stress, density, four, swell = self._material(part, self._strain(part, motion), given)
            energy += float(np.sum(self.weight[part] * density))
            weighted = (stress * self.weight[part][..., None]).reshape(-1, 1, 243)
            np.add.at(out, self.places[part], (weighted @ self.strain[part])[:, 0])
            if four is None:
                continue
            strain = self.strain[part]
            points = strain.reshape(len(strain), 27, 9, -1)
            right = (four * self.weight[part][..., None, None]) @ points
            matrix = strain.transpose(0, 2, 1) @ right.reshape(strain.shape)
            swelling = (swell[..., None, :] @ points)[:, :, 0]
            moments = self.project[part] @ swelling
            matrix += self.bulk * moments.transpose(0, 2, 1) @ (self.squares[part] @ moments)
            matrices.append(matrix.ravel())
        if pressures is None:
            return energy, out, None
        upper = np.concatenate(matrices)[self.upper]
        numbers = np.zeros(self.rows.size)
        numbers += np.bincount(self.into, upper, numbers.size)
        np.add.at(numbers, self.held_into, self.held_with)
        return energy, out, numbers

    def _material(
        self, part: slice, moved: FloatArray, given: FloatArray | None
    ) -> tuple[FloatArray, FloatArray, FloatArray | None, FloatArray]:
        """Return first Piola-Kirchhoff stress, W, ∂²W/∂F² without the projected part, and ∂J/∂F."""
        count, f = len(moved), moved + np.eye(3)
        j, g = np.linalg.det(f), np.linalg.inv(f).transpose(0, 1, 3, 2)
        means = self.project[part] @ (j - 1)[..., None]
        pressure = self.bulk * (self.linears[part] @ means)[..., 0]
        scale, first = self.shear * j ** (-2 / 3), np.sum(f * f, axis=(2, 3))
        f, g = f.reshape(count, 27, 9), g.reshape(count, 27, 9)
        stress = scale[..., None] * f + (pressure * j - scale * first / 3)[..., None] * g
        density = (scale * first - 3 * self.shear + pressure**2 / self.bulk) / 2
        swell = j[..., None] * g
        if given is None:
            return stress, density, None, swell
        bent = j * (self.linears[part] @ given[..., None])[..., 0]
        four = scale[..., None, None] * np.eye(9)
        both = (2 / 3 * scale)[..., None, None] * (g[..., :, None] * f[..., None, :])
        four -= both + both.transpose(0, 1, 3, 2)
        one = g[..., :, None] * g[..., None, :]
        four += (2 / 9 * scale * first + bent)[..., None, None] * one
        # For F^−T dFᵀ F^−T, swap the second indices.
        turned = one.reshape(count, 27, 3, 3, 3, 3).transpose(0, 1, 2, 5, 4, 3)
        four += (scale * first / 3 - bent)[..., None, None] * turned.reshape(count, 27, 9, 9)
        return stress, density, four, swell

    def solve(self, numbers: FloatArray, right: FloatArray, known: FloatArray) -> FloatArray:
        """Solve for the dofs under forces ``right``; non-NaN values in ``known`` are prescribed."""
        if self.moves is not None:
            return self._solve_at_rest(right, known)
        given = ~np.isnan(known)
        if right.ndim == 1:
            start = np.where(given, known, 0.0)
            right = np.where(given, known, right - self.times_tangent(numbers, start))[:, None]
        numbers = np.where(given[self.rows] | given[self.columns], 0.0, numbers)
        numbers[(self.rows == self.columns) & given[self.rows]] = 1.0
        matrix = sparse.csr_matrix((numbers, self.columns, self.starts), (self.count, self.count))
        for phase in (11, 22, 33) if not self.analysed else (22, 33):
            self.solver.set_phase(phase)
            found = self.solver._call_pardiso(matrix, np.asfortranarray(right))
        self.analysed = True
        return np.asarray(found).squeeze()

    def _solve_at_rest(self, right: FloatArray, known: FloatArray) -> FloatArray:
        """Solve for linear elements, using the response to face forces; otherwise like `solve`."""
        assert self.moves is not None
        # Initially, all forces except those on the face are in equilibrium.
        given = ~np.isnan(known[self.pushed])
        load = right[self.pushed]
        if given.any():
            moved = self.moves[self.pushed] @ np.where(given, 0.0, load)
            wanted = known[self.pushed][given] - moved[given]
            compliance = self.moves[np.ix_(self.pushed[given], given)]
            load[given] = np.linalg.solve(compliance, wanted)
        return np.asarray(self.moves @ load)

    def times_tangent(self, numbers: FloatArray, vector: FloatArray) -> FloatArray:
        """Multiply the tangent, given by its upper triangle, by a vector."""
        matrix = sparse.csr_matrix((numbers, self.columns, self.starts), (self.count, self.count))
        diagonal = numbers[self.rows == self.columns]
        return np.asarray(matrix @ vector + matrix.T @ vector - diagonal * vector)

    def press(self, depths: Iterable[float]) -> Iterator[Strained]:
        """Press to each of the increasing ``depths``; stop if there is no solution."""
        state = State(
            0.0,
            np.zeros(self.count),
            np.zeros(self.normal.size, dtype=np.bool_),
            np.zeros(self.along.shape),
        )
        for d in depths:
            try:
                state = self._go(state, d)
            except RuntimeError:
                return
            motion, touching = state.motion, state.touching
            energy, forces, _ = self.forces(motion)
            yield Strained(
                d,
                -self.times * float(forces[self.normal[touching]].sum()),
                -self.times * float(forces[self.along[touching, 0]].sum()),
                self.times * energy,
                self.base_pressure(motion, forces),
            )

    def _go(self, state: State, d: float) -> State:
        """Advance to depth ``d`` in as many steps as necessary, and return the final state."""
        try:
            return self._step(state, d)
        except RuntimeError:
            if d - state.depth < 0.02:
                raise
            return self._go(self._go(state, (state.depth + d) / 2), d)

    def _step(self, state: State, d: float) -> State:
        depth, before, touching, held = state
        held = held.copy()
        target = (1 - d) - self.reach
        room = before[self.normal] - ((1 - depth) - self.reach)  # gap at `depth`, at most 0
        motion, pressures = before.copy(), self.pressures(before, 0 * before)
        touching = touching | (target < 0.3 * target.min()) if not touching.any() else touching
        size = 1.0
        for attempt in range(30):
            _, forces, numbers = self.forces(motion, pressures)
            assert numbers is not None
            known = np.full(self.count, np.nan)
            known[self.fixed] = 0.0
            wanted = self.normal[touching]
            known[wanted] = target[touching] - motion[wanted]
            if self.sticking:
                known[self.along[touching]] = held[touching] - motion[self.along[touching]]
            change = self.solve(numbers, -forces, known)
            size = 1.0
            if self.at_rest is None:
                while self.least_volume(motion + size * change) <= 0.02 and size > 1e-3:
                    size /= 2
                pressures += size * (self.pressures(motion, change) - pressures)
            motion = motion + size * change
            reaction = (forces + self.times_tangent(numbers, change))[self.normal]
            gap = motion[self.normal] - target
            now = np.where(touching, reaction < 0, gap > 1e-10)
            if attempt > 15:  # Nodes that still alternate after 15 attempts stay active.
                now |= touching
            still = np.abs(change).max() < 1e-6 and size == 1.0
            if still and (now == touching).all():
                return State(d, motion, touching, held)
            new = now & ~touching
            if self.sticking and new.any():
                was = before[self.along[new]]
                share = -room[new] / np.maximum(gap[new] - room[new], 1e-12)
                held[new] = was + np.clip(share, 0, 1)[:, None] * (motion[self.along[new]] - was)
            touching = now
        raise RuntimeError(f"no contact found at d = {d} a, θ = {self.theta} rad")

    def base_pressure(self, motion: FloatArray, forces: FloatArray) -> FloatArray:
        """Return the cosine harmonics of the deformed base's pressure at the radii `MIDDLES`."""
        place = self.nodes.copy()
        if self.at_rest is not None:  # The elements are linear.
            motion = 0 * motion
        if self.frames.shape[2] == 3:
            place += np.einsum("nij,nj->ni", self.frames, motion.reshape(-1, 3))
            each = self._base_mass(place)
            row, column = np.repeat(self.base, 9, 1), np.tile(self.base, 9)
            size = (len(place), len(place))
            mass = sparse.csr_matrix((each.ravel(), (row.ravel(), column.ravel())), size)
            value = np.zeros(len(place))
            inner = mass[self.below][:, self.below].tocsc()
            value[self.below] = spsolve(inner, forces[3 * self.below + 2])
            weights = self._between()
            x, y, value = (weights @ each[self.lines] for each in (*place.T[:2], value))
        else:
            base = 2 * self.meridian[self.lines[0]]
            x = (self.nodes[self.lines[0], 0] + motion[base + 1])[None]
            value = spsolve(base_mass(x[0]), forces[base] / WEDGE)[None]
            y = 0 * x
        fine = 8 * (x.shape[1] - 1) + 1
        local = np.linspace(0, x.shape[1] - 1, fine)
        first = 2 * np.minimum(local // 2, x.shape[1] // 2 - 1).astype(int)
        shape = quadratic(local - first - 1)[0]
        x, y, value = (
            np.einsum("qa,lqa->lq", shape, each[:, first[:, None] + np.arange(3)])
            for each in (x, y, value)
        )
        if len(x) == 1:
            upright = np.interp(MIDDLES, x[0], value[0], right=0.0)
            return np.pad(upright[None], ((0, HARMONICS - 1), (0, 0)))
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        found = LinearNDInterpolator(points, value.ravel(), fill_value=0.0)
        phi = np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
        at = found(np.outer(np.cos(phi), MIDDLES), np.outer(np.sin(phi), MIDDLES))
        m = np.arange(HARMONICS)[:, None]
        return np.asarray(np.where(m == 0, 1.0, 2.0) / AZIMUTHS * (np.cos(m * phi) @ at))

    def _between(self) -> FloatArray:
        """Return the matrix that interpolates from node lines to four times as many azimuths."""
        count = len(self.lines)
        local = np.linspace(0, count - 1, 4 * (count - 1) + 1)
        first = 2 * np.minimum(local // 2, count // 2 - 1).astype(int)
        out = np.zeros((local.size, count))
        np.put_along_axis(
            out, first[:, None] + np.arange(3), quadratic(local - first - 1)[0], axis=1
        )
        return out

    def _base_mass(self, nodes: FloatArray) -> FloatArray:
        """Return the mass matrices ∫ N N dA (e, 9, 9) of the base facets."""
        shape, local, weights = shape_functions(2)
        jacobian = np.einsum("qnk,enx->eqxk", local, nodes[self.base][..., :2])
        area = np.abs(np.linalg.det(jacobian)) * weights
        return np.asarray(np.einsum("eq,qa,qb->eab", area, shape, shape))


def strained(
    block: str, poisson: float, theta: float | None, mesh: Meridian, file: Path
) -> dict[str, FloatArray]:
    """Return arrays (2, n, …) of linear and nonlinear presses, cached in ``file``."""
    if not file.exists():
        base, sticking = block.removesuffix("-sticking"), block.endswith("-sticking")
        found = []
        for linear in (True, False):
            slices = 1 if theta is None else SLICES
            body = Body(mesh, poisson, base == "bonded", theta, slices, linear, sticking)
            found.append(list(body.press(ROOTS**2)))
        count = len(found[1])
        arrays = {
            name: np.array([[getattr(each, name) for each in kind[:count]] for kind in found])
            for name in Strained._fields
        }
        np.savez(file, **arrays)  # type: ignore[arg-type]
    with np.load(file) as data:
        return dict(data)
