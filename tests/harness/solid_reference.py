"""Reference frames of a solid tip, by finite elements that share nothing with the tool's.

Half of the hemisphere (y ≥ 0) in curved tetrahedra with Taylor-Hood elements; contact by its dual
problem: a pressure ≥ 0 on each triangle of the surface, minimised with bounds by L-BFGS-B. A face
that sticks is pressed in small steps, each triangle held where it was in the middle of the step
that brought it to touch. Lengths in tip radii, stresses in E. Needs scikit-fem, gmsh and pypardiso,
some 2 GB and an hour: ``python -m tests.harness.solid_reference tests/golden/solid_frames.npz``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gmsh
import numpy as np
import skfem
from pypardiso import PyPardisoSolver
from scipy import sparse
from scipy.optimize import minimize
from skfem.helpers import ddot, div, sym_grad

RADIUS, SIZE, CELLS = 20.0, 58.0, 44  # tip and sensor [mm]
POINTS = {  # ν, d [mm], θ [°]
    "bonded": (
        (0.45, 0.5, 0), (0.45, 2, 15), (0.45, 5, 25), (0.47, 1, 10), (0.47, 4, 20), (0.47, 7, 0),
        (0.49, 0.5, 25), (0.49, 3, 5), (0.49, 6, 15), (0.495, 1, 25), (0.495, 4, 0), (0.495, 7, 25),
    ),
    "lying": ((0.47, 2, 10), (0.49, 5, 20), (0.495, 1, 25)),
    "bonded-sticking": ((0.49, 2, 20), (0.49, 5, 20)),
    "lying-sticking": ((0.47, 4, 15),),
}  # fmt: skip
STEPS = 60


def dual_energy(
    load: np.ndarray, compliance: np.ndarray, need: np.ndarray
) -> tuple[float, np.ndarray]:
    """Of a contact's forces, and its slope."""
    moved = compliance @ load
    return load @ moved / 2 - load @ need, moved - need


def on_base(x: np.ndarray) -> np.ndarray:
    return np.abs(x[2]) < 1e-9


def on_cut(x: np.ndarray) -> np.ndarray:
    return np.abs(x[1]) < 1e-9


def quarter_ball(scale: float) -> skfem.MeshTet2:
    """Mesh, fine where contact may be and at the rim; its sphere is curved, not faceted."""

    def size(dim: int, tag: int, x: float, y: float, z: float, before: float) -> float:
        along, r = np.arctan2(x, z), np.sqrt(x * x + y * y + z * z)
        from_poles = np.hypot(np.hypot(max(0.0, -along, along - np.radians(25)), y), 1 - r)
        from_rim = np.hypot(np.hypot(x, y) - 1, z)
        contact, rim = 0.03 + 0.12 * max(0.0, from_poles - 0.2), 0.025 + 0.2 * from_rim
        return scale * min(contact, rim, 0.075 + 0.2 * z, 0.13)

    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    for option in ("ExtendFromBoundary", "FromPoints", "FromCurvature"):
        gmsh.option.setNumber(f"Mesh.MeshSize{option}", 0)
    occ = gmsh.model.occ
    occ.intersect([(3, occ.addSphere(0, 0, 0, 1, angle1=0))], [(3, occ.addBox(-2, 0, -2, 4, 2, 4))])
    occ.synchronize()
    gmsh.model.mesh.setSizeCallback(size)
    gmsh.model.mesh.generate(3)
    tags, points, _ = gmsh.model.mesh.getNodes()
    _, corners = gmsh.model.mesh.getElementsByType(4)
    gmsh.finalize()
    used, cells = np.unique(corners, return_inverse=True)
    place = np.zeros((int(tags.max()) + 1, 3))
    place[tags.astype(int)] = points.reshape(-1, 3)
    points = place[used.astype(int)].T.copy()
    points[np.abs(points) < 1e-10] = 0.0
    linear = skfem.MeshTet(points, cells.reshape(-1, 4).T.copy())
    facets = linear.facets[:, linear.boundary_facets()]
    middle = linear.p[:, facets].mean(axis=1)
    facets = facets[:, ~on_base(middle) & ~on_cut(middle)]
    pairs = np.sort(np.hstack([facets[[0, 1]], facets[[1, 2]], facets[[0, 2]]]), axis=0)
    edges = np.sort(linear.edges, axis=0)
    count = linear.nvertices
    curved = np.isin(edges[0] * count + edges[1], pairs[0] * count + pairs[1])
    halves = linear.p[:, linear.edges].mean(axis=1)
    halves[:, curved] /= np.linalg.norm(halves[:, curved], axis=0)
    mesh = skfem.MeshTet2.from_mesh(linear)
    nodes = mesh.doflocs.copy()
    nodes[:, skfem.Dofs(linear, skfem.ElementTetP2()).edge_dofs[0]] = halves
    return skfem.MeshTet2(nodes, mesh.t)


class SolidTip:
    """The elastic body on its base, factorised for one ν."""

    def __init__(self, mesh: skfem.MeshTet2, poisson: float, bonded: bool) -> None:
        shear, lame = 0.5 / (1 + poisson), poisson / ((1 + poisson) * (1 - 2 * poisson))
        moved = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=4)
        pressed = moved.with_element(skfem.ElementTetP1())
        strain = skfem.BilinearForm(lambda u, v, w: 2 * shear * ddot(sym_grad(u), sym_grad(v)))
        volume = skfem.BilinearForm(lambda u, q, w: -q * div(u)).assemble(moved, pressed)
        mass = skfem.BilinearForm(lambda p, q, w: p * q / lame).assemble(pressed)
        matrix = sparse.bmat([[strain.assemble(moved), volume.T], [volume, -mass]]).tocsr()
        self.mesh, self.moved, self.matrix = mesh, moved, matrix
        self.base = mesh.facets_satisfying(on_base, boundaries_only=True)
        cut = mesh.facets_satisfying(on_cut, boundaries_only=True)
        middle = mesh.p[:, mesh.facets[:, mesh.boundary_facets()]].mean(axis=1)
        sphere = mesh.boundary_facets()[~on_base(middle) & ~on_cut(middle)]
        self.surface = skfem.FacetBasis(mesh, moved.elem, facets=sphere, intorder=4)
        base = moved.get_dofs(self.base)
        held = [moved.get_dofs(cut).all("u^2"), base.all() if bonded else base.all("u^3")]
        self.free = np.setdiff1d(np.arange(matrix.shape[0]), np.concatenate(held))
        if not bonded:  # the base's mean place along x is held by a uniform shear
            shore = skfem.FacetBasis(mesh, moved.elem, facets=self.base, intorder=4)
            mean = skfem.LinearForm(lambda v, w: v[0]).assemble(shore)
            mean = sparse.csr_matrix(np.append(mean, np.zeros(matrix.shape[0] - mean.size)))
            matrix = (matrix + 1e3 * mean.T @ mean).tocsr()
        self.held = sparse.triu(matrix[self.free][:, self.free]).tocsr()
        self.solver = PyPardisoSolver(mtype=-2)
        self.solver.factorize(self.held)

    def along(self, axis: np.ndarray, near: np.ndarray) -> sparse.csr_matrix:
        """Motion of the chosen triangles along ``axis``: its integral over the root of the area."""
        surface = self.surface
        facets = np.arange(near.size)
        shape = (near.size, self.matrix.shape[0])
        rows = sparse.csr_matrix(shape)
        for k in range(surface.Nbfun):
            share = np.einsum("i,ifq->fq", axis, surface.basis[k][0].value) * surface.dx
            rows += sparse.csr_matrix((share.sum(1), (facets, surface.element_dofs[k])), shape)
        root = np.sqrt(surface.dx.sum(axis=1)[near])
        return (sparse.diags(1 / root) @ rows[near][:, self.free]).tocsr()

    def press(self, d: float, theta: float) -> tuple[float, float, np.ndarray]:
        """Push along the plane's normal, energy, and all degrees of freedom."""
        normal = np.array([np.sin(theta), 0.0, np.cos(theta)])
        surface = self.surface
        overlap = np.einsum("i,ifq->fq", normal, surface.global_coordinates()) - (1 - d)
        near = overlap.max(axis=1) > -0.02
        root = np.sqrt(surface.dx.sum(axis=1)[near])
        rows = self.along(normal, near)
        columns = rows.T.tocsr()
        need = (overlap * surface.dx).sum(axis=1)[near] / root

        def dual(load: np.ndarray) -> tuple[float, np.ndarray]:
            moved = rows @ self.solver.solve(self.held, columns @ load)
            return load @ moved / 2 - load @ need, moved - need

        start = np.maximum(need, 0)
        start *= (start @ need) / (start @ (dual(start)[1] + need))  # best along this line
        found = minimize(
            dual,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=[(0, None)] * start.size,
            options={"maxiter": 400, "maxcor": 30, "ftol": 1e-13, "gtol": 1e-7},
        )
        every = np.zeros(self.matrix.shape[0])
        every[self.free] = -self.solver.solve(self.held, columns @ found.x)
        return 2 * float(found.x @ root), -2 * float(found.fun), every

    def stick(self, d: float, theta: float) -> tuple[float, float, np.ndarray]:
        """As `press`, with a face that sticks."""
        sine, cosine = np.sin(theta), np.cos(theta)
        axes = np.array([[sine, 0.0, cosine], [cosine, 0.0, -sine], [0.0, 1.0, 0.0]])
        surface = self.surface
        height = np.einsum("i,ifq->fq", axes[0], surface.global_coordinates())
        near = height.max(axis=1) > 1 - d - 0.02
        root = np.sqrt(surface.dx.sum(axis=1)[near])
        count = root.size
        rows = sparse.vstack([self.along(axis, near) for axis in axes]).tocsr()
        compliance = np.empty((3 * count, 3 * count))
        for low in range(0, 3 * count, 60):
            loads = np.asarray(rows[low : low + 60].todense()).T
            compliance[:, low : low + 60] = rows @ self.solver.solve(self.held, loads)
        print("compliance of", count, "triangles", flush=True)
        stuck, held = np.zeros(count, dtype=bool), np.zeros(3 * count)
        moved, load = np.zeros(3 * count), np.zeros(3 * count)
        for depth in np.linspace(0, np.sqrt(d), STEPS + 1)[1:] ** 2:
            need = held.copy()
            need[:count] = ((height - (1 - depth)) * surface.dx).sum(axis=1)[near] / root
            free = np.concatenate([np.ones(count, dtype=bool), stuck, stuck])
            bounds = [(0, None)] * count + [(None, None)] * int(2 * stuck.sum())
            found = minimize(
                dual_energy,
                load[free],
                args=(compliance[np.ix_(free, free)], need[free]),
                jac=True,
                method="L-BFGS-B",
                bounds=bounds,
                options={
                    "maxiter": 3000,
                    "maxfun": 5000,
                    "maxcor": 50,
                    "ftol": 1e-14,
                    "gtol": 1e-8,
                },
            )
            load = np.zeros(3 * count)
            load[free] = found.x
            now = compliance @ load
            touching = load[:count] > 0
            new = np.concatenate([np.zeros(count, dtype=bool), *[touching & ~stuck] * 2])
            held[new] = (moved[new] + now[new]) / 2
            stuck, moved = touching, now
        energy = float(load @ moved) / 2
        every = np.zeros(self.matrix.shape[0])
        every[self.free] = -self.solver.solve(self.held, rows.T @ load)
        return 2 * float(load[:count] @ root), 2 * energy, every

    def frame(self, every: np.ndarray) -> tuple[float, np.ndarray]:
        """Force on the base, and its pressure averaged over the sensor's cells, rows along y."""
        reaction = self.matrix @ every
        parts = 24  # of a triangle's side: its pressure goes to the cells in parts² pieces
        k = np.array([(i, j) for i in range(parts) for j in range(parts - i)], float)
        up, down = k + 1 / 3, k[k.sum(axis=1) < parts - 1] + 2 / 3
        points = np.concatenate([up, down]).T / parts
        pieces = (points, np.full(points.shape[1], 0.5 / points.shape[1]))
        scalar = skfem.FacetBasis(self.mesh, skfem.ElementTetP2(), facets=self.base, intorder=4)
        fine = skfem.FacetBasis(self.mesh, scalar.elem, facets=self.base, quadrature=pieces)
        mass = skfem.BilinearForm(lambda p, q, w: p * q).assemble(scalar)
        nodes = scalar.get_dofs(self.base).all()
        upright = self.moved.get_dofs(self.base).all("u^3")
        order = np.lexsort(np.round(scalar.doflocs[:2, nodes], 9))
        upright = upright[np.lexsort(np.round(self.moved.doflocs[:2, upright], 9))]
        values = np.zeros(scalar.N)
        inner = nodes[order]
        values[inner] = sparse.linalg.spsolve(mass[inner][:, inner].tocsc(), reaction[upright])
        share = np.asarray(fine.interpolate(values)) * fine.dx
        x, y, _ = np.asarray(fine.global_coordinates())
        step = SIZE / RADIUS / CELLS
        column = np.floor(x / step).astype(int) + CELLS // 2
        row = np.floor(np.maximum(y, 0) / step).astype(int)
        half = np.zeros((CELLS // 2, CELLS))
        np.add.at(half, (row.ravel(), column.ravel()), share.ravel() / step**2)
        return 2 * float(reaction[upright].sum()), np.concatenate([half[::-1], half])


def main() -> None:
    """Compute every point and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scale", type=float, default=1.25, help="of the elements' size")
    parser.add_argument("--base", choices=[*POINTS], action="append")
    arguments = parser.parse_args()
    mesh = quarter_ball(arguments.scale)
    found: dict[str, list[object]] = {}
    for base in arguments.base or POINTS:
        for poisson in sorted({point[0] for point in POINTS[base]}):
            tip = SolidTip(mesh, poisson, base.startswith("bonded"))
            for _, d, degrees in (point for point in POINTS[base] if point[0] == poisson):
                way = tip.stick if base.endswith("sticking") else tip.press
                push, energy, every = way(d / RADIUS, np.radians(degrees))
                force, frame = tip.frame(every)
                row = {
                    "base": base,
                    "nu": poisson,
                    "d": d / RADIUS,
                    "theta": np.radians(degrees),
                    "push": push,
                    "energy": energy,
                    "force": force,
                    "frame": frame.astype(np.float32),
                    "dofs": tip.free.size,
                }
                for name, value in row.items():
                    found.setdefault(name, []).append(value)
                print(*list(row.values())[:-2], frame.sum(), flush=True)
                np.savez_compressed(arguments.out, **found)


if __name__ == "__main__":
    main()
