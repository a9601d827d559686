"""What the tests of the mechanics share: small structures, and independent solvers to compare with.

The solvers share nothing but the mesh with `inflate_lib.mechanics.inflation`. FElupe assembles the solid and the
follower pressure by its own means; the mean-dilatation element, which FElupe does not have in this form, is the
potential written down in PyTorch and differentiated by it.
"""

from dataclasses import replace

import felupe
import numpy as np
import torch
from felupe.math import cdya_il, det, inv, transpose
from scipy import ndimage
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from inflate_lib import build_mesh
from inflate_lib.mechanics.inflation import LAMBDA, MU, PRESSURE

GRADING = 0.3  # thickness of each layer of a graded pixel's elements relative to the next one inwards


def hook():
    """A small bent structure, (12, 12) labels, with a wall of two pixels."""
    label = np.zeros((12, 12))
    label[2:, 1:7] = label[2:8, 1:11] = 0.5
    label[4:10, 3:5] = label[4:6, 3:9] = 1
    return label


def random_label(seed, size=14, pixels=18):
    """Labels of a random cavity, a connected walk over at most `pixels` pixels, in a wall of one or two pixels."""
    rng = np.random.default_rng(seed)
    void = np.zeros((size, size), dtype=bool)
    spot, wall = rng.integers(4, size - 4, 2), int(rng.integers(1, 3))
    for _ in range(int(rng.integers(2, pixels))):
        void[tuple(spot)] = True
        spot[rng.integers(2)] += rng.choice([-1, 1])
        spot = spot.clip(2, size - 3)
    void = ndimage.binary_fill_holes(void)
    label = np.where(void, 1, np.where(ndimage.binary_dilation(void, np.ones((2 * wall + 1,) * 2)), 0.5, 0))
    return np.roll(label, size - 1 - np.flatnonzero(label.any(axis=1)).max(), axis=0)


def graded_mesh(label, layers):
    """Mesh of 2 · `layers` elements per pixel side that become geometrically thinner towards the sides of each pixel.

    The stress is infinite at re-entrant corners, and those are corners of pixels: such a mesh resolves them with few
    elements. It contains the lines of the mesh with one layer less; with one layer it is the uniform one.
    """
    n = 2 * layers
    mesh = build_mesh(label, n)
    half = 0.5 * GRADING ** np.arange(layers - 1, -1, -1)
    lines = np.concatenate([[0], half, 1 - half[-2::-1]])
    pixel, line = np.divmod(np.rint(mesh.nodes * len(label) * n).astype(int), n)
    return replace(mesh, nodes=(pixel + lines[line]) / len(label))


def felupe_system(mesh, order):
    """FElupe's displacement field, solid and follower pressure for a `Mesh`, and its mesh."""
    quads = felupe.Mesh(mesh.nodes, mesh.cells, "quad")
    cavity = np.zeros(len(mesh.nodes), dtype=bool)
    cavity[mesh.pressure_edges] = True
    if order == 2:
        quads = felupe.mesh.convert(quads, order=2, calc_points=True, calc_midfaces=True)
        assert len(np.unique(quads.points.round(12), axis=0)) == len(quads.points), "a midpoint was made twice"
        middles = mesh.nodes[mesh.pressure_edges].mean(axis=1)
        on_edge = cKDTree(middles).query(quads.points[len(mesh.nodes) :])[0] < 1e-9
        cavity = np.concatenate([cavity, on_edge])
        region = felupe.RegionBiQuadraticQuad(quads)
        boundary = felupe.RegionBiQuadraticQuadBoundary(quads, mask=cavity, ensure_3d=True)
    else:
        region = felupe.RegionQuad(quads)
        boundary = felupe.RegionQuadBoundary(quads, mask=cavity, ensure_3d=True)
    field = felupe.FieldContainer([felupe.FieldPlaneStrain(region, dim=2)])
    on_boundary = felupe.FieldContainer([felupe.FieldPlaneStrain(boundary, dim=2)])
    solid = felupe.SolidBody(felupe.NeoHookeCompressible(mu=MU, lmbda=LAMBDA), field)
    assert boundary.mesh.ncells == len(mesh.pressure_edges)
    return quads, field, solid, felupe.SolidBodyPressure(on_boundary)


class _MixedPoints(felupe.NeoHookeCompressible):
    """FElupe's law with π, a state variable, in the place of λ ln J in its tangent (Magisano et al. 2017).

    Extrapolated linearly from one iterate to the next, π spares Newton's method the many short moves that near
    incompressibility costs it. The stress, and so the solution, is that of the law.
    """

    def __init__(self):
        super().__init__(mu=MU, lmbda=LAMBDA)
        self.x = [np.eye(3), np.zeros(())]  # the shapes of F and of the state variable

    def _hessian(self, x):
        F, pi = x
        J = det(F)
        G = transpose(inv(F, J))
        return [super()._hessian(x)[0] + (LAMBDA * np.log(J) - pi) * cdya_il(G, G)]


def inflate_with_felupe(mesh, n_steps=10, order=1, pressure=PRESSURE, tolerance=1e-10):
    """Deformed nodes (steps, n, 2) from FElupe with bilinear (`order` = 1) or biquadratic elements.

    The biquadratic elements have further nodes after those of the mesh. Every equilibrium is a stable one (its tangent
    is positive definite); a load step that fails is approached in halves.
    """
    quads, field, _, load = felupe_system(mesh, order)
    flat = felupe.FieldContainer([felupe.Field(field.region, dim=2)])  # in plane strain this law needs no more
    solid, u = felupe.SolidBody(_MixedPoints(), flat), flat[0].values
    free = np.flatnonzero(np.repeat(quads.points[:, 1] > 1e-12, 2))
    deformed, reached = [], 0.0
    for target in pressure * np.arange(1, n_steps + 1) / n_steps:
        p, start = target, u.copy()
        while reached < target:
            if _newton(flat, solid, load, free, p, tolerance):
                p, reached, start = target, p, u.copy()
            else:
                u[:], p = start, (reached + p) / 2
                assert p - reached > 0.01 * target, "the peer found no equilibrium"
        deformed.append(quads.points + u)
    return np.array(deformed)


def _newton(field, solid, load, free, p, tolerance):
    """Move the field to equilibrium under the pressure p; whether that succeeded."""
    u, pi = field[0].values, None
    for _ in range(60):
        (F,) = field.extract()
        J, before = det(F), u.copy()
        pi = LAMBDA * np.log(J) if pi is None else pi
        r = solid.assemble.vector(field) - load.assemble.vector(field, pressure=p)  # the latter is a load
        for theta in (1, 0.5, 0.25, 0):  # towards π = μ, where the energy is convex
            solid.results.statevars[:] = MU + theta * (pi - MU)
            K = solid.assemble.matrix(field) - load.assemble.matrix(field, pressure=p)
            factors = splu(
                K.tocsc()[free][:, free], "MMD_AT_PLUS_A", diag_pivot_thresh=0, options={"SymmetricMode": True}
            )
            stable = (factors.U.diagonal() > 0).all()
            if stable:
                break
        move = np.zeros(u.size)
        move[free] = -factors.solve(r.toarray().ravel()[free])
        length = np.abs(move).max()
        if not np.isfinite(length):
            return False
        longest = min(1, 0.1 / length)
        for s in longest * 0.5 ** np.arange(20):  # shorter where an element would turn over
            u[:] = before + s * move.reshape(-1, 2)
            if det(field.extract()[0]).min() > 0.02:
                break
        else:
            return False
        if s == 1 and theta == 1 and stable and length < tolerance:
            return True
        pi = LAMBDA * (np.log(J) + (transpose(inv(F, J)) * (field.extract()[0] - F)).sum(axis=(0, 1)))
    return False


def potential(mesh, x, p, mean_dilatation=True, shares=None):
    """Potential Π of deformed nodes x, (n, 2) float64 tensor: neo-Hookean energy minus p times the cavity's area.

    With `shares` (m,) each element has only that share of its energy.
    """
    X = torch.from_numpy(mesh.nodes)[torch.from_numpy(mesh.cells)]
    corners = x[torch.from_numpy(mesh.cells)]
    F, weights = zip(*(_deformation_gradient(X, corners, xi, eta) for xi in (-1, 1) for eta in (-1, 1)), strict=True)
    F, weights = torch.stack(F, 1), torch.stack(weights, 1)
    weights = weights if shares is None else weights * shares[:, None]
    J = F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
    energy = (weights * MU / 2 * ((F**2).sum((-1, -2)) - 2)).sum()
    if mean_dilatation:
        J, weights = (weights * J).sum(1) / weights.sum(1), weights.sum(1)
    energy = energy + (weights * (LAMBDA / 2 * J.log() ** 2 - MU * J.log())).sum()
    start, end = x[torch.from_numpy(mesh.pressure_edges).T]
    return energy - p * 0.5 * (start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1]).sum()


def _deformation_gradient(X, x, xi, eta):
    """F and its share of the area at the Gauss point (ξ, η) / √3, from the two tangents of the bilinear map."""
    xi, eta = xi / 3**0.5, eta / 3**0.5

    def tangents(corners):
        a, b, c, d = corners.unbind(1)
        along = ((1 - eta) * (b - a) + (1 + eta) * (c - d)) / 4
        across = ((1 - xi) * (d - a) + (1 + xi) * (c - b)) / 4
        return torch.stack([along, across], -1)

    reference = tangents(X)
    return tangents(x) @ torch.linalg.inv(reference), torch.linalg.det(reference)


def inflate_with_torch(mesh, n_steps=10, mean_dilatation=True, pressure=PRESSURE):
    """Deformed nodes (n, 2): Newton's method on `potential`, every derivative from PyTorch, dense matrices."""
    free = torch.from_numpy(~mesh.clamped)
    reference = torch.from_numpy(mesh.nodes)

    def energy(u, p):
        return potential(mesh, reference.index_put((free,), reference[free] + u.reshape(-1, 2)), p, mean_dilatation)

    u = torch.zeros(2 * int(free.sum()), dtype=torch.float64)
    for p in pressure * np.arange(1, n_steps + 1) / n_steps:
        for _ in range(60):
            gradient = torch.func.grad(energy)(u, p)
            step = torch.linalg.solve(torch.func.hessian(energy)(u, p), -gradient)
            scale = min(1.0, 0.02 / float(step.abs().max()))
            while not torch.isfinite(energy(u + scale * step, p)):
                scale /= 2
            u = u + scale * step
            if float(step.abs().max()) < 1e-11:
                break
        else:
            raise AssertionError("the peer found no equilibrium")
    deformed = mesh.nodes.copy()
    deformed[~mesh.clamped] += u.numpy().reshape(-1, 2)
    return deformed


def places(pattern):
    """Row and column of each block of a sparse matrix."""
    columns = np.repeat(np.arange(len(pattern.order)), np.diff(pattern.column_start))
    diagonal = np.arange(len(pattern.order))
    return np.concatenate([pattern.rows, diagonal]), np.concatenate([columns, diagonal])
