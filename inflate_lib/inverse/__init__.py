"""Inverse design for targets of one's own: search, refinement, constraints, and the files of a design."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.inverse.adjoint import sensitivities
    from inflate_lib.inverse.constraints import Constraints
    from inflate_lib.inverse.drawings import read_outline
    from inflate_lib.inverse.save import save_designs
    from inflate_lib.inverse.search import Design, Designs, choose, design
    from inflate_lib.inverse.targets import Targets, read_targets

__all__ = [
    "Constraints",
    "Design",
    "Designs",
    "Targets",
    "choose",
    "design",
    "read_outline",
    "read_targets",
    "save_designs",
    "sensitivities",
]
__getattr__, __dir__ = attach(__name__, __file__)
