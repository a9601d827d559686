"""Inverse design for targets of one's own: search, refinement, constraints, and the files of a design."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "search": ["choose", "Design", "design", "Designs"],
        "targets": ["read_targets", "Targets"],
        "drawings": ["read_outline"],
        "constraints": ["Constraints"],
        "refine": ["refine"],
        "save": ["save_designs"],
    },
)
