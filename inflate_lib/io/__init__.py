"""Pictures in; pictures, ParaView series and MOOSE cases out."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.io.moose import run_case, write_case
    from inflate_lib.io.pictures import read_images, write_animation, write_picture
    from inflate_lib.io.vtk import write_vtk

__all__ = ["read_images", "run_case", "write_animation", "write_case", "write_picture", "write_vtk"]
__getattr__, __dir__ = attach(__name__, __file__)
