"""What to tell a model so that it draws what is wanted.

A conditional model answers a descriptor y with structures whose own descriptors scatter around some g(y), not around
y: a model that was trained briefly answers too near the average, one that is guided strongly (w > 1) exaggerates. Both
are smooth and can be measured: ask for the descriptors of a few hundred training structures, inflate what is drawn, and
fit a linear g by least squares. To get c, the model is then told g⁻¹(c). Held-out structures play no part in it.

Guidance narrows the scatter around g at the price of exaggeration; calibration takes the exaggeration back.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

_VARIANCE = 0.99  # share of the descriptors' variance in the directions in which a model is calibrated
_LEAST_SLOPE = 0.5  # below it, inverting g more than doubles what is asked for, far outside the data


@dataclass(frozen=True)
class Calibration:
    """The fit of g: in the coordinates z = D (y − m), g(z) = o + S z. Directions across D are left alone.

    Scalars and boxes have as many coordinates as components. An axis has 60 components that move together; its
    coordinates are the few principal directions D (k, N) of the training axes.
    """

    mean: np.ndarray  # m (N,), in the descriptor's unit
    directions: np.ndarray  # D (k, N), orthonormal rows
    offset: np.ndarray  # o (k,)
    slope: np.ndarray  # S (k, k)

    @classmethod
    def fit(cls, targets: np.ndarray, achieved: np.ndarray) -> "Calibration":
        """Fit g to what was asked for and what was achieved, (n, N) each, all finite.

        Directions of little variance, in which a model may hardly follow at all, are left out one by one until g can be
        inverted safely.

        Raises
        ------
        ValueError
            Fewer structures than the fit has unknowns, or no direction is left: the model does not listen.
        """
        targets, achieved = np.asarray(targets, dtype=float), np.asarray(achieved, dtype=float)
        mean = targets.mean(axis=0)
        _, spread, directions = np.linalg.svd(targets - mean, full_matrices=False)
        share = np.cumsum(spread**2) / max(np.sum(spread**2), np.finfo(float).tiny)
        most = targets.shape[1] if targets.shape[1] <= 2 else int(np.searchsorted(share, _VARIANCE)) + 1
        if len(targets) <= most + 1:
            raise ValueError(f"a calibration in {most} directions needs more than {len(targets)} structures")
        for k in range(most, 0, -1):
            chosen = directions[:k]
            asked, got = (targets - mean) @ chosen.T, (achieved - mean) @ chosen.T
            coefficients = np.linalg.lstsq(np.c_[np.ones(len(asked)), asked], got, rcond=None)[0]
            offset, slope = coefficients[0], coefficients[1:].T
            weakest = np.linalg.svd(slope, compute_uv=False).min()
            if weakest >= _LEAST_SLOPE:
                return cls(mean, chosen, offset, slope)
        raise ValueError(
            f"the model hardly follows its descriptor (slope {weakest:.2f} of achieved on wanted): train it longer, "
            "or do without calibration"
        )

    def as_dict(self) -> dict:
        """Plain numbers, for the header of a file of weights."""
        return {name: value.tolist() for name, value in vars(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping) -> "Calibration":
        """The reverse of :meth:`as_dict`; what else `values` say, such as how the fit was made, is passed over."""
        return cls(*(np.array(values[field.name], dtype=float) for field in fields(cls)))

    def answer(self, told: np.ndarray) -> np.ndarray:
        """g: what the model draws on average when it is told ``told`` (n, N)."""
        told = np.asarray(told, dtype=float)
        z = (told - self.mean) @ self.directions.T
        return told + (z @ self.slope.T + self.offset - z) @ self.directions

    def told(self, targets: np.ndarray) -> np.ndarray:
        """What to tell the model, (n, N), to get ``targets`` (n, N)."""
        targets = np.asarray(targets, dtype=float)
        z = (targets - self.mean) @ self.directions.T
        told = np.linalg.solve(self.slope, (z - self.offset).T).T
        return targets + (told - z) @ self.directions
