"""From a structure to its inflated shape (paper sec. 3): mesh, equilibrium, stress, contact, sensitivities."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "mesh": ["build_mesh", "Mesh"],
        "inflation": ["inflate", "Inflation"],
        "contact": ["first_contact", "self_contact"],
        "stress": ["cauchy_stress", "largest_stretch", "peaks", "von_mises"],
        "adjoint": ["sensitivities"],
    },
)
