"""Which structures are kept from training: one rule for every model, table and chapter."""

import numpy as np
import xarray as xr

from inflate_lib._checks import whole_number


def held_out(n: int) -> np.ndarray:
    """Which of n structures no model is trained on: every tenth, those with ``index % 10 == 9``.

    The rule looks at the position in the whole data set alone, before structures that did not converge are left out and
    before augmentation, so that no flip or shift of a held-out structure is ever seen in training.

    Returns
    -------
    (n,) bool
    """
    return np.arange(whole_number("n", n, 0)) % 10 == 9


def training_rows(data: xr.Dataset) -> np.ndarray:
    """Row numbers of the structures that models are trained on."""
    return np.flatnonzero(data["converged"].values & ~held_out(data.sizes["structure"]))
