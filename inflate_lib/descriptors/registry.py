"""The descriptors: what each is called, how it is measured, mirrored, compared with a target, and drawn.

Whatever is true of one descriptor only stands here; the rest of the library goes through :func:`get_descriptor`.
"""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from inflate_lib._cache import digest
from inflate_lib._checks import number, numbers, positive_number
from inflate_lib.descriptors import shape as geometry
from inflate_lib.descriptors.distances import (
    OUTLINE_DISTANCE,
    POINT_DISTANCE,
    RELATIVE,
    PointDistance,
    RelativeError,
)
from inflate_lib.descriptors.shape import Shape
from inflate_lib.mechanics.stress import largest_stretch, von_mises

_registry: dict[str, "Descriptor"] = {}


@dataclass(frozen=True)
class Descriptor:
    """One descriptor of deformed shapes, as a model is conditioned on it: a vector of N components.

    Attributes
    ----------
    name : str
        By which it is asked for.
    symbol : str
        In formulas and figures, without dollar signs.
    measure : callable
        ``measure(shape)`` of a :class:`inflate_lib.descriptors.Shape` → a number, or an array of the shape `sizes`.
    title : str
        In figures; by default the name.
    meaning : str
        In data sets, one line; by default the title.
    components : tuple of str
        Name of each component, for tables and messages; by default the symbol of the only one.
    unit : str
        Of the components: "side" of the unit square, "side²", or "1".
    variable : str
        Of data sets, which holds the values; by default the name.
    sizes : Mapping
        Dimensions of that variable besides ``structure``, and their sizes; by default none, or one for the components.
    of_nodes : bool
        Whether the deformed nodes alone tell it. If not, it is NaN where only these are known.
    flip : callable, optional
        ``flip(vectors)`` (n, N) → (n, N) for mirrored structures; by default they have the same values.
    error : RelativeError or PointDistance
        How the distance from a target is measured and printed.
    draw : callable, optional
        ``draw(ax, target, nodes, **style)`` draws a target (N,) over the picture of deformed nodes (n, 2).
    parts : tuple of str
        Names of the descriptors that this one is put together from; it is measured, mirrored and stored as they are.
    any_part : bool
        A model of it can be asked for any combination of the parts.
    check : callable, optional
        ``check(name, value)`` makes a target of what is given for it, or raises a ValueError; by default a target is N
        finite numbers.
    bounds : Mapping
        What it says about other descriptors of a single component: name → function of its vector (N,) → the least and
        the greatest value of that one. Targets that contradict it are refused.
    gradient : callable, optional
        ``gradient(nodes)`` → (n, 2), the derivative with respect to deformed nodes (n, 2) of a single component. Where
        there is one, designs are refined by :func:`inflate_lib.inverse.sensitivities`.
    """

    name: str
    symbol: str
    measure: Callable | None = None
    title: str = ""
    meaning: str = ""
    components: tuple[str, ...] = ()
    unit: str = "1"
    variable: str = ""
    sizes: Mapping[str, int] = field(default_factory=dict)
    of_nodes: bool = True
    flip: Callable | None = None
    error: RelativeError | PointDistance = RELATIVE
    draw: Callable | None = None
    parts: tuple[str, ...] = ()
    any_part: bool = False
    check: Callable | None = None
    bounds: Mapping[str, Callable] = field(default_factory=dict)
    gradient: Callable | None = None

    def __post_init__(self):
        if (self.measure is None) != bool(self.parts):
            raise ValueError(f"descriptor {self.name}: either a function measures it, or it has parts")
        if self.parts:
            components = tuple(name for part in self.parts for name in get_descriptor(part).components)
        else:
            components = self.components or (self.symbol,)
        sizes = self.sizes or ({f"{self.name}_component": len(components)} if len(components) > 1 else {})
        if not self.parts and np.prod([*sizes.values()], dtype=int) != len(components):
            raise ValueError(f"descriptor {self.name}: {len(components)} components do not fill the sizes {sizes}")
        for name, value in {
            "title": self.title or self.name,
            "meaning": self.meaning or self.title or self.name,
            "components": components,
            "sizes": sizes,
            "variable": self.variable or self.name,
            "parts": self.parts or (self.name,),
        }.items():
            object.__setattr__(self, name, value)

    @property
    def length(self) -> int:
        """N, the number of components."""
        return len(self.components)

    @property
    def is_basic(self) -> bool:
        """Whether it is measured, not put together from parts."""
        return self.measure is not None

    @property
    def is_line(self) -> bool:
        """Whether the components are those of one curve, which mean little one by one."""
        return isinstance(self.error, PointDistance)

    @property
    def is_size(self) -> bool:
        """Whether it is one number that the deformed nodes alone tell."""
        return self.is_basic and self.length == 1 and self.of_nodes

    def of(self, shape: Shape) -> np.ndarray:
        """The value for a :class:`inflate_lib.descriptors.Shape`, in the shape of `sizes`."""
        shape_of_value = tuple(self.sizes.values())
        if shape.result is None and not self.of_nodes:
            return np.full(shape_of_value, np.nan)
        return np.reshape(np.asarray(self.measure(shape), dtype=float), shape_of_value)

    def mirrored(self, vectors: np.ndarray) -> np.ndarray:
        """(n, N) the descriptors of mirrored structures, from those of the structures."""
        if self.is_basic:
            return vectors if self.flip is None else self.flip(vectors)
        return np.column_stack(
            [get_descriptor(part).mirrored(vectors[:, columns(part, self.parts)]) for part in self.parts]
        )

    def target(self, value: Any) -> np.ndarray:
        """(N,) the target that is meant by a value, or a ValueError."""
        checked = value if self.check is None else self.check(self.name, value)
        wanted = f"{self.length} finite number{'s' * (self.length > 1)}"
        vector = np.ravel(numbers(self.name, checked, wanted))
        if vector.size != self.length:
            raise ValueError(f"{self.name} must be {wanted}, not {value!r}")
        return vector

    def conditions(self, name: str, values: np.ndarray) -> np.ndarray:
        """Vectors (m, ·) of some of the parts as a model of it is told them, (m, N): NaN for what is not asked for."""
        if not set(get_descriptor(name).parts) <= set(self.parts):
            raise ValueError(f"the {self.name} model takes {', '.join(self.parts)}, not {name}")
        conditions = np.full((len(values), self.length), np.nan)
        conditions[:, columns(name, self.parts)] = values
        return conditions


def get_descriptor(name: str) -> Descriptor:
    """The descriptor of that name, or of several that are asked for together: "height+area".

    Raises
    ------
    ValueError
        For an unknown name; it lists them all.
    """
    if name in _registry:
        return _registry[name]
    parts = tuple(name.split("+")) if isinstance(name, str) else ()
    if len(parts) < 2 or not set(parts) <= {one.name for one in basic()}:
        raise ValueError(f"unknown descriptor {name!r}; choose one of {', '.join(_registry)}")
    return Descriptor(name, name, parts=parts)


def name_of(parts: Iterable[str]) -> str:
    """What basic descriptors, in any order, are called together: "box", "joint", "height+area"."""
    parts = set(parts)
    together = [one.name for one in registered() if set(one.parts) == parts]
    return together[0] if together else "+".join(one.name for one in basic() if one.name in parts)


def register(descriptor: Descriptor) -> Descriptor:
    """Make a descriptor known, so that data sets, training, experiments, designs and figures take it by its name.

    It has to be registered before structures are simulated that are to have it. A descriptor that was registered
    before may be replaced, the library's own may not.

    Returns
    -------
    Descriptor

    Raises
    ------
    ValueError
        Where the name, or the variable of data sets, is one of the library's.
    """
    if descriptor.name in OWN:
        raise ValueError(f"{descriptor.name} is a descriptor of the library's own; choose another name")
    if descriptor.is_basic and descriptor.variable in _TAKEN:
        raise ValueError(f"descriptor {descriptor.name}: data sets have a variable {descriptor.variable} already")
    _registry[descriptor.name] = descriptor
    return descriptor


def registered() -> tuple[Descriptor, ...]:
    """All descriptors, in order of registration."""
    return tuple(_registry.values())


def basic() -> tuple[Descriptor, ...]:
    """Those that are measured, not put together from parts."""
    return tuple(one for one in registered() if one.is_basic)


def added_version() -> str:
    """Hash of the sources of what measures the descriptors that are not the library's own; empty where there are none.

    It belongs into the keys of results that hold descriptors. It does not see a change of what ``measure`` calls.
    """
    sources = [part for one in basic() if one.name not in OWN for part in (one.name, _source(one))]
    return digest(*sources)[:16] if sources else ""


def columns(name: str, among: Sequence[str]) -> np.ndarray:
    """(N,) int: where the components of a descriptor stand among those of several, one descriptor after another."""
    owner = np.repeat(among, [get_descriptor(part).length for part in among])
    return np.flatnonzero(np.isin(owner, get_descriptor(name).parts))


def implied(wanted: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """What vectors (N,) of descriptors, by name, say exactly about others: an axis about the height."""
    found = {}
    for name, vector in wanted.items():
        for other, bound in get_descriptor(name).bounds.items():
            least, most = bound(vector)
            if least == most and other not in wanted:
                found[other] = np.array([least])
    return found


def _source(descriptor):
    try:
        return inspect.getsource(descriptor.measure)
    except (OSError, TypeError):
        raise ValueError(
            f"descriptor {descriptor.name}: the source of its function cannot be found; define it with def in a file "
            "or a notebook, so that results that are kept can tell whether it has changed"
        ) from None


# --- the library's own ---------------------------------------------------------------------------------------------


def _own(name, symbol, measure=None, **properties):
    _registry[name] = Descriptor(name, symbol, measure, **properties)


def _height(shape):
    return np.ptp(shape.nodes[:, 1])


def _width(shape):
    return np.ptp(shape.nodes[:, 0])


def _area(shape):
    return shape.hull_area


def _axis(shape):
    return geometry.medial_axis(shape.hull)


def _outline(shape):
    return geometry.support_function(shape.hull)


def _stress(shape):
    return von_mises(shape.result).max()


def _stretch(shape):
    return largest_stretch(shape.result).max()


def _extent_gradient(direction, nodes):
    """It follows the two nodes in which the extent is attained."""
    gradient = np.zeros_like(nodes)
    gradient[nodes[:, direction].argmax(), direction] = 1
    gradient[nodes[:, direction].argmin(), direction] = -1
    return gradient


def _hull_gradient(nodes):
    gradient = np.zeros_like(nodes)
    hull = ConvexHull(nodes).vertices
    gradient[hull] = geometry.area_gradient(nodes[hull])
    return gradient


def _height_of_axis(vector):
    return (geometry.axis_height(vector.reshape(-1, 2)),) * 2


def _width_of_axis(vector):
    return np.ptp(vector[0::2]), np.inf


def _height_of_outline(vector):
    return (geometry.outline_height(vector),) * 2


def _width_of_outline(vector):
    return (vector[0] + vector[geometry.OUTLINE_DIRECTIONS // 2],) * 2


def _area_of_box(vector):
    return 0.0, vector.prod()


def _draw_height(ax, target, nodes, **style):
    """A line as high as the target above the lowest node."""
    (left, bottom), (right, _) = nodes.min(axis=0), nodes.max(axis=0)
    ax.plot([left - 0.05, right + 0.05], [bottom + target[0]] * 2, linestyle="--", **style)


def _draw_width(ax, target, nodes, **style):
    """Two lines as far apart as the target, about the middle."""
    (left, bottom), (right, top) = nodes.min(axis=0), nodes.max(axis=0)
    for x in ((left + right - target[0]) / 2, (left + right + target[0]) / 2):
        ax.plot([x, x], [bottom, top], linestyle="--", **style)


def _draw_box(ax, target, nodes, **style):
    """A rectangle on the lowest node."""
    h, w = target
    _draw_polygon(ax, np.array([(-w / 2, 0), (w / 2, 0), (w / 2, h), (-w / 2, h)]), nodes, **style)


def _draw_axis(ax, target, nodes, **style):
    """The points, where those of the structure's own axis begin."""
    points = geometry.place_axis(target.reshape(-1, 2), nodes)
    own = {"marker": "o", "markersize": 1.8, "markeredgecolor": "white", "markeredgewidth": 0.3}
    own |= {"linewidth": 0.8, "zorder": 2}
    ax.plot(*points.T, **(style | own))


def _draw_outline(ax, target, nodes, **style):
    _draw_polygon(ax, geometry.outline_corners(target), nodes, **style)


def _draw_polygon(ax, corners, nodes, color=None, **style):
    """Corners (k, 2), moved to the ground and the middle of the structure."""
    (left, bottom), (right, _) = nodes.min(axis=0), nodes.max(axis=0)
    x, y = (corners + [(left + right) / 2, bottom]).T
    ax.fill(x, y, fill=False, edgecolor=color, linestyle="--", clip_on=False, **style)


_own(
    "height",
    "h",
    _height,
    meaning="deformed height h",
    unit="side",
    check=positive_number,
    gradient=partial(_extent_gradient, 1),
    draw=_draw_height,
)
_own(
    "width",
    "w",
    _width,
    meaning="deformed width w",
    unit="side",
    check=positive_number,
    gradient=partial(_extent_gradient, 0),
    draw=_draw_width,
)
_own(
    "box",
    "(h, w)",
    title="bounding box",
    unit="side",
    parts=("height", "width"),
    bounds={"area": _area_of_box},
    draw=_draw_box,
)
_own(
    "area",
    "A",
    _area,
    title="hull area",
    meaning="area A of the deformed convex hull",
    unit="side²",
    variable="hull_area",
    check=positive_number,
    gradient=_hull_gradient,
)
# Stress and stretch are told as they are: over MNIST's sevens their skewness is 0.5 and 0.3. Logarithms of the
# stress have one of -0.5, and would leave less of the scaled range [0, 1] to the bulk, not more.
_own(
    "stress",
    "σ",
    _stress,
    title="peak stress",
    meaning="largest von Mises stress of any element, in the units of lambda and mu",
    components=("stress",),
    variable="peak_stress",
    check=positive_number,
    of_nodes=False,
)
_own(
    "stretch",
    "s",
    _stretch,
    title="peak stretch",
    meaning="largest principal stretch of any element",
    components=("stretch",),
    variable="peak_stretch",
    check=partial(number, least=1),
    of_nodes=False,
)
_own(
    "axis",
    "axis",
    _axis,
    title="medial axis",
    meaning="medial axis of the deformed shape, bottom to top, first point at the origin",
    components=tuple(f"{x} of point {k}" for k in range(geometry.AXIS_POINTS) for x in "xy"),
    unit="side",
    variable="medial_axis",
    sizes={"point": geometry.AXIS_POINTS, "axis": 2},
    flip=geometry.mirror_axis,
    error=POINT_DISTANCE,
    check=geometry.check_axis,
    bounds={"height": _height_of_axis, "width": _width_of_axis},
    draw=_draw_axis,
)
_own(
    "outline",
    "H(θ)",
    _outline,
    meaning="support function of the deformed convex hull, from the ground below its middle",
    components=tuple(f"H at {360 * k / geometry.OUTLINE_DIRECTIONS:g}°" for k in range(geometry.OUTLINE_DIRECTIONS)),
    unit="side",
    sizes={"direction": geometry.OUTLINE_DIRECTIONS},
    flip=geometry.mirror_outline,
    error=OUTLINE_DISTANCE,
    check=geometry.check_outline,
    bounds={"height": _height_of_outline, "width": _width_of_outline},
    draw=_draw_outline,
)
_JOINT = ("height", "width", "area", "stress", "stretch", "axis", "outline")
_own("joint", "joint", parts=_JOINT, any_part=True)

OWN = frozenset(_registry)
#: Variables of data sets that no further descriptor may have.
_TAKEN = frozenset(one.variable for one in basic()) | {
    "image", "label", "converged", "reason", "buildable", "flaw", "factorisations", "self_contact",
    "contact_step", "level", "target", "valid", "axis",
}  # fmt: skip
#: The paper's five descriptors, each with a model of its own.
DESCRIPTORS = ("height", "width", "box", "area", "axis")
#: The physical ones, which no model of their own is trained for.
PHYSICAL = ("stress", "stretch")
#: The descriptor that one model takes any combination of the parts of.
JOINT = "joint"
PARTS = _registry[JOINT].parts
