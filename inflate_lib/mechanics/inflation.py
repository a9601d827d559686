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

import reprlib
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numba import njit

from inflate_lib.mechanics import _sparse, material
from inflate_lib.mechanics.material import LAMBDA, MU
from inflate_lib.mechanics.mesh import Mesh, build_mesh, check_mesh

PRESSURE = 0.01  # internal pressure at t = 1: p(t) = PRESSURE · t
ELEMENTS = ("mean-dilatation", "q1")

MAX_ITERATIONS = 40  # Newton iterations of one load step
MAX_HALVINGS = 6  # of a load step that does not converge
FACTORISATIONS = 1000, 100  # allowed in all, or per load step if that is more; MNIST's sevens take at most 228 in ten
SPEED = 1.25e9  # multiply-adds per second of the nominal core that turns a time limit into a number of factorisations
ASSEMBLY = 300  # multiply-adds per element and factorisation
MAX_MOVE = 0.1  # largest nodal move of one Newton iteration, in lengths of the unit square
MIN_J = 0.05  # smallest area ratio allowed on the way
TOLERANCE = 1e-11  # largest nodal move of an iteration at which a load step has converged
ROUNDED = 1e-8  # the same where rounding keeps the moves from shrinking any further
REUSE = 3e-5  # nodal move of an iteration from which on the tangent is kept

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
        Times t of the load steps, equally spaced up to t = 1.
    pressures : (steps,) float
        Internal pressure at each load step: ``PRESSURE * t`` unless another one, or a history, was asked for.
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
    label, n_steps=None, element="mean-dilatation", refine=1, pressure=PRESSURE, lame=(LAMBDA, MU), clamped="bottom",
    time_limit=None,
):  # fmt: skip
    """Inflate a structure given as a label image.

    Parameters
    ----------
    label : (s, s) array_like or Mesh
        Labels 0 (outside), 0.5 (wall), 1 (void), from :func:`inflate_lib.label_image`; or a mesh.
    n_steps : int, optional
        Equal load steps t = 1/n, …, 1. Ten, as in the paper; or as many as the pressure history has entries.
    element : {"mean-dilatation", "q1"}
        Bilinear quadrilateral with the mean dilatation of Simo, Taylor and Pister (no locking), or plain.
    refine : int
        Sub-elements per pixel and direction; a mesh is taken as it is.
    pressure : float or sequence of float
        Internal pressure at t = 1, which it grows to in proportion to t; or a history, one pressure per load step,
        which may rise and fall.
    lame : (float, float)
        Lamé parameters (λ, μ).
    clamped : {"bottom", "left", "top", "right"}
        Edge of the image that is held; a mesh has its own. Make the label image with the same edge.
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
        For a label image that cannot be inflated (see :func:`inflate_lib.mechanics.mesh.build_mesh`) and for parameters out of
        range.
    """
    if element not in ELEMENTS:
        raise ValueError(f"element must be one of {', '.join(ELEMENTS)}, not {element!r}")
    times, pressures = load_history(pressure, n_steps)
    lam, mu = _numbers("lame", lame, 2, "two positive numbers (λ, μ)")
    if lam <= 0 or mu <= 0:
        raise ValueError(f"lame must be two positive numbers (λ, μ), not {lame!r}")
    check_time_limit(time_limit)
    mesh = check_mesh(label) if isinstance(label, Mesh) else build_mesh(label, refine, clamped)

    system = _System.of(mesh, element, mu)
    n_steps = len(pressures)
    allowed, limit = max(FACTORISATIONS[0], FACTORISATIONS[1] * n_steps), ""
    if time_limit is not None and time_limit < allowed * nominal_seconds(system):
        allowed, limit = int(time_limit / nominal_seconds(system)), f", the time limit of {time_limit:g} s"
    positions, reached, factorisations, turned_over = _march(*system.arrays(), lam, mu, pressures, allowed)
    displacement = np.full((n_steps, *mesh.nodes.shape), np.nan)
    displacement[:reached] = 0.0
    free_positions = positions.reshape(n_steps, len(system.order), 2)[:reached]
    displacement[:reached, system.order] = free_positions - mesh.nodes[system.order]
    reason = ""
    if reached < n_steps:
        reason = f"no equilibrium found at load step {reached + 1} of {n_steps} (pressure {pressures[reached]:.4g})"
        if turned_over:
            reason += ": an element turns inside out"
        elif factorisations >= allowed:
            reason += f" within {allowed} factorisations{limit}"
    return Inflation(
        mesh, element, times, pressures, displacement, reached == n_steps, reason, int(factorisations), (lam, mu)
    )


def load_history(pressure, n_steps=None):
    """Times t and pressures of the load steps, (steps,) each; `pressure` and `n_steps` are those of :func:`inflate`.

    Raises
    ------
    ValueError
        Where they are no pressure, no history or no number of steps, or contradict each other.
    """
    if n_steps is not None:
        check_steps(n_steps)
    try:
        pressures = np.array(pressure, dtype=float)
    except (TypeError, ValueError, RuntimeError):  # the last from tensors that NumPy cannot take
        pressures = np.array(np.nan)
    if pressures.ndim > 1 or not 1 <= pressures.size <= 10_000 or not np.isfinite(pressures).all():
        shown = reprlib.repr(pressure)
        raise ValueError(f"pressure must be a finite number, or a history of 1 to 10000 of them, not {shown}")
    is_history = pressures.ndim == 1
    if is_history and n_steps not in (None, pressures.size):
        raise ValueError(f"n_steps is {n_steps}, but the pressure history has {pressures.size} entries: leave it out")
    n_steps = pressures.size if is_history else n_steps or 10
    times = np.arange(1, n_steps + 1) / n_steps
    return times, pressures if is_history else float(pressures) * times


def nominal_seconds(system):
    """Seconds that one factorisation of a system's tangent, assembled and used, takes on the nominal core."""
    return (system.pattern.multiplications + ASSEMBLY * len(system.cells)) / SPEED


def check_steps(n_steps):
    """Raise a ValueError where `n_steps` is no number of load steps."""
    if isinstance(n_steps, bool) or not isinstance(n_steps, int | np.integer) or not 1 <= n_steps <= 10_000:
        raise ValueError(f"n_steps must be a whole number from 1 to 10000, not {n_steps!r}")


def check_time_limit(seconds):
    """Raise a ValueError where `seconds` is neither None nor a positive number."""
    if seconds is not None:
        (number,) = _numbers("time_limit", [seconds], 1, "a positive number of seconds")
        if isinstance(seconds, bool | str) or number <= 0:
            raise ValueError(f"time_limit must be a positive number of seconds, not {seconds!r}")


def _numbers(name, values, count, wanted):
    """`values` as `count` finite floats, or a ValueError that names the parameter."""
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        raise ValueError(f"{name} must be {wanted}, not {values!r}")
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
    cofactor = material.cofactor(jacobian)
    weights = np.sum(jacobian[..., 0, :] * cofactor[..., 0, :], axis=-1)
    return np.einsum("qaj,mqij->mqai", local, cofactor) / weights[..., None, None], weights


@dataclass(frozen=True)
class _System:
    """Everything about a mesh that does not change during an inflation, in the order of elimination."""

    points: tuple  # 0, …, d − 1, an element's values of J; a tuple, so that the compiler knows how many there are
    pattern: _sparse.Pattern
    order: np.ndarray  # (free,) mesh node of each free node
    x0: np.ndarray  # (2 free,) undeformed coordinates of the free nodes
    cells: np.ndarray  # (m, 4) free nodes of each element, -1 where clamped
    fixed: np.ndarray  # (m, 4, 2) coordinates, used where clamped
    kind: np.ndarray  # (m,) row of the tables below; one row serves all congruent elements
    stiffness: np.ndarray  # (kinds, 4, 4) μ ∫ ∇N_a·∇N_b dV
    dilatation: np.ndarray  # (kinds, d, 4, 4) antisymmetric G with J = Σ x_a G_ab y_b
    weights: np.ndarray  # (kinds, d) undeformed area that belongs to each J
    gauss: np.ndarray  # (kinds, 4, 4, 4) G at the Gauss points, whatever the element
    place: np.ndarray  # (m, 4, 4) block of each pair a >= b of an element's nodes, -1 where one is clamped
    edges: np.ndarray  # (k, 2) free nodes of the pressure edges, -1 where clamped
    edges_fixed: np.ndarray  # (k, 2, 2)
    constant: np.ndarray  # (blocks, 4) k, the part of the tangent that does not change
    pressure: np.ndarray  # (blocks, 4) H
    pinned: np.ndarray  # (free, 2) directions in which a node is held though it is free in the other; or no rows

    @classmethod
    def of(cls, mesh, element, mu):
        held = np.broadcast_to(np.reshape(mesh.clamped, (len(mesh.nodes), -1)), mesh.nodes.shape)  # (n,) or (n, 2)
        free = np.flatnonzero(~held.all(axis=1))
        number = np.full(len(mesh.nodes), -1)
        number[free] = np.arange(len(free))
        pattern = _sparse.pattern(len(free), number[mesh.cells])
        order = free[pattern.order]
        number[order] = np.arange(len(free))
        cells, edges = number[mesh.cells], number[mesh.pressure_edges]

        corners = mesh.nodes[mesh.cells]
        relative = corners - corners[:, :1]
        congruent = np.abs(relative - relative[:1]).max() <= 1e-12 * np.abs(relative[:1]).max()
        kind = np.zeros(len(cells), dtype=np.int64) if congruent else np.arange(len(cells))
        # One row for congruent elements; rounded, so that it is the same for all meshes of the same pixels.
        shapes = np.round(relative[:1], 15) if congruent else relative
        tables = _remembered_tables(shapes.tobytes(), element) if congruent else _element_tables(shapes, element)
        stiffness, dilatation, gauss, weights = tables
        stiffness = mu * stiffness

        constant, pressure = np.zeros((2, pattern.n_blocks, 4))
        place = np.full((len(cells), 4, 4), -1)
        _assemble_constant(pattern, constant, pressure, place, cells, kind, stiffness, edges)
        pinned = held[order] if held[order].any() else np.zeros((0, 2), dtype=bool)
        return cls(
            tuple(range(weights.shape[1])), pattern, order, mesh.nodes[order].ravel(), cells, corners, kind, stiffness,
            dilatation, weights, gauss, place, edges, mesh.nodes[mesh.pressure_edges], constant, pressure, pinned,
        )  # fmt: skip

    def arrays(self):
        return (
            self.points, self.pattern, self.x0, self.cells, self.fixed, self.kind, self.stiffness, self.dilatation,
            self.weights, self.gauss, self.place, self.edges, self.edges_fixed, self.constant, self.pressure,
            self.pinned,
        )  # fmt: skip


def _element_tables(corners, element):
    """What depends on its shape only: ∫ ∇N_a·∇N_b dV, G of each J and of each Gauss point, and the area of each J."""
    gradients, weights = shape_gradients(corners)
    stiffness = np.einsum("mq,mqai,mqbi->mab", weights, gradients, gradients)
    dx, dy = gradients[..., 0], gradients[..., 1]
    gauss = dilatation = dx[..., :, None] * dy[..., None, :] - dy[..., :, None] * dx[..., None, :]
    if element == "mean-dilatation":
        area = weights.sum(axis=1)
        dilatation = np.einsum("mq,mqab->mab", weights / area[:, None], gauss)[:, None]
        weights = area[:, None]
    return stiffness, np.ascontiguousarray(dilatation), np.ascontiguousarray(gauss), weights


@lru_cache(maxsize=64)
def _remembered_tables(corners, element):
    return _element_tables(np.frombuffer(corners).reshape(1, 4, 2), element)


@njit(cache=True, nogil=True)
def _assemble_constant(pattern, constant, pressure, place, cells, kind, stiffness, edges):
    """Blocks of k (stiffness of μ/2 F:F) and of H (second derivative of the cavity's area), and where they belong."""
    for e in range(len(cells)):
        for a in range(4):
            for b in range(a + 1):
                i, j = cells[e, a], cells[e, b]
                if i >= 0 and j >= 0:
                    place[e, a, b] = k = _sparse.block_number(pattern, max(i, j), min(i, j))
                    constant[k, 0] += stiffness[kind[e], a, b]
                    constant[k, 3] += stiffness[kind[e], a, b]
    for edge in edges:  # A = ½ Σ (x_i y_j − x_j y_i)
        i, j = edge
        if i >= 0 and j >= 0:
            k = _sparse.block_number(pattern, max(i, j), min(i, j))
            half = 0.5 if i > j else -0.5
            pressure[k, 1] += half
            pressure[k, 2] -= half


@njit(cache=True, nogil=True)
def _gather(x, cells, fixed, out):
    """Deformed corners (m, 4, 2) of each element, seen from its first one: small numbers, so that little is rounded."""
    for e in range(len(cells)):
        for d in range(2):
            i = cells[e, 0]
            start = x[2 * i + d] if i >= 0 else fixed[e, 0, d]
            for a in range(cells.shape[1]):
                i = cells[e, a]
                out[e, a, d] = (x[2 * i + d] if i >= 0 else fixed[e, a, d]) - start


@njit(cache=True, nogil=True, fastmath={"contract"})
def _dilatations(points, corners, kind, dilatation, J, c):
    """J (m, d) and its gradient c (m, d, 4, 2) with respect to the corners, of which the first is the origin."""
    for e in range(len(corners)):
        for q in range(len(points)):
            G, value = dilatation[kind[e], q], 0.0
            for a in range(4):
                cx = cy = 0.0
                for b in range(1, 4):
                    cx += G[a, b] * corners[e, b, 1]
                    cy -= G[a, b] * corners[e, b, 0]  # G is antisymmetric
                c[e, q, a, 0], c[e, q, a, 1] = cx, cy
                value += corners[e, a, 0] * cx
            J[e, q] = value


@njit(cache=True, nogil=True)
def _turned_over(corners, kind, gauss):
    """Whether J ≤ 0 at a Gauss point, which a mean over the element does not show."""
    for e in range(len(corners)):
        for q in range(4):
            G, J = gauss[kind[e], q], 0.0
            for a in range(4):
                for b in range(1, 4):
                    J += corners[e, a, 0] * G[a, b] * corners[e, b, 1]
            if not J > 0.0:
                return True
    return False


@njit(cache=True, nogil=True, fastmath={"contract"})
def _along_step(points, moves, kind, dilatation, c, slope, bend):
    """The coefficients of J(s) = J + s·slope + s²·bend along a step, (m, d) each, from its moves of the corners."""
    for e in range(len(moves)):
        for q in range(len(points)):
            G, linear, quadratic = dilatation[kind[e], q], 0.0, 0.0
            for a in range(4):
                cx = 0.0
                for b in range(1, 4):
                    cx += G[a, b] * moves[e, b, 1]
                linear += c[e, q, a, 0] * moves[e, a, 0] + c[e, q, a, 1] * moves[e, a, 1]
                quadratic += moves[e, a, 0] * cx
            slope[e, q], bend[e, q] = linear, quadratic


@njit(cache=True, nogil=True, fastmath={"contract"})
def _residual(points, corners, cells, kind, stiffness, weights, J, log_j, c, edges, edge_corners, lam, mu, p, r):
    """Gradient of the potential, r = k x + Σ w φ′ c − p ∂A/∂x."""
    r[:] = 0.0
    for k in range(len(edges)):
        dx, dy = edge_corners[k, 1, 0] - edge_corners[k, 0, 0], edge_corners[k, 1, 1] - edge_corners[k, 0, 1]
        for end in range(2):
            node = edges[k, end]
            if node >= 0:
                r[2 * node] -= 0.5 * p * dy
                r[2 * node + 1] += 0.5 * p * dx
    slope = np.empty(len(points))
    for e in range(len(cells)):
        for q in range(len(points)):
            slope[q] = weights[kind[e], q] * (lam * log_j[e, q] - mu) / J[e, q]
        for a in range(4):
            i = cells[e, a]
            if i >= 0:
                fx = fy = 0.0
                for b in range(1, 4):
                    k_ab = stiffness[kind[e], a, b]
                    fx += k_ab * corners[e, b, 0]
                    fy += k_ab * corners[e, b, 1]
                for q in range(len(points)):
                    fx += slope[q] * c[e, q, a, 0]
                    fy += slope[q] * c[e, q, a, 1]
                r[2 * i] += fx
                r[2 * i + 1] += fy


@njit(cache=True, nogil=True, fastmath={"contract"})
def _tangent(points, blocks, constant, pressure, cells, kind, dilatation, weights, place, J, c, pi, theta, lam, mu, p):
    """Blocks of the tangent; `pi` stands for λ ln J and is blended with μ by `theta` (θ = 0: convex but for −p H)."""
    for k in range(len(blocks)):
        for d in range(4):
            blocks[k, d] = constant[k, d] - p * pressure[k, d]
    slope, curvature = np.empty(len(points)), np.empty(len(points))
    for e in range(len(cells)):
        for q in range(len(points)):
            w, j, blended = weights[kind[e], q], J[e, q], mu + theta * (pi[e, q] - mu)
            slope[q] = w * (blended - mu) / j  # w φ′
            curvature[q] = w * (lam - blended + mu) / (j * j)  # w φ″
        for a in range(4):
            for b in range(a + 1):
                k = place[e, a, b]
                if k < 0:
                    continue
                xx = xy = yx = yy = 0.0
                for q in range(len(points)):
                    gx, gy = curvature[q] * c[e, q, a, 0], curvature[q] * c[e, q, a, 1]
                    bx, by, g = c[e, q, b, 0], c[e, q, b, 1], slope[q] * dilatation[kind[e], q, a, b]
                    xx += gx * bx
                    xy += gx * by + g
                    yx += gy * bx - g
                    yy += gy * by
                if cells[e, a] < cells[e, b]:
                    xy, yx = yx, xy  # only the lower triangle is kept
                blocks[k, 0] += xx
                blocks[k, 1] += xy
                blocks[k, 2] += yx
                blocks[k, 3] += yy


@njit(cache=True, nogil=True)
def _pin(pattern, pinned, blocks):
    """Hold single unknowns: their rows and columns become those of the identity."""
    n_lower = len(pattern.rows)
    for column in range(len(pinned)):
        for k in range(pattern.column_start[column], pattern.column_start[column + 1]):
            row = pattern.rows[k]
            for d in range(4):
                if pinned[row, d // 2] or pinned[column, d % 2]:
                    blocks[k, d] = 0.0
        for d in range(4):
            if pinned[column, d // 2] or pinned[column, d % 2]:
                blocks[n_lower + column, d] = 1.0 if d in (0, 3) else 0.0


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
    points, pattern, x0, cells, fixed, kind, stiffness, dilatation, weights, gauss, place, edges, edges_fixed,
    constant, pressure, pinned, lam, mu, pressures, allowed,
):  # fmt: skip
    """Follow the equilibrium through the load steps.

    Newton's method on Π, with two changes to the tangent. Mixed integration points (Magisano et al. 2017): λ ln J is
    replaced by its linear extrapolation from the last iterate. And once the moves are shorter than REUSE, a factorised
    tangent is used again as long as that shrinks the next move to a tenth or less, which makes the first move under a
    new pressure Euler's predictor. The residual, and so the solution, is that of Π. A load step that fails is
    approached in halves. After `allowed` factorisations it gives up, so that every structure ends in bounded time.

    Returns positions (steps, 2 free), the number of load steps reached, the number of factorisations, and whether the
    next load step was not reached because an element turned over.
    """
    m, d, n = len(cells), len(points), len(x0) // 2
    corners, moves = np.empty((m, 4, 2)), np.empty((m, 4, 2))
    edge_corners, no_edges_move = np.empty((len(edges), 2, 2)), np.zeros((m, 4, 2))
    J, log_j, c, pi = np.empty((m, d)), np.empty((m, d)), np.empty((m, d, 4, 2)), np.empty((m, d))
    slope, bend = np.empty((m, d)), np.empty((m, d))
    step, blocks, inverses = np.empty(2 * n), np.empty(constant.shape), np.empty((n, 4))

    positions = np.empty((len(pressures), 2 * n))
    x, last_pressure, factorisations, factorised = x0.copy(), 0.0, 0, False
    for target in range(len(pressures)):
        p, halvings = pressures[target], 0
        while True:  # sub-steps from last_pressure to pressures[target]
            trial, converged, last_length = x.copy(), False, 0.0
            for iteration in range(MAX_ITERATIONS):
                _gather(trial, cells, fixed, corners)
                _gather(trial, edges, edges_fixed, edge_corners)
                _dilatations(points, corners, kind, dilatation, J, c)
                for e in range(m):
                    for q in range(len(points)):
                        log_j[e, q] = np.log(J[e, q])
                        if iteration == 0:
                            pi[e, q] = lam * log_j[e, q]
                _residual(
                    points, corners, cells, kind, stiffness, weights, J, log_j, c, edges, edge_corners, lam, mu, p, step
                )  # fmt: skip
                theta, fresh = 1.0, not factorised
                while not factorised:
                    if factorisations >= allowed:
                        return positions, target, factorisations, False
                    _tangent(
                        points, blocks, constant, pressure, cells, kind, dilatation, weights, place, J, c, pi, theta,
                        lam, mu, p,
                    )  # fmt: skip
                    _pin(pattern, pinned, blocks)
                    factorisations += 1
                    factorised = _sparse.factorise(pattern, blocks, inverses) == n
                    if not factorised:
                        if theta == 0.0:
                            break
                        theta = 0.5 * theta if theta > 0.25 else 0.0
                if not factorised:
                    break
                for i in range(len(pinned)):
                    for k in range(2):
                        if pinned[i, k]:
                            step[2 * i + k] = 0.0
                _sparse.solve(pattern, blocks, inverses, step)
                step *= -1.0
                length = np.max(np.abs(step))  # NaN where there is one
                if not np.isfinite(length):
                    break
                s = 1.0
                if length > REUSE:  # shorter moves turn no element inside out, and are the last but a few
                    _gather(step, cells, no_edges_move, moves)
                    _along_step(points, moves, kind, dilatation, c, slope, bend)
                    s = _largest_step(J, slope, bend, min(1.0, MAX_MOVE / max(length, MAX_MOVE)))
                    for e in range(m):
                        for q in range(len(points)):
                            pi[e, q] = lam * (log_j[e, q] + s * slope[e, q] / J[e, q])
                for i in range(2 * n):
                    trial[i] += s * step[i]
                shrinkage = length / last_length if last_length > 0.0 else 1.0
                whole = s == 1.0 and theta == 1.0  # θ = 1: positive definite, so stable
                stalled = fresh and length <= ROUNDED and shrinkage > 0.5
                if whole and (length <= TOLERANCE or stalled):
                    converged = True
                    break
                factorised = whole and length <= REUSE and shrinkage <= 0.1
                last_length = length
            if converged:
                x, last_pressure = trial, p
                if p == pressures[target]:
                    break
                p = pressures[target]
            else:
                factorised, halvings = False, halvings + 1
                if halvings > MAX_HALVINGS:
                    return positions, target, factorisations, False
                p = 0.5 * (last_pressure + p)
        _gather(x, cells, fixed, corners)
        if _turned_over(corners, kind, gauss):
            return positions, target, factorisations, True
        positions[target] = x
    return positions, len(pressures), factorisations, False
