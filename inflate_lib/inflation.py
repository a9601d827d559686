"""Inflation of a structure: finite-strain elasticity under a follower pressure (paper sec. 3).

Plane strain, compressible neo-Hookean (MOOSE's ``ComputeNeoHookeanStress``):
P = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ is the gradient of W = μ/2 (F:F − 2) + φ(J) with φ(J) = λ/2 ln² J − μ ln J.

The cavity is closed, so that the follower pressure p has a potential too, −p times the area of the cavity, and an
equilibrium is a stationary point of

    Π(x) = Σ_e ½ x·k x + Σ_e w φ(J(x)) − p A(x),

where x are the deformed coordinates. In two dimensions F:F, J and A are all *quadratic* in x. Hence k, the second
derivative G of J and the second derivative H of A are constants, and with c = ∂J/∂x the tangent is

    K = k + w φ″ c cᵀ + w φ′ G − p H,

symmetric, and cheap to assemble. Elements differ only in where J is taken: at the four Gauss points (``"q1"``, which
locks, because λ/μ = 100) or once per element as its mean (``"mean-dilatation"``, the default, which does not).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit

from inflate_lib import material, skyline
from inflate_lib.material import LAMBDA, MU
from inflate_lib.mesh import Mesh, build_mesh

PRESSURE = 0.01  # internal pressure at t = 1: p(t) = PRESSURE · t
ELEMENTS = ("mean-dilatation", "q1")

MAX_ITERATIONS = 40  # Newton iterations of one load step
MAX_HALVINGS = 6  # of a load step that does not converge
FACTORISATIONS = 1000, 100  # allowed in all, or per load step if that is more; MNIST's sevens take at most 264 in ten
SPEED = 1e9  # multiply-adds per second of the nominal core that turns a time limit into a number of factorisations
ASSEMBLY = 200  # multiply-adds per element and factorisation
MAX_MOVE = 0.1  # largest nodal move of one Newton iteration, in lengths of the unit square
MIN_J = 0.05  # smallest area ratio allowed on the way
TOLERANCE = 1e-8  # largest nodal move of a full Newton step at which it counts as converged (the next would be < 1e-12)

_GAUSS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / np.sqrt(3)
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


@dataclass(frozen=True)
class Inflation:
    """An inflated structure, with every load step.

    Attributes
    ----------
    mesh : Mesh
    element : str
        ``"mean-dilatation"`` or ``"q1"``.
    load_steps : (steps,) float
        Times t of the load steps; the pressure is ``PRESSURE * t`` unless another one was asked for.
    pressures : (steps,) float
        Internal pressure at each load step.
    displacement : (steps, n, 2) float
        Nodal displacement at each load step; NaN from the first load step that did not converge.
    converged : bool
        True where every load step reached equilibrium.
    reason : str
        Why not; empty where converged.
    factorisations : int
        Number of factorisations of the tangent, the measure of effort.
    lame : (float, float)
        Lamé parameters (λ, μ).
    """

    mesh: Mesh
    element: str
    load_steps: np.ndarray
    pressures: np.ndarray
    displacement: np.ndarray
    converged: bool
    reason: str
    factorisations: int
    lame: tuple[float, float]

    @property
    def nodes(self):
        """(n, 2) undeformed coordinates."""
        return self.mesh.nodes

    @property
    def cells(self):
        """(m, 4) node numbers of the quadrilaterals."""
        return self.mesh.cells

    def deformed(self, step=-1):
        """(n, 2) deformed coordinates at a load step (the last one by default)."""
        return self.nodes + self.displacement[step]

    @cached_property
    def deformation_gradient(self):
        """(steps, m, 4, 2, 2) deformation gradient F at the Gauss points of each element."""
        gradients, _ = shape_gradients(self.nodes[self.cells])
        positions = (self.nodes + self.displacement)[:, self.cells]
        return np.einsum("smai,mqaj->smqij", positions, gradients)

    @cached_property
    def first_piola_kirchhoff(self):
        """(steps, m, 4, 2, 2) in-plane first Piola–Kirchhoff stress P at the Gauss points, in units of μ and λ.

        With mean dilatation the part φ′(J) cof F takes the element's mean J, as the equilibrium does.
        """
        F, J = self.deformation_gradient, None
        if self.element == "mean-dilatation":
            J = F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
            _, weights = shape_gradients(self.nodes[self.cells])
            J = np.broadcast_to(np.average(J, axis=-1, weights=np.broadcast_to(weights, J.shape))[..., None], J.shape)
        return material.first_piola_kirchhoff(F, self.lame, J)


def inflate(
    label, n_steps=10, element="mean-dilatation", refine=1, pressure=PRESSURE, lame=(LAMBDA, MU), time_limit=None
):
    """Inflate a structure given as a label image.

    Parameters
    ----------
    label : (s, s) array_like or Mesh
        Labels 0 (outside), 0.5 (wall), 1 (void), from :func:`inflate_lib.label_image`; or a mesh.
    n_steps : int
        Equal load steps t = 1/n, …, 1 (the paper: ten).
    element : {"mean-dilatation", "q1"}
        Bilinear quadrilateral with the mean dilatation of Simo, Taylor and Pister (no locking), or plain.
    refine : int
        Sub-elements per pixel and direction; a mesh is taken as it is.
    pressure : float
        Internal pressure at t = 1.
    lame : (float, float)
        Lamé parameters (λ, μ).
    time_limit : float, optional
        Seconds after which to give up, counted on a nominal core of `SPEED`: it becomes a number of factorisations,
        from the size of the mesh, so that the outcome depends neither on the machine nor on its load.

    Returns
    -------
    Inflation
        ``converged`` says whether equilibrium was found at every load step; if not, ``reason`` says where it failed.

    Raises
    ------
    ValueError
        For a label image that cannot be inflated (see :func:`inflate_lib.mesh.build_mesh`) and for parameters out of
        range.
    """
    if element not in ELEMENTS:
        raise ValueError(f"element must be one of {', '.join(ELEMENTS)}, not {element!r}")
    check_steps(n_steps)
    lam, mu = _numbers("lame", lame, 2, "two positive numbers (λ, μ)")
    if lam <= 0 or mu <= 0:
        raise ValueError(f"lame must be two positive numbers (λ, μ), not {lame!r}")
    (pressure,) = _numbers("pressure", [pressure], 1, "a finite number")
    check_time_limit(time_limit)
    mesh = label if isinstance(label, Mesh) else build_mesh(label, refine)

    system = _System.of(mesh, element, mu)
    times = np.arange(1, n_steps + 1) / n_steps
    allowed, limit = max(FACTORISATIONS[0], FACTORISATIONS[1] * n_steps), ""
    if time_limit is not None and time_limit < allowed * nominal_seconds(system):
        allowed, limit = int(time_limit / nominal_seconds(system)), f", the time limit of {time_limit:g} s"
    positions, reached, factorisations = _march(*system.arrays(), lam, mu, pressure * times, allowed)
    displacement = np.full((n_steps, *mesh.nodes.shape), np.nan)
    displacement[:reached] = 0.0
    free_positions = positions.reshape(n_steps, len(system.order), 2)[:reached]
    displacement[:reached, system.order] = free_positions - mesh.nodes[system.order]
    reason = ""
    if reached < n_steps:
        last = pressure * times[reached]
        reason = f"no equilibrium found at load step {reached + 1} of {n_steps} (pressure {last:.4g})"
        if factorisations >= allowed:
            reason += f" within {allowed} factorisations{limit}"
    return Inflation(
        mesh, element, times, pressure * times, displacement, reached == n_steps, reason, int(factorisations), (lam, mu)
    )


def nominal_seconds(system):
    """Seconds that one factorisation of a system's tangent, assembled and used, takes on the nominal core."""
    row_lengths = np.arange(len(system.first)) - system.first
    return (0.5 * np.sum(row_lengths**2) + ASSEMBLY * len(system.cells)) / SPEED


def check_steps(n_steps):
    """Raise a ValueError where `n_steps` is no number of load steps."""
    if isinstance(n_steps, bool) or not isinstance(n_steps, int | np.integer) or not 1 <= n_steps <= 10_000:
        raise ValueError(f"n_steps must be a whole number from 1 to 10000, not {n_steps!r}")


def check_time_limit(seconds):
    """Raise a ValueError where `seconds` is neither None nor a positive number."""
    if seconds is not None:
        (number,) = _numbers("time_limit", [seconds], 1, "a positive number of seconds")
        if isinstance(seconds, bool) or number <= 0:
            raise ValueError(f"time_limit must be a positive number of seconds, not {seconds!r}")


def _numbers(name, values, count, wanted):
    """`values` as `count` finite floats, or a ValueError that names the parameter."""
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be {wanted}, not {values if count > 1 else values[0]!r}")
    return numbers


def shape_gradients(corners):
    """Gradients of the bilinear shape functions and weights at the 2 × 2 Gauss points.

    Parameters
    ----------
    corners : (m, 4, 2) float
        Undeformed corners of each element, counter-clockwise.

    Returns
    -------
    gradients : (m, 4, 4, 2) float
        ∂N_a/∂X_j at Gauss point q, indexed [element, q, a, j].
    weights : (m, 4) float
        Undeformed area that belongs to each Gauss point.
    """
    xi, eta = _GAUSS[:, :1], _GAUSS[:, 1:]
    local = np.stack([_CORNERS[:, 0] * (1 + eta * _CORNERS[:, 1]), _CORNERS[:, 1] * (1 + xi * _CORNERS[:, 0])], -1) / 4
    jacobian = np.einsum("mai,qaj->mqij", corners, local)
    return np.einsum("qaj,mqji->mqai", local, np.linalg.inv(jacobian)), np.linalg.det(jacobian)


@dataclass(frozen=True)
class _System:
    """Everything about a mesh that does not change during an inflation, in the order of elimination."""

    order: np.ndarray  # (free,) mesh node of each free node
    x0: np.ndarray  # (2 free,) undeformed coordinates of the free nodes
    cells: np.ndarray  # (m, 4) free nodes of each element, -1 where clamped
    fixed: np.ndarray  # (m, 4, 2) coordinates, used where clamped
    kind: np.ndarray  # (m,) row of the tables below; one row serves all congruent elements
    stiffness: np.ndarray  # (kinds, 4, 4) μ ∫ ∇N_a·∇N_b dV
    dilatation: np.ndarray  # (kinds, d, 4, 4) antisymmetric G with J = Σ x_a G_ab y_b
    weights: np.ndarray  # (kinds, d) undeformed area that belongs to each J
    edges: np.ndarray  # (k, 2) free nodes of the pressure edges, -1 where clamped
    edges_fixed: np.ndarray  # (k, 2, 2)
    first: np.ndarray
    offset: np.ndarray
    constant: np.ndarray  # skyline of k
    pressure: np.ndarray  # skyline of H
    pinned: np.ndarray  # unknowns (2 node + direction) that are held though their node is free in the other direction

    @classmethod
    def of(cls, mesh, element, mu):
        held = np.broadcast_to(np.reshape(mesh.clamped, (len(mesh.nodes), -1)), mesh.nodes.shape)  # (n,) or (n, 2)
        free = np.flatnonzero(~held.all(axis=1))
        number = np.full(len(mesh.nodes), -1)
        number[free] = np.arange(len(free))
        order = free[skyline.bandwidth_order(len(free), number[mesh.cells])]
        number[order] = np.arange(len(free))
        cells, edges = number[mesh.cells], number[mesh.pressure_edges]

        corners = mesh.nodes[mesh.cells]
        relative = corners - corners[:, :1]
        congruent = np.allclose(relative, relative[:1], rtol=0, atol=1e-12 * np.abs(relative[:1]).max())
        kind = np.zeros(len(cells), dtype=np.int64) if congruent else np.arange(len(cells))
        gradients, weights = shape_gradients(corners[:1] if congruent else corners)
        stiffness = mu * np.einsum("mq,mqai,mqbi->mab", weights, gradients, gradients)
        dx, dy = gradients[..., 0], gradients[..., 1]
        dilatation = dx[..., :, None] * dy[..., None, :] - dy[..., :, None] * dx[..., None, :]
        if element == "mean-dilatation":
            area = weights.sum(axis=1)
            dilatation = np.einsum("mq,mqab->mab", weights / area[:, None], dilatation)[:, None]
            weights = area[:, None]

        first, offset, size = skyline.envelope(len(order), cells)
        constant, pressure = np.zeros(size), np.zeros(size)
        _assemble_constant(constant, pressure, cells, kind, stiffness, edges, offset)
        return cls(
            order, mesh.nodes[order].ravel(), cells, corners, kind, stiffness, np.ascontiguousarray(dilatation),
            weights, edges, mesh.nodes[mesh.pressure_edges], first, offset, constant, pressure,
            np.flatnonzero(held[order]),
        )  # fmt: skip

    def arrays(self):
        return (
            self.x0, self.cells, self.fixed, self.kind, self.stiffness, self.dilatation, self.weights,
            self.edges, self.edges_fixed, self.first, self.offset, self.constant, self.pressure, self.pinned,
        )  # fmt: skip


@njit(cache=True, nogil=True)
def _assemble_constant(constant, pressure, cells, kind, stiffness, edges, offset):
    """Skylines of k (stiffness of μ/2 F:F) and of H (second derivative of the cavity's area)."""
    for e in range(len(cells)):
        for a in range(4):
            for b in range(4):
                i, j = cells[e, a], cells[e, b]
                if i >= j >= 0:
                    for d in range(2):
                        constant[offset[2 * i + d] + 2 * j + d] += stiffness[kind[e], a, b]
    for k in range(len(edges)):  # A = ½ Σ (x_i y_j − x_j y_i)
        i, j = edges[k]
        if i >= 0 and j >= 0:
            sign = 1.0
            if i < j:
                i, j, sign = j, i, -1.0
            pressure[offset[2 * i] + 2 * j + 1] += 0.5 * sign
            pressure[offset[2 * i + 1] + 2 * j] -= 0.5 * sign


@njit(cache=True, nogil=True)
def _gather(x, cells, fixed, out):
    """Deformed corners (m, 4, 2) of each element."""
    for e in range(len(cells)):
        for a in range(cells.shape[1]):
            i = cells[e, a]
            for d in range(2):
                out[e, a, d] = x[2 * i + d] if i >= 0 else fixed[e, a, d]


@njit(cache=True, nogil=True)
def _dilatations(corners, kind, dilatation, J, c):
    """J (m, d) and its gradient c (m, d, 4, 2) with respect to the corners."""
    for e in range(len(corners)):
        for q in range(dilatation.shape[1]):
            G, value = dilatation[kind[e], q], 0.0
            for a in range(4):
                cx = cy = 0.0
                for b in range(4):
                    cx += G[a, b] * corners[e, b, 1]
                    cy -= G[a, b] * corners[e, b, 0]  # G is antisymmetric
                c[e, q, a, 0], c[e, q, a, 1] = cx, cy
                value += corners[e, a, 0] * cx
            J[e, q] = value


@njit(cache=True, nogil=True)
def _residual(corners, cells, kind, stiffness, weights, J, c, edges, edge_corners, lam, mu, p, r):
    """Gradient of the potential, r = k x + Σ w φ′ c − p ∂A/∂x."""
    r[:] = 0.0
    for k in range(len(edges)):
        i, j = edges[k]
        dx, dy = edge_corners[k, 1] - edge_corners[k, 0]
        for node in (i, j):
            if node >= 0:
                r[2 * node] -= 0.5 * p * dy
                r[2 * node + 1] += 0.5 * p * dx
    for e in range(len(cells)):
        for a in range(4):
            i = cells[e, a]
            if i >= 0:
                fx = fy = 0.0
                for b in range(4):
                    k_ab = stiffness[kind[e], a, b]
                    fx += k_ab * corners[e, b, 0]
                    fy += k_ab * corners[e, b, 1]
                for q in range(J.shape[1]):
                    slope = weights[kind[e], q] * (lam * np.log(J[e, q]) - mu) / J[e, q]
                    fx += slope * c[e, q, a, 0]
                    fy += slope * c[e, q, a, 1]
                r[2 * i] += fx
                r[2 * i + 1] += fy


@njit(cache=True, nogil=True)
def _tangent(values, constant, pressure, cells, kind, dilatation, weights, J, c, pi, theta, lam, mu, p, offset):
    """Skyline of the tangent; `pi` stands for λ ln J and is blended with μ by `theta` (θ = 0: convex but for −p H)."""
    for k in range(len(values)):
        values[k] = constant[k] - p * pressure[k]
    for e in range(len(cells)):
        for q in range(J.shape[1]):
            G, w, j = dilatation[kind[e], q], weights[kind[e], q], J[e, q]
            blended = mu + theta * (pi[e, q] - mu)
            slope = w * (blended - mu) / j  # w φ′
            curvature = w * (lam - blended + mu) / (j * j)  # w φ″
            for a in range(4):
                i = cells[e, a]
                if i < 0:
                    continue
                row0, row1 = offset[2 * i], offset[2 * i + 1]
                gx, gy = curvature * c[e, q, a, 0], curvature * c[e, q, a, 1]
                for b in range(4):
                    k = cells[e, b]
                    if k < 0 or k > i:
                        continue
                    bx, by, g = c[e, q, b, 0], c[e, q, b, 1], slope * G[a, b]
                    values[row0 + 2 * k] += gx * bx
                    values[row1 + 2 * k] += gy * bx - g
                    values[row1 + 2 * k + 1] += gy * by
                    if k < i:
                        values[row0 + 2 * k + 1] += gx * by + g


@njit(cache=True, nogil=True)
def _pin(pinned, values, first, offset, r):
    """Hold single unknowns: their rows and columns become those of the identity, their residual zero."""
    for k in pinned:
        r[k] = 0.0
        values[offset[k] + first[k] : offset[k] + k] = 0.0
        values[offset[k] + k] = 1.0
        for i in range(k + 1, len(r)):
            if first[i] <= k:
                values[offset[i] + k] = 0.0


@njit(cache=True, nogil=True)
def _largest_step(J, slope, bend, start):
    """Largest s ≤ start with J + s·slope + s²·bend ≥ MIN_J along all of [0, s], everywhere (J is quadratic in s)."""
    s = start
    for e in range(J.shape[0]):
        for q in range(J.shape[1]):
            a, b, height = bend[e, q], slope[e, q], J[e, q] - MIN_J
            discriminant = b * b - 4 * a * height
            if discriminant >= 0:
                # The smallest positive root, in the form that does not cancel.
                root = np.sqrt(discriminant)
                if b < 0 or a < 0:
                    below = root - b
                    if below > 0:
                        s = min(s, 2 * height / below)
    return s


@njit(cache=True, nogil=True)
def _march(
    x0, cells, fixed, kind, stiffness, dilatation, weights, edges, edges_fixed, first, offset, constant, pressure,
    pinned, lam, mu, pressures, allowed,
):  # fmt: skip
    """Follow the equilibrium through the load steps.

    Newton's method on Π, with one change to the tangent (mixed integration points, Magisano et al. 2017): λ ln J is
    replaced by its linear extrapolation from the last iterate. The residual, and so the solution, is that of Π.
    A load step that fails is approached in halves. After `allowed` factorisations it gives up, so that every
    structure ends in bounded time.

    Returns positions (steps, 2 free), the number of load steps reached, and the number of factorisations.
    """
    m, d, n = len(cells), weights.shape[1], len(x0)
    corners, moves = np.empty((m, 4, 2)), np.empty((m, 4, 2))
    edge_corners, no_edges_move = np.empty((len(edges), 2, 2)), np.zeros((m, 4, 2))
    J, c, pi = np.empty((m, d)), np.empty((m, d, 4, 2)), np.empty((m, d))
    slope, bend, c_move = np.empty((m, d)), np.empty((m, d)), np.empty((m, d, 4, 2))
    r, step, values, inverse_pivots = np.empty(n), np.empty(n), np.empty(len(constant)), np.empty(n)

    positions = np.empty((len(pressures), n))
    x, last_pressure, factorisations = x0.copy(), 0.0, 0
    for target in range(len(pressures)):
        p, halvings = pressures[target], 0
        while True:  # sub-steps from last_pressure to pressures[target]
            trial, converged = x.copy(), False
            for iteration in range(MAX_ITERATIONS):
                _gather(trial, cells, fixed, corners)
                _gather(trial, edges, edges_fixed, edge_corners)
                _dilatations(corners, kind, dilatation, J, c)
                if iteration == 0:
                    pi[:] = lam * np.log(J)
                _residual(corners, cells, kind, stiffness, weights, J, c, edges, edge_corners, lam, mu, p, r)
                for theta in (1.0, 0.5, 0.25, 0.0):
                    if factorisations >= allowed:
                        return positions, target, factorisations
                    _tangent(
                        values, constant, pressure, cells, kind, dilatation, weights, J, c, pi, theta, lam, mu, p,
                        offset,
                    )  # fmt: skip
                    _pin(pinned, values, first, offset, r)
                    factorisations += 1
                    done = skyline.factorise(values, first, offset, inverse_pivots)
                    if done == n:
                        break
                if done < n:
                    break
                step[:] = -r
                skyline.solve(values, first, offset, inverse_pivots, step)
                _gather(step, cells, no_edges_move, moves)
                _dilatations(moves, kind, dilatation, bend, c_move)
                for e in range(m):
                    for q in range(d):
                        slope[e, q] = np.sum(c[e, q] * moves[e])
                length = np.max(np.abs(step))
                if not np.isfinite(length):
                    break
                s = _largest_step(J, slope, bend, min(1.0, MAX_MOVE / max(length, MAX_MOVE)))
                trial += s * step
                if length <= TOLERANCE and s == 1.0 and theta == 1.0:  # θ = 1: positive definite, so stable
                    converged = True
                    break
                pi[:] = lam * (np.log(J) + s * slope / J)
            if converged:
                x, last_pressure = trial, p
                if p == pressures[target]:
                    break
                p = pressures[target]
            else:
                halvings += 1
                if halvings > MAX_HALVINGS:
                    return positions, target, factorisations
                p = 0.5 * (last_pressure + p)
        positions[target] = x
    return positions, len(pressures), factorisations
