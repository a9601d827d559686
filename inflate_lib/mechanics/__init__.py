"""From a structure to its inflated shape (paper sec. 3): mesh, equilibrium, stress, contact, flaws."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.mechanics.buildable import Flaw, find_flaw
    from inflate_lib.mechanics.contact import first_contact, self_contact
    from inflate_lib.mechanics.inflation import Inflation, inflate
    from inflate_lib.mechanics.mesh import Mesh, build_mesh
    from inflate_lib.mechanics.stress import cauchy_stress, largest_stretch, peaks, von_mises

__all__ = [
    "Flaw",
    "Inflation",
    "Mesh",
    "build_mesh",
    "cauchy_stress",
    "find_flaw",
    "first_contact",
    "inflate",
    "largest_stretch",
    "peaks",
    "self_contact",
    "von_mises",
]
__getattr__, __dir__ = attach(__name__, __file__)
