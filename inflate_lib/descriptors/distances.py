"""How far descriptors are from their targets: relative errors of numbers, distances of the points of a line."""

import numpy as np

from inflate_lib.descriptors.shape import axis_height, outline_height
from inflate_lib.structures.labels import PIXEL


class RelativeError:
    """``|achieved − target| / target``, the mean over the components.

    Attributes
    ----------
    name, noun : str
        In tables, and in the labels of figures.
    unit : str
        In which it is printed, once multiplied by `factor`.
    limits : tuple of float
        Within which structures are counted, `near` in short tables.
    """

    name, noun, unit, factor = "error / target", "error", "%", 100
    limits, near = (0.02, 0.05, 0.10), 0.05

    def of(self, achieved, target):
        """(…,) errors of descriptors (…, N)."""
        return np.abs(achieved / target - 1).mean(axis=-1)

    def share(self, achieved, target):
        """(…,) errors as a share of the target, by which a design is judged."""
        return self.of(achieved, target)

    def scale(self, matrix):
        """What differences of descriptors (n, N) are measured in, so that components count alike."""
        return matrix.std(axis=0)

    def in_units(self, achieved, target, typical, unit):
        """Errors in several units, {name: (unit, (n,))}, the standard deviations being those of `typical` (m, N)."""
        absolute = np.abs(achieved - target)
        return {
            "error": (unit, absolute.mean(axis=1)),
            self.name: (self.unit, self.factor * self.of(achieved, target)),
            "error / standard deviation": ("1", (absolute / self.scale(typical)).mean(axis=1)),
        }

    def limit(self, value):
        """A limit in words."""
        return f"{self.factor * value:.0f} %"


class PointDistance:
    """Mean distance of the points of a line, whose N components are x₀, y₀, x₁, y₁, …; in pixels.

    The line rises from the ground, like a medial axis, which ends one increment below the top of its shape. Methods and
    attributes are those of :class:`RelativeError`; ``apart`` and ``height``, in sides, are what another kind of curve
    changes.
    """

    name, noun, unit, factor = "point distance", "distance", "px", 1
    limits, near = (0.25, 0.5, 1.0), 1

    def apart(self, achieved, target):
        """(…, k) distances of the k points of curves (…, N)."""
        apart = np.asarray(achieved) - np.asarray(target)
        return np.linalg.norm(apart.reshape(*apart.shape[:-1], apart.shape[-1] // 2, 2), axis=-1)

    def height(self, target):
        """(…,) heights of the shapes that curves (…, N) belong to."""
        return axis_height(target.reshape(*target.shape[:-1], target.shape[-1] // 2, 2))

    def of(self, achieved, target):
        return self.apart(achieved, target).mean(axis=-1) / PIXEL

    def share(self, achieved, target):
        """Mean distance over the height of the shape that the target belongs to."""
        return self.apart(achieved, target).mean(axis=-1) / self.height(target)

    def scale(self, matrix):
        """One number for all: the coordinates of points belong together, and the first point never moves."""
        return np.full(matrix.shape[1], np.sqrt((matrix.std(axis=0) ** 2).mean()))

    def in_units(self, achieved, target, typical, unit):
        distance = self.of(achieved, target)
        middle = np.broadcast_to(typical.mean(axis=0), typical.shape)
        return {
            self.name: (self.unit, distance),
            **self.further(achieved, target),
            f"{self.name} / height": ("%", 100 * distance * PIXEL / self.height(target)),
            f"{self.name} / spread": ("1", distance / self.of(typical, middle).mean()),
        }

    def further(self, achieved, target):
        """Another distance, as ``in_units`` gives it."""
        return {"Hausdorff distance": (self.unit, _hausdorff(np.nan_to_num(achieved), target))}

    def limit(self, value):
        return f"{value:g} px"


class OutlineDistance(PointDistance):
    """Mean distance of the parallel supporting lines of two convex outlines, given by their support functions."""

    name = "outline distance"

    def apart(self, achieved, target):
        return np.abs(np.asarray(achieved) - np.asarray(target))

    def height(self, target):
        return outline_height(target)

    def further(self, achieved, target):
        """The largest of these distances is the Hausdorff distance, as far as the directions tell."""
        return {"Hausdorff distance": (self.unit, self.apart(achieved, target).max(axis=-1) / PIXEL)}


RELATIVE, POINT_DISTANCE, OUTLINE_DISTANCE = RelativeError(), PointDistance(), OutlineDistance()


def _hausdorff(axes, others):
    """Hausdorff distances of medial axes as sets of points, pair by pair, in pixels: (n, 60), (n, 60) → (n,).

    The largest distance of any point of one axis from the nearest point of the other.
    """
    axes, others = (np.reshape(part, (len(part), -1, 2)) for part in (axes, others))
    apart = np.linalg.norm(axes[:, :, None] - others[:, None, :], axis=-1)
    return np.maximum(apart.min(axis=1).max(axis=1), apart.min(axis=2).max(axis=1)) / PIXEL
