"""Contact: walls that pass through one another, and a barrier that does not let them.

The paper's simulation has no contact: walls that meet do not notice. Whether they did is a matter of geometry. The
boundary of the wall consists of the edges that belong to one element only; where two of them that share no node cross,
wall lies upon wall (:func:`self_contact`). Nothing can lie upon something else unseen, one wall wholly within another,
say: as long as no element is turned over, a place that is covered twice lies behind a border that crosses a border.

With ``inflate(label, contact=True)`` walls push one another away, without friction. Each boundary node i, which stands
for half of the undeformed length of its two edges, ℓ_i, has a potential before each edge e that it is no end of, which
is zero but where the two are nearer than a gap g:

    Π_c = ½ κ Σ_i ℓ_i Σ_e [ b(d(i, e)) − ½ b(d(i, j_e)) − ½ b(d(i, k_e)) ],   b(d) = −g (1 − d/g)² ln(d/g).

b is that of incremental potential contact (Li et al. 2020): twice continuously differentiable, and infinite at d = 0,
so that no wall can be passed through. j_e and k_e are the ends of e; their terms take away what the two edges that meet
in a node count twice, so that along a straight wall the sum is b(distance from the wall) however it is divided (Li et
al. 2023), and a node slides from one edge to the next without a kink. Walls in contact are thus apart by a share of g,
press on one another with −κ b′, and the answer for walls that touch is the limit g → 0; κ hardly matters.

Π_c is added to the potential of :mod:`inflate_lib.mechanics.inflation`: equilibria stay its minima, the tangent stays
symmetric. Where nothing comes near, nothing is added. An inflation is therefore followed without the barrier until
walls come near one another, and with it from the load step before. The same Newton method then also shortens each step
so that no node goes through an edge on its way, and the pattern of the tangent couples nodes and edges that are near.
Which these can be is looked up again only when the nodes have moved by half a gap.
"""

from typing import TYPE_CHECKING

import numpy as np

from inflate_lib.mechanics import _barrier, _kernels
from inflate_lib.mechanics.mesh import boundary_edges

if TYPE_CHECKING:
    from inflate_lib.mechanics.inflation import Inflation

GAP = 0.1  # at which walls begin to push, in lengths of the shortest edge of the boundary: a tenth of a pixel
STIFFNESS = 0.1  # κ, in units of μ: the pressure between walls that are about half a gap apart
_PATIENCE = 100  # factorisations before a stronger push is tried
_PUSHES = 0.0, 0.01, 0.1, 0.3  # at random, in gaps, that a load step which fails begins with
_COUPLED = 5.0  # gaps within which the pattern couples nodes and edges, so that it is seldom made anew


def self_contact(result: "Inflation", step: int = -1) -> int:
    """Number of pairs of boundary edges that cross one another in the deformed structure.

    Edges that share a node are left out, and so are edges that merely touch (an end of one lies on the other, or they
    lie along one another). Where two walls cross, there are at least two such pairs.

    Parameters
    ----------
    result : Inflation
    step : int
        Load step, the last one by default.

    Returns
    -------
    int
        0 where no wall crosses a wall, and also at a load step without an equilibrium.
    """
    return len(crossing_edges(result, step))


def first_contact(result: "Inflation") -> int | None:
    """Index of the first load step at which walls cross one another, or None where they never do.

    Every load step is looked at, since walls may cross and part again, and none of the states between two of them.
    """
    step = first_crossing(result.nodes + result.displacement, boundary_edges(result.cells))
    return None if step < 0 else step


def crossing_edges(result, step=-1):
    """The pairs behind :func:`self_contact`, (k, 2, 2) int: pair, edge, node numbers of its two ends."""
    edges = boundary_edges(result.cells)
    pairs = _barrier.crossings(result.deformed(step), edges, np.arange(len(edges)))
    return edges[pairs[np.lexsort(pairs.T[::-1])]]


def first_crossing(positions, edges):
    """Index of the first of several states, positions (states, n, 2), in which edges (k, 2) cross; -1 for none."""
    return _barrier.first_touch(positions, edges, 0.0)


def contact_forces(result: "Inflation", step: int = -1) -> np.ndarray:
    """Forces by which walls push one another away, in the unit of pressure times the frame's side.

    Parameters
    ----------
    result : Inflation
    step : int
        Load step, the last one by default.

    Returns
    -------
    (n, 2) float
        Force on each node; zero where the result is one without contact. Their sum and their moment are zero.
    """
    positions = result.deformed(step)
    if not result.gap or not np.isfinite(positions).all():
        return np.zeros_like(positions)
    walls = walls_of(result.mesh, result.gap, result.lame[1])
    walls.x[:] = positions
    return -_barrier.forces(walls, _barrier.near_edges(walls.x, walls.edges, walls.gap, walls.sweep))


def walls_of(mesh, gap, mu):
    """The walls of a mesh, to be kept apart.

    Parameters
    ----------
    mesh : Mesh
    gap : float or None
        Distance at which the barrier begins; a share `GAP` of the shortest edge of the boundary where it is None.
    mu : float
        Shear modulus.

    Returns
    -------
    Walls
    """
    edges = boundary_edges(mesh.cells)
    length = np.hypot(*(mesh.nodes[edges[:, 1]] - mesh.nodes[edges[:, 0]]).T)
    gap = GAP * length.min() if gap is None else gap
    nodes, number = mesh.nodes.copy(), np.full(len(mesh.nodes), -1)
    weights = 0.25 * STIFFNESS * mu * np.mean(mesh.stiffness) * length  # κ hardly matters: one for all rubbers
    return _barrier.Walls(edges, weights, gap, number, nodes, np.zeros_like(nodes), np.arange(len(edges)))


def coupled_system(build, walls, positions, couplings=()):
    """A system whose pattern couples the nodes and edges that are near at some positions, and those `couplings`.

    Parameters
    ----------
    build : callable
        ``build(couplings)`` → System, :func:`inflate_lib.mechanics.inflation.build_system` of a mesh.
    walls : Walls
        Gets the numbers that the nodes have in this system.
    positions : (n, 2) float
    couplings : (c, 4) int

    Returns
    -------
    System
    (c, 4) int
        All that is coupled.
    """
    near = _barrier.near_edges(positions, walls.edges, _COUPLED * walls.gap, walls.sweep)
    near[:, 3] = near[:, 0]  # three nodes, as elements of the pattern
    couplings = np.concatenate([np.reshape(couplings, (-1, 4)).astype(np.int64), near])
    system = build(couplings)
    walls.number[system.order] = np.arange(len(system.order))
    return system, couplings


def keep_apart(system, build, walls, pressures, allowed):
    """Follow an inflation, from where walls come near one another on with the barrier between them.

    Parameters
    ----------
    system : System
        That of the mesh, without walls.
    build : callable
        As for :func:`coupled_system`.
    walls : Walls
        As :func:`walls_of` gives them, at rest.
    pressures : (steps,) float
    allowed : int
        Factorisations.

    Returns
    -------
    positions : (reached, n, 2) float
    factorisations : int
    why : int
        Why no more load steps were reached, as ``_kernels.march`` says it.

    Raises
    ------
    ValueError
        Where walls are nearer than the gap before they are inflated.
    """
    rest = walls.x.copy()
    if _barrier.come_near(rest, walls.edges, walls.gap, walls.sweep):
        raise ValueError(f"contact: walls are nearer than the gap of {walls.gap:.3g} before they are inflated")
    found, pressures = rest[None], np.array([0.0, *pressures])
    couplings, factorisations, why, tries = None, 0, 0, 0
    while len(found) < len(pressures) and factorisations < allowed and tries < len(_PUSHES):
        at, walls.x[:], acting = len(found), rest, couplings is not None
        # Where a node is exactly before a node, as in symmetric structures, it is on a ridge: pushed, it finds a side.
        push = walls.gap * np.random.default_rng(0).uniform(-1, 1, rest.shape) if tries else 0.0
        moved, reached, spent, why = _kernels.march(
            system, _kernels.State.of(system), pressures[at:],
            min(allowed - factorisations, _PATIENCE) if acting else allowed, walls, acting,
            (found[-1] + _PUSHES[tries] * push)[system.order].ravel(), pressures[at - 1],
        )  # fmt: skip
        more = np.repeat(found[-1:], reached + 1, axis=0)
        more[:, system.order] = moved[[*range(reached), -1]].reshape(reached + 1, -1, 2)
        found, near, factorisations = np.concatenate([found, more[:-1]]), more[-1], factorisations + spent
        if why != _kernels.UNCOUPLED:
            near, tries = found[-1], (tries + 1 if not reached else 1) if acting else 0
        if len(found) < len(pressures):
            system, couplings = coupled_system(build, walls, near, () if couplings is None else couplings)
    return found[1:], factorisations, why
