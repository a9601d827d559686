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
locks, because λ/μ = 100) or once per element as its mean (``"mean-dilatation"``, the default, which does not). MOOSE's
element, which has no potential, is in :mod:`inflate_lib.alternatives.stabilised`.
"""

import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from inflate_lib._checks import choice, numbers, positive_number, whole_number
from inflate_lib.mechanics import _barrier, _kernels, material
from inflate_lib.mechanics.contact import coupled_system, keep_apart, walls_of
from inflate_lib.mechanics.material import LAMBDA, MU
from inflate_lib.mechanics.mesh import Mesh, build_mesh, check_mesh

PRESSURE = 0.01  # internal pressure at t = 1: p(t) = PRESSURE · t
ELEMENTS = ("mean-dilatation", "q1")
MAX_STEPS = 10_000  # load steps
MAX_HALVINGS = _kernels.MAX_HALVINGS  # of a load step that does not converge

_FACTORISATIONS = 1000, 100  # allowed in all, or per load step if that is more; MNIST's sevens take at most 228 in ten
_SPEED = 1.25e9  # multiply-adds per second of the nominal core that turns a time limit into a number of factorisations
_ASSEMBLY = 300  # multiply-adds per element and factorisation

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
        Lamé parameters (λ, μ), which ``mesh.stiffness`` multiplies in each element.
    gap : float
        Distance at which walls begin to push one another away; 0 without contact.
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
    gap: float = 0.0

    @property
    def nodes(self) -> np.ndarray:
        """(n, 2) undeformed coordinates."""
        return self.mesh.nodes

    @property
    def cells(self) -> np.ndarray:
        """(m, 4) node numbers of the quadrilaterals."""
        return self.mesh.cells

    def deformed(self, step: int = -1) -> np.ndarray:
        """(n, 2) deformed coordinates at a load step (the last one by default)."""
        n_steps = len(self.displacement)
        return self.nodes + self.displacement[whole_number("step", step, -n_steps, n_steps - 1)]

    @cached_property
    def deformation_gradient(self) -> np.ndarray:
        """(steps, m, 4, 2, 2) deformation gradient F at the Gauss points of each element."""
        gradients, _ = shape_gradients(self.nodes[self.cells])
        positions = (self.nodes + self.displacement)[:, self.cells]
        return np.einsum("smai,mqaj->smqij", positions, gradients)

    @property
    def stiffness(self) -> np.ndarray:
        """(m, 1) or (1, 1), for the Gauss points of each element: what λ and μ are multiplied by there."""
        return np.reshape(self.mesh.stiffness, (-1, 1))

    @cached_property
    def stretch_across(self) -> np.ndarray:
        """(steps, m, 4) stretch F₃₃ across the plane at the Gauss points: 1, but for MOOSE's element."""
        return np.ones(self.deformation_gradient.shape[:-2])

    @cached_property
    def first_piola_kirchhoff(self) -> np.ndarray:
        """(steps, m, 4, 2, 2) in-plane first Piola–Kirchhoff stress P at the Gauss points, in units of μ and λ.

        With mean dilatation the part φ′(J) cof F takes the element's mean J, as the equilibrium does.
        """
        F, J = self.deformation_gradient, None
        if self.element == "mean-dilatation":
            _, weights = shape_gradients(self.nodes[self.cells])
            J = F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
            J = np.broadcast_to(np.average(J, axis=-1, weights=np.broadcast_to(weights, J.shape))[..., None], J.shape)
        return self.stiffness[:, None, None] * material.first_piola_kirchhoff(F, self.lame, J)


def inflate(
    label: np.ndarray,
    n_steps: int | None = None,
    element: str = "mean-dilatation",
    refine: int = 1,
    pressure: float | Sequence[float] = PRESSURE,
    lame: tuple[float, float] = (LAMBDA, MU),
    clamped: str = "bottom",
    time_limit: float | None = None,
    contact: bool | float = False,
    stiffness: np.ndarray | None = None,
) -> Inflation:
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
        Seconds after which to give up, counted on a nominal core of `_SPEED`: it becomes a number of factorisations,
        from the size of the mesh, so that the outcome depends neither on the machine nor on its load.
    contact : bool or float
        Whether walls push one another away, without friction (:mod:`inflate_lib.mechanics.contact`), or pass through
        one another, as in the paper. A number is the gap at which they begin to, in lengths of the unit square; True
        takes a tenth of the shortest edge, which is a tenth of a pixel without refinement.
    stiffness : (s, s) array_like, optional
        Walls of several rubbers: what λ and μ are multiplied by in each pixel of the label image. Only pixels of the
        wall are looked at. A mesh has its own.

    Returns
    -------
    Inflation
        ``converged`` says whether equilibrium was found at every load step; if not, ``reason`` says where it failed.

    Raises
    ------
    ValueError
        For a label image that cannot be inflated (see :func:`inflate_lib.mechanics.mesh.build_mesh`) and for
        parameters out of range.
    """
    choice("element", element, ELEMENTS)
    times, pressures = load_history(pressure, n_steps)
    lam, mu = check_lame(lame)
    whole_number("refine", refine, 1)
    if time_limit is not None:
        positive_number("time_limit", time_limit, "seconds")
    if contact is not False:
        gap = None if contact is True else positive_number("contact", contact, "lengths of the unit square, or a bool")
    if isinstance(label, Mesh) and stiffness is not None:
        raise ValueError("stiffness: a mesh has its own, one number for each of its cells; leave the argument out")
    mesh = check_mesh(label) if isinstance(label, Mesh) else build_mesh(label, refine, clamped, stiffness)

    system = build_system(mesh, element, (lam, mu))
    n_steps = len(pressures)
    allowed, limit = max(_FACTORISATIONS[0], _FACTORISATIONS[1] * n_steps), ""
    if time_limit is not None and time_limit < allowed * nominal_seconds(system):
        allowed, limit = int(time_limit / nominal_seconds(system)), f", the time limit of {time_limit:g} s"
    displacement = np.full((n_steps, *mesh.nodes.shape), np.nan)
    if contact is False:
        walls = None
        positions, reached, factorisations, why = _kernels.march(
            system, _kernels.State.of(system), pressures, allowed, None, False, system.x0, 0.0
        )
        displacement[:reached] = 0.0
        free_positions = positions[:reached].reshape(reached, len(system.order), 2)
        displacement[:reached, system.order] = free_positions - mesh.nodes[system.order]
    else:
        walls, build = walls_of(mesh, gap, mu), partial(build_system, mesh, element, (lam, mu))
        positions, factorisations, why = keep_apart(system, build, walls, pressures, allowed)
        reached = len(positions)
        displacement[:reached] = positions - mesh.nodes
    reason = ""
    if reached < n_steps:
        reason = f"no equilibrium was found at load step {reached + 1} of {n_steps} (pressure {pressures[reached]:.4g})"
        if why == _kernels.TURNED_OVER:
            reason += ": an element turns inside out"
        elif factorisations >= allowed:
            reason += f" within {allowed} factorisations{limit}"
    return Inflation(
        mesh, element, times, pressures, displacement, reached == n_steps, reason, int(factorisations), (lam, mu),
        walls.gap if walls else 0.0,
    )  # fmt: skip


def load_history(pressure, n_steps=None):
    """Times t and pressures of the load steps, (steps,) each; `pressure` and `n_steps` are those of :func:`inflate`.

    Raises
    ------
    ValueError
        Where they are no pressure, no history or no number of steps, or contradict each other.
    """
    whole_number("n_steps", n_steps, 1, MAX_STEPS, optional=True)
    wanted = f"a finite number, or a history of 1 to {MAX_STEPS} of them"
    pressures = numbers("pressure", pressure, wanted)
    if pressures.ndim > 1 or not 1 <= pressures.size <= MAX_STEPS:
        raise ValueError(f"pressure must be {wanted}, not {reprlib.repr(pressure)}")
    is_history = pressures.ndim == 1
    if is_history and n_steps not in (None, pressures.size):
        raise ValueError(f"n_steps is {n_steps}, but the pressure history has {pressures.size} entries: leave it out")
    n_steps = pressures.size if is_history else n_steps or 10
    times = np.arange(1, n_steps + 1) / n_steps
    return times, pressures if is_history else float(pressures) * times


def nominal_seconds(system):
    """Seconds that one factorisation of a system's tangent, assembled and used, takes on the nominal core."""
    return (system.pattern.multiplications + _ASSEMBLY * len(system.cells)) / _SPEED


def check_lame(lame):
    """(λ, μ) as two floats, or a ValueError where `lame` is not two positive numbers."""
    wanted = "two positive numbers (λ, μ)"
    lam, mu = numbers("lame", lame, wanted, 2).tolist()
    if lam <= 0 or mu <= 0:
        raise ValueError(f"lame must be {wanted}, not {lame!r}")
    return lam, mu


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


def build_system(mesh, element="mean-dilatation", lame=(LAMBDA, MU), couplings=None):
    """Everything about a mesh and its material that an inflation does not change: a :class:`_kernels.System`.

    Parameters
    ----------
    mesh : Mesh
    element : {"mean-dilatation", "q1"}
    lame : (float, float)
        Lamé parameters (λ, μ).
    couplings : (c, 4) int, optional
        Nodes that the pattern couples besides those of an element.

    Returns
    -------
    System
        Free nodes are numbered in the order of elimination: number i is node ``order[i]`` of the mesh.
    """
    choice("element", element, ELEMENTS)
    lam, mu = lame
    held = np.broadcast_to(np.reshape(mesh.clamped, (len(mesh.nodes), -1)), mesh.nodes.shape)  # (n,) or (n, 2)
    free = np.flatnonzero(~held.all(axis=1))
    number = np.full(len(mesh.nodes), -1)
    number[free] = np.arange(len(free))
    coupled = mesh.cells if couplings is None else np.concatenate([mesh.cells, couplings])
    pattern = _kernels.pattern(len(free), number[coupled])
    order = free[pattern.order]
    number[order] = np.arange(len(free))
    cells, edges = number[mesh.cells], number[mesh.pressure_edges]

    corners = mesh.nodes[mesh.cells]
    relative = corners - corners[:, :1]
    congruent = np.abs(relative - relative[:1]).max() <= 1e-12 * np.abs(relative[:1]).max()
    # One row for congruent elements; rounded, so that it is the same for all meshes of the same pixels.
    shapes = np.round(relative[:1], 15) if congruent else relative
    tables = _remembered_tables(shapes.tobytes(), element) if congruent else _element_tables(shapes, element)
    kind = np.zeros(len(cells), dtype=np.int64) if congruent else np.arange(len(cells))
    rubbers = np.reshape(mesh.stiffness, (-1, 1, 1))
    if congruent and len(rubbers) > 1:  # a row for each rubber
        rubbers, kind = np.unique(mesh.stiffness, return_inverse=True)
        rubbers, tables = rubbers[:, None, None], [np.repeat(table, len(rubbers), axis=0) for table in tables]
    stiffness, dilatation, gauss, weights = tables
    # k has μ and the weights have φ as a factor: a stiffer element is one that counts more.
    stiffness, weights = mu * rubbers * stiffness, rubbers[:, 0] * weights

    constant, pressure, place = _kernels.assemble_constant(pattern, cells, kind, stiffness, edges)
    pinned = held[order] if held[order].any() else np.zeros((0, 2), dtype=bool)
    return _kernels.System(
        lam, mu, tuple(range(weights.shape[1])), pattern, order, mesh.nodes[order].ravel(), cells, corners, kind,
        stiffness, dilatation, weights, gauss, place, edges, mesh.nodes[mesh.pressure_edges], constant, pressure,
        pinned,
    )  # fmt: skip


def assemble(system, positions, pressure, walls=None):
    """The equilibrium equations at any positions.

    Parameters
    ----------
    system : System
        From :func:`build_system`.
    positions : (n, 2) float
        Deformed coordinates of the nodes of its mesh; those of clamped nodes are not looked at.
    pressure : float
    walls : Walls, optional
        Whose contact is to be counted in, from :func:`inflate_lib.mechanics.contact.walls_of`.

    Returns
    -------
    State
        J and ∂J/∂x of each element, and the residual ∂Π/∂x and tangent ∂²Π/∂x² of the free nodes in the order of
        elimination, the tangent as blocks of the system's pattern.
    """
    state = _kernels.State.of(system)
    _kernels.move_to(system, state, positions[system.order].ravel())
    state.pi[:] = system.lam * state.log_j
    _kernels.tangent(system, state, pressure, 1.0)
    _kernels.residual(system, state, pressure)
    if walls is not None:
        walls.x[:] = positions
        near = _barrier.near_edges(walls.x, walls.edges, walls.gap, walls.sweep)
        _kernels.push(system, state, walls, near)
        _kernels.stiffen(system, state, walls, near, 1.0)
    return state


def solve(system, state, load):
    """Moves of all nodes, (n, 2), under a load (n, 2), by the tangent of a state, which its factor overwrites.

    None where the tangent is not positive definite. Clamped nodes do not move.
    """
    if _kernels.factorise(system.pattern, state.tangent, state.inverses) < len(system.order):
        return None
    free, moves = load[system.order], np.zeros_like(load)
    free[: len(system.pinned)][system.pinned] = 0
    solution = free.ravel()
    _kernels.solve(system.pattern, state.tangent, state.inverses, solution)
    moves[system.order] = solution.reshape(-1, 2)
    return moves


def equilibrium(result, step=-1):
    """The system of a result and, at one of its load steps, the state from :func:`assemble`, contact counted in."""
    build, positions = partial(build_system, result.mesh, result.element, result.lame), result.deformed(step)
    walls = walls_of(result.mesh, result.gap, result.lame[1]) if result.gap else None
    system = coupled_system(build, walls, positions)[0] if walls else build()
    return system, assemble(system, positions, result.pressures[step], walls)


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
