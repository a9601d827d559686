"""Can a structure be built? The simulation does not ask: it knows no contact, and joints of one node hold in it.

A structure is *buildable* if

- it finds an equilibrium at every load step,
- its wall is in one piece,
- and nowhere holds together in a single node, through which no force can pass in a continuum,
- and no wall crosses a wall at any load step.

What happens between two load steps is not looked at; more load steps see more.
"""

from enum import StrEnum

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from inflate_lib.mechanics.contact import first_crossing
from inflate_lib.mechanics.inflation import Inflation
from inflate_lib.mechanics.mesh import boundary_edges


class Flaw(StrEnum):
    """Why a structure cannot be built."""

    NO_STRUCTURE = "The image holds no structure."
    NO_EQUILIBRIUM = "No equilibrium was found at one of the load steps."
    IN_PIECES = "The wall is in several pieces."
    POINT_JOINT = "Parts of the wall hold together in a single node."
    CROSSING_WALLS = "Walls cross at one of the load steps."


def find_flaw(result: Inflation) -> Flaw | None:
    """Why an inflated structure cannot be built, or None where it can be.

    Parameters
    ----------
    result : Inflation

    Returns
    -------
    Flaw or None
        Of several flaws the first, in the order of :class:`Flaw`; an inflation is never without a structure.
    """
    if not result.converged:
        return Flaw.NO_EQUILIBRIUM
    if _pieces(result.cells, len(result.nodes)) > 1:
        return Flaw.IN_PIECES
    edges = boundary_edges(result.cells)
    if np.bincount(edges.ravel()).max() > 2:  # the border passes through a node twice
        return Flaw.POINT_JOINT
    if first_crossing(result.nodes + result.displacement, edges) >= 0:
        return Flaw.CROSSING_WALLS
    return None


def _pieces(cells, n_nodes):
    """Number of sets of quadrilaterals that have no node in common."""
    first, others = np.repeat(cells[:, 0], 3), cells[:, 1:].ravel()
    joined = csr_array((np.ones(len(first)), (first, others)), shape=(n_nodes, n_nodes))
    return connected_components(joined, directed=False, return_labels=False)
