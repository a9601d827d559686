"""A data set that no simulation has made, for what only asks how it is told apart."""

import numpy as np
import xarray as xr

from inflate_lib.structures.labels import label_image
from inflate_lib.structures.sources import load_sevens


def invented_data():
    """Sixty embedded digits with invented descriptors that are simple functions of the number of the structure."""
    images = load_sevens("digits").images[:60]
    number = np.arange(60.0)
    axes = np.zeros((60, 30, 2))
    axes[:, :, 0] = np.linspace(0, 0.01, 30) * number[:, None]
    axes[:, :, 1] = np.linspace(0, 1, 30)
    return xr.Dataset(
        {
            "image": (("structure", "row", "column"), images),
            "label": (("structure", "row", "column"), np.array([label_image(image) for image in images], np.float32)),
            "converged": ("structure", number != 4),
            "height": ("structure", 1 + number / 60),
            "width": ("structure", 2 - number / 60),
            "hull_area": ("structure", 0.5 + number / 100),
            "medial_axis": (("structure", "point", "axis"), axes),
            "buildable": ("structure", np.ones(60, bool)),
            "flaw": ("structure", np.full(60, "", object)),
        },
        attrs={"source": "digits"},
    )
