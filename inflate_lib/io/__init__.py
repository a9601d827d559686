"""Pictures in; pictures, ParaView series and MOOSE cases out."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "pictures": ["read_images", "write_animation", "write_picture"],
        "vtk": ["write_vtk"],
        "moose": ["run_case", "write_case"],
    },
)
