"""What to tell a model so that it draws what is wanted.

A conditional model answers a descriptor y with structures whose own descriptors scatter around some g(y), not around
y: a model that was trained briefly answers too near the average, one that is guided strongly (w > 1) exaggerates, and
near the ends of the data otherwise than in the middle. That g is monotone and can be measured: ask for the descriptors
of a few hundred training structures, inflate what is drawn, and fit g. To get c, the model is then told g⁻¹(c).
Held-out structures play no part in it.

Guidance narrows the scatter around g at the price of exaggeration; calibration takes the exaggeration back.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import huber

_VARIANCE = 0.99  # share of the descriptors' variance in the directions in which a model is calibrated
_LEAST_SLOPE = 0.5  # below it, inverting g more than doubles what is asked for, far outside the data
_CORNERS = (0.0, 0.25, 0.75, 1.0)  # quantiles of the answers where g may bend: quarter, half and quarter of them
_FEW = 40  # fewer answers than this do not bend g
_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)  # of a bend that may be kept
_FOLDS = 10  # of the cross-validation that says how much is
_STRAIGHT = [[[0.0, 1.0], [0.0, 1.0]]]  # of all coordinates, no bend
_HUBER = 1.345  # standard deviations beyond which an answer counts less (Huber 1964); 95 % efficient for normal scatter


@dataclass(frozen=True)
class Calibration:
    """The fit of g: in the coordinates z = D (y − m), g(z) = b(o + S z). Directions across D are left alone.

    Scalars and boxes have as many coordinates as components. An axis has 60 components that move together; its
    coordinates are the few principal directions D (k, N) of the training axes. After the straight o + S z, which
    undoes the coupling of the coordinates, b bends each of them by itself: a polygon that rises in every piece, by no
    less than half and no more than twice the straight line, and goes on straight beyond its ends. A few hundred
    scattered answers bend any line a little; only so much of the bend is kept as predicts best the answers to which it
    was not fitted (tenfold cross-validation). So g⁻¹ is there for every target, is unique, and stays sane where the
    data end. (Isotonic regression is monotone as well, but a staircase: it has no inverse on its steps, and beyond its
    ends it stands still.)
    """

    mean: np.ndarray  # m (N,), in the descriptor's unit
    directions: np.ndarray  # D (k, N), orthonormal rows
    offset: np.ndarray  # o (k,)
    slope: np.ndarray  # S (k, k)
    bends: np.ndarray = field(default_factory=lambda: np.array(_STRAIGHT))  # (k, 2, corners): x and b(x)

    @classmethod
    def fit(cls, targets: np.ndarray, achieved: np.ndarray) -> "Calibration":
        """Fit g to what was asked for and what was achieved, (n, N) each, all finite.

        Both fits are robust (Huber's): a broken drawing, which misses by a third, must not pull the line. Directions of
        little variance, in which a model may hardly follow at all, are left out one by one until g can be inverted
        safely.

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
            basis = np.c_[np.ones(len(asked)), asked]
            coefficients = np.array([_robust(basis, one) for one in got.T])
            offset, slope = coefficients[:, 0], coefficients[:, 1:]
            weakest = np.linalg.svd(slope, compute_uv=False).min()
            if weakest >= _LEAST_SLOPE:
                return cls(mean, chosen, offset, slope, _bends(offset + asked @ slope.T, got))
        raise ValueError(
            f"the model hardly follows its descriptor (slope {weakest:.2f} of achieved on wanted): train it longer, "
            "or do without calibration"
        )

    def as_dict(self) -> dict:
        """Plain numbers, for the header of a file of weights."""
        return {name: value.tolist() for name, value in vars(self).items()}

    @classmethod
    def from_dict(cls, values: Mapping) -> "Calibration":
        """The reverse of :meth:`as_dict`; what else `values` say, such as how the fit was made, is passed over.

        Without ``bends``, as weights had them before, g is straight.
        """
        known = [one.name for one in fields(cls) if one.name in values]
        return cls(**{name: np.array(values[name], dtype=float) for name in known})

    def answer(self, told: np.ndarray) -> np.ndarray:
        """g: what the model draws on average when it is told ``told`` (n, N)."""
        told = np.asarray(told, dtype=float)
        z = (told - self.mean) @ self.directions.T
        return told + (self._bent(z @ self.slope.T + self.offset) - z) @ self.directions

    def told(self, targets: np.ndarray) -> np.ndarray:
        """What to tell the model, (n, N), to get ``targets`` (n, N)."""
        targets = np.asarray(targets, dtype=float)
        z = (targets - self.mean) @ self.directions.T
        told = np.linalg.solve(self.slope, (self._bent(z, back=True) - self.offset).T).T
        return targets + (told - z) @ self.directions

    def _bent(self, z, back=False):
        """b of each coordinate of z (n, k), or the inverse of b."""
        bends = np.broadcast_to(self.bends, (z.shape[1], *self.bends.shape[1:]))
        bends = bends[:, ::-1] if back else bends
        return np.column_stack([_polygon(one, *corners) for one, corners in zip(z.T, bends, strict=True)])


def _bends(straight, got):
    """The polygons, (k, 2, corners), by which the straight answers (n, k) come nearest to the true ones (n, k)."""
    found = []
    for x, y in zip(straight.T, got.T, strict=True):
        corners = np.unique(np.quantile(x, _CORNERS))
        if len(x) < _FEW or len(corners) < len(_CORNERS):
            return np.array(_STRAIGHT)
        fold = np.arange(len(x)) % _FOLDS
        bent = np.empty(len(x))
        for k in range(_FOLDS):
            bent[fold == k] = _polygon(x[fold == k], corners, _bend(corners, x[fold != k], y[fold != k]))
        knee = _HUBER * 1.4826 * np.median(np.abs(y - x))
        misses = [huber(knee, y - x - share * (bent - x)).mean() for share in _SHARES]
        share = _SHARES[int(np.argmin(misses))]
        found.append([corners, corners + share * (_bend(corners, x, y) - corners)])
    return np.array(found)


def _bend(corners, x, y):
    """Heights at the corners of the polygon that comes nearest to y (n,) on x (n,)."""
    pieces = [np.clip(x, *ends) - ends[0] for ends in itertools.pairwise(corners)]  # how far x has gone in each
    slopes = _robust(np.column_stack([np.ones(len(x)), *pieces]), y, _LEAST_SLOPE, 1 / _LEAST_SLOPE)
    return slopes[0] + np.r_[0, np.cumsum(slopes[1:] * np.diff(corners))]


def _polygon(x, xs, ys):
    """The polygon through (xs, ys), which goes on straight beyond its ends."""
    piece = np.clip(np.searchsorted(xs, x) - 1, 0, len(xs) - 2)
    return ys[piece] + (x - xs[piece]) * (np.diff(ys) / np.diff(xs))[piece]


def _robust(basis, values, least=-np.inf, most=np.inf):
    """Coefficients of the robust fit to values (n,) on a basis (n, m); all but the first from ``least`` to ``most``."""
    free = basis.shape[1] - 1
    bounds = [-np.inf] + [least] * free, [np.inf] + [most] * free
    weights = np.ones(len(values))
    for _ in range(20):  # least squares again and again, each with the weights that the last one's misses deserve
        root = np.sqrt(weights)
        found = lsq_linear(basis * root[:, None], values * root, bounds).x
        miss = np.abs(values - basis @ found)
        scatter = max(1.4826 * np.median(miss), 1e-9 * np.abs(values).max(), np.finfo(float).tiny)
        weights = 1 / np.maximum(1, miss / (_HUBER * scatter))
    return found
