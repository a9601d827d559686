"""The curves that an SVG file paints, as points in its user units.

svgelements reads path data, arcs and transforms. Which elements are painted, in which coordinates, and what their
lengths are relative to follows SVG 2 (https://www.w3.org/TR/SVG2, chapters 5, 7, 8, 13 and 14).
"""

import gzip
import io
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

_PIECES = 32  # straight pieces that stand for one curved segment

_NAMESPACE = "{http://www.w3.org/2000/svg}"
_LINKS = "href", "{http://www.w3.org/1999/xlink}href"
#: User units in a unit of CSS.
_UNITS = {"": 1, "px": 1, "in": 96, "cm": 96 / 2.54, "mm": 96 / 25.4, "q": 96 / 101.6, "pt": 4 / 3, "pc": 16}
_FONT_UNITS = {"em": 1, "ex": 0.5, "ch": 0.5}  # of the size of the font; the last two as where the font is not at hand
_FONT_SIZE = 16.0  # "medium"
#: What an element has from the one around it, and the values at the start.
_INHERITED = {
    "visibility": "visible",
    "fill": "black",
    "fill-opacity": "1",
    "stroke": "none",
    "stroke-opacity": "1",
    "stroke-width": "1",
}
#: Attributes that are lengths, by shape, and what 100 % of each are of: the width, the height or the diagonal.
_SHAPES = {
    "rect": {"x": "x", "y": "y", "width": "x", "height": "y", "rx": "x", "ry": "y"},
    "circle": {"cx": "x", "cy": "y", "r": "r"},
    "ellipse": {"cx": "x", "cy": "y", "rx": "x", "ry": "y"},
    "line": {"x1": "x", "y1": "y", "x2": "x", "y2": "y"},
    "polyline": {},
    "polygon": {},
    "path": {},
}
#: What a style sheet may say about where and whether something is painted.
_TELLING = {*_INHERITED, *(name for names in _SHAPES.values() for name in names), "display", "opacity", "transform"}
_TELLING |= {"clip-path", "mask", "d", "font-size", "overflow", "scale", "rotate"}
_POSITIVE = {"rect": ("width", "height"), "circle": ("r",), "ellipse": ("rx", "ry")}  # where not, nothing is painted
_ALIGNED = {"min": 0.0, "mid": 0.5, "max": 1.0}
_SELECTOR = re.compile(r"(\*|[\w-]+)?((?:[.#][\w-]+)*)")
_LENGTH = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)\s*([a-z]*|%)", re.IGNORECASE)


@dataclass(frozen=True)
class _Place:
    """Where an element stands, and what it has from the elements around it."""

    matrix: np.ndarray  # (3, 3) from the coordinates there to those of the file
    width: float  # of the viewport there; NaN where nothing says it
    height: float
    font: float
    style: dict
    clips: tuple = ()  # polygons (k, 2) that cut what is painted, in coordinates of the file
    masked: bool = False
    uses: tuple = ()  # the elements that `use` has led to


def painted_curves(path: Path) -> list[tuple[str, np.ndarray]]:
    """Name and points (k, 2), y downwards, of every curve that an SVG file paints.

    A closed curve ends at its first point. Curved segments are followed by short straight pieces.

    Raises
    ------
    ValueError
        Where the file is no SVG file, or what it paints depends on something that is not supported.
    """
    root = _root(path)
    view = _numbers(root.get("viewBox"))
    width, height = view[2:] if len(view) == 4 else (_pixels(root.get(name)) for name in ("width", "height"))
    place = _Place(np.eye(3), width, height, _FONT_SIZE, _INHERITED)
    return list(_Reader(root).curves(root, place, outermost=True))


def units_per_millimetre(path: Path) -> float:
    """User units of an SVG file in a millimetre, by the size in a unit of length that it gives itself; NaN if none."""
    root = _root(path)
    match, view = _LENGTH.fullmatch((root.get("width") or "").strip()), _numbers(root.get("viewBox"))
    if not match or match[2].lower() not in _UNITS.keys() - {"", "px"}:
        return np.nan
    return view[2] / (_pixels(root.get("width")) / _UNITS["mm"]) if len(view) == 4 else _UNITS["mm"]


class _Reader:
    """Walks through the elements of a file in the order in which they are painted."""

    def __init__(self, root: ElementTree.Element) -> None:
        self.by_id: dict[str | None, Any] = {}
        for element in root.iter():
            self.by_id.setdefault(element.get("id"), element)
        self.rules = _rules(root)

    def curves(self, element, place, outermost=False, size=None, any_paint=False) -> Iterator[tuple[str, np.ndarray]]:
        """Curves of an element and of what is in it; `size` is the viewport that a `use` gives to a symbol or svg."""
        tag, own = _tag(element), self._declared(element)
        if own.get("display") == "none" or _share(own.get("opacity")) <= 0 or "requiredExtensions" in own:
            return
        place = self._inside(own, place)
        if tag in _SHAPES:
            yield from self._shape(tag, element, own, place, any_paint)
        elif tag == "use":
            yield from self._use(own, place, any_paint)
        elif tag in ("g", "a", "svg", "symbol", "clipPath", "switch"):
            if tag in ("svg", "symbol") and not outermost:
                place = self._viewport(own, place, size or {})
            children = [child for child in element if _tag(child) in _RENDERED]
            if tag == "switch":
                children = [child for child in children if "requiredExtensions" not in child.attrib][:1]
            for child in children if place else []:
                yield from self.curves(child, place, any_paint=any_paint)

    def _inside(self, own, place):
        """The place that an element makes: its style, its coordinates, and what cuts it."""
        style = place.style | {name: own[name] for name in _INHERITED if own.get(name, "inherit") != "inherit"}
        font = place.font
        if own.get("font-size", "inherit") != "inherit":
            known = _LENGTH.fullmatch(own["font-size"].strip())
            font = _length(own["font-size"], font, font) if known else _FONT_SIZE
        for name in ("scale", "rotate"):
            if own.get(name, "none") != "none":
                raise ValueError(f"the property {name} is not supported; use transform")
        matrix = place.matrix @ _matrix(own.get("transform", ""), place)
        place = replace(place, style=style, font=font, matrix=matrix)
        clip = self._clip(own.get("clip-path", "none"), place)
        place = place if clip is None else replace(place, clips=(*place.clips, clip))
        return replace(place, masked=place.masked or own.get("mask", "none") not in ("none", "inherit"))

    def _shape(self, tag, element, own, place, any_paint):
        """The curves of one shape, where it is painted."""
        style = place.style
        lengths = {name: _extent(own[name], kind, place) for name, kind in _SHAPES[tag].items() if _given(own, name)}
        if tag == "ellipse":  # one radius goes for both
            lengths = {"rx": lengths.get("ry", 0), "ry": lengths.get("rx", 0)} | lengths
        if any(not lengths.get(name, 0) > 0 for name in _POSITIVE.get(tag, ())):
            return
        filled = any_paint or _paints(style["fill"], style["fill-opacity"])
        stroked = _paints(style["stroke"], style["stroke-opacity"]) and _extent(style["stroke-width"], "r", place) > 0
        if style["visibility"] != "visible" or not (filled or stroked):
            return
        name = f"{tag} {element.get('id')}" if element.get("id") else tag
        for curve in _points(tag, own, lengths):
            points = curve @ place.matrix[:2, :2].T + place.matrix[:2, 2]
            size = np.ptp(points, axis=0).max()
            if size > 0 and (stroked or _area(points) > 1e-12 * size**2):
                if place.masked:
                    raise ValueError(f"{name}: a mask says which part of it is painted; masks are not supported")
                if any(not _within(points, clip) for clip in place.clips):
                    raise ValueError(f"{name}: it is cut by a clip path, or by the border of a nested drawing")
                yield name, points

    def _use(self, own, place, any_paint):
        """The curves of what a `use` refers to, at the place of the `use`."""
        link = next((own[name] for name in _LINKS if name in own), "")
        target = self.by_id.get(link[1:]) if link.startswith("#") else None
        if target is None:
            raise ValueError(f"a use refers to {link!r}, which is not in the file")
        if target in place.uses:
            raise ValueError(f"a use refers to {link!r}, which holds that use")
        x, y = (_extent(own[name], name, place) if _given(own, name) else 0.0 for name in ("x", "y"))
        moved = replace(place, matrix=place.matrix @ _moved(x, y), uses=(*place.uses, target))
        size = {name: own[name] for name in ("width", "height") if _given(own, name)}
        if _tag(target) in _RENDERED or _tag(target) == "symbol":
            yield from self.curves(target, moved, size=size, any_paint=any_paint)

    def _viewport(self, own, place, size):
        """The place inside of a nested drawing or a symbol; None where it has no extent."""
        given = own | size
        x, y = (_extent(own[name], name, place) if _given(own, name) else 0.0 for name in ("x", "y"))
        width, height = (
            _extent(given.get(name, "100%").replace("auto", "100%"), kind, place)
            for name, kind in (("width", "x"), ("height", "y"))
        )
        view = _numbers(own.get("viewBox"))
        inner = (width, height) if len(view) < 4 else view[2:]
        if not (width > 0 and height > 0 and min(inner) > 0):
            return None
        matrix = _moved(x, y)
        if len(view) == 4:
            matrix = matrix @ _fitted(view, width, height, own.get("preserveAspectRatio", "xMidYMid"))
        clips = place.clips
        if own.get("overflow", "hidden") not in ("visible", "auto"):
            border = np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)])
            clips = (*clips, border @ place.matrix[:2, :2].T + place.matrix[:2, 2])
        return replace(place, matrix=place.matrix @ matrix, width=inner[0], height=inner[1], clips=clips)

    def _clip(self, value, place):
        """The polygon of a clip path, of one curve; None where there is none."""
        match = re.fullmatch(r"url\(\s*[\"']?#(.+?)[\"']?\s*\)", value)
        target = self.by_id.get(match[1]) if match else None
        if value in ("none", "inherit") or (match and target is None):
            return None
        if target is not None and target.get("clipPathUnits", "userSpaceOnUse") == "userSpaceOnUse":
            inside = replace(place, style=_INHERITED, clips=(), masked=False)
            curves = list(self.curves(target, inside, any_paint=True))
            if len(curves) == 1:
                return curves[0][1]
        raise ValueError(f"something is cut by clip-path {value!r}; only clip paths of a single curve are supported")

    def _declared(self, element):
        """Attributes of an element, with what style sheets and its style say instead."""
        names = set((element.get("class") or "").split())
        found = []
        for order, (tag, name, classes, declarations) in enumerate(self.rules):
            if tag in (None, "*", _tag(element)) and name in (None, element.get("id")) and classes <= names:
                weight = (name is not None, len(classes), tag not in (None, "*"), order)
                found += [(important, weight, key, value) for key, value, important in declarations]
        inline = _declarations(element.get("style") or "")
        found += [(important, (2, 0, 0, 0), key, value) for key, value, important in inline]
        return dict(element.attrib) | {key: value for _, _, key, value in sorted(found, key=lambda one: one[:2])}


_RENDERED = {*_SHAPES, "use", "g", "a", "svg", "switch"}


def _root(path):
    data = path.read_bytes()
    try:
        data = gzip.decompress(data) if data[:2] == b"\x1f\x8b" else data
        root = ElementTree.parse(io.BytesIO(data)).getroot()
    except (ElementTree.ParseError, OSError, EOFError, ValueError, LookupError) as error:
        raise ValueError(f"it cannot be read as an SVG file: {error}") from None
    if _tag(root) != "svg":
        raise ValueError(f"it cannot be read as an SVG file: its root is {root.tag!r}")
    return root


def _tag(element):
    """The name of an element of SVG, "" for others."""
    tag = element.tag if isinstance(element.tag, str) else ""
    return "" if tag.startswith("{") and not tag.startswith(_NAMESPACE) else tag.removeprefix(_NAMESPACE)


def _rules(root):
    """(tag, id, classes, declarations) of each selector in the style sheets."""
    import tinycss2

    rules = []
    for element in root.iter():
        if _tag(element) != "style":
            continue
        sheet = tinycss2.parse_stylesheet("".join(element.itertext()), skip_comments=True, skip_whitespace=True)
        for rule in sheet:
            if rule.type == "at-rule" and rule.lower_at_keyword in ("media", "supports", "layer", "container"):
                raise ValueError(f"its style sheet has @{rule.at_keyword}, which is not supported")
            if rule.type != "qualified-rule":
                continue
            declarations = _declarations(rule.content)
            if not any(name in _TELLING for name, *_ in declarations):
                continue
            for selector in tinycss2.serialize(rule.prelude).split(","):
                match = _SELECTOR.fullmatch(selector.strip())
                if not match or match[2].count("#") > 1:
                    raise ValueError(f"its style sheet has the selector {selector.strip()!r}, which is not supported")
                words = re.findall(r"([.#])([\w-]+)", match[2])
                name = next((word for sign, word in words if sign == "#"), None)
                rules.append((match[1], name, {word for sign, word in words if sign == "."}, declarations))
    return rules


def _declarations(content):
    """(name, value, important) of what a style says."""
    import tinycss2

    found = tinycss2.parse_blocks_contents(content, skip_comments=True, skip_whitespace=True)
    return [
        (one.lower_name, tinycss2.serialize(one.value).strip(), one.important)
        for one in found
        if one.type == "declaration"
    ]


def _points(tag, own, lengths):
    """Points (k, 2) of each curve of a shape, in its own coordinates."""
    import svgelements

    data = re.sub(r"^path\(\s*([\"'])(.*)\1\s*\)$", r"\2", own.get("d", "none").strip(), flags=re.DOTALL)
    kinds = {"rect": "Rect", "circle": "Circle", "ellipse": "Ellipse", "line": "SimpleLine"}
    try:
        if tag == "path":
            shape = svgelements.Path("" if data == "none" else data)
        else:
            given = lengths if tag in kinds else {"points": own.get("points", "")}
            shape = svgelements.Path(getattr(svgelements, kinds.get(tag, tag.title()))(**given))
    except (ValueError, TypeError, AttributeError, KeyError, IndexError) as error:
        raise ValueError(f"{tag} cannot be read{f': {error}' if str(error) else ''}") from None
    for curve in shape.as_subpaths():
        points = []
        for segment in curve:
            if isinstance(segment, svgelements.Move | svgelements.Line | svgelements.Close):
                points.append(segment.end)
            else:
                points += [segment.point(t) for t in np.arange(1, _PIECES + 1) / _PIECES]
        points = np.array([(point.x, point.y) for point in points if point is not None], dtype=float)
        if not np.isfinite(points).all():
            raise ValueError(f"{tag} has coordinates that are not finite")
        if len(points) > 1:
            yield points


def _area(points):
    """Area of the convex hull of points, or 0 where they lie on one line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return ConvexHull(points).volume
    except (QhullError, ValueError):
        return 0.0


def _within(points, polygon):
    """Whether no point lies outside of a polygon; its border belongs to it."""
    from matplotlib.path import Path as Polygon

    middle = (polygon.min(axis=0) + polygon.max(axis=0)) / 2
    return bool(Polygon(polygon).contains_points(points + 1e-6 * (middle - points)).all())


def _matrix(text, place):
    """(3, 3) matrix of a transform."""
    import svgelements

    if not text or text == "none":
        return np.eye(3)
    try:
        matrix = svgelements.Matrix(text)
        matrix.render(ppi=_UNITS["in"], width=place.width, height=place.height)
        return np.array([[matrix.a, matrix.c, matrix.e], [matrix.b, matrix.d, matrix.f], [0, 0, 1]], dtype=float)
    except (ValueError, TypeError, IndexError, AttributeError):
        raise ValueError(f"the transform {text!r} is not supported") from None


def _moved(x, y):
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def _fitted(view, width, height, aspect):
    """(3, 3) matrix that brings a viewBox (x, y, width, height) into a viewport at the origin."""
    align, *how = [word for word in aspect.split() if word != "defer"] or ["xMidYMid"]
    scale = np.array([width / view[2], height / view[3]])
    if align != "none":
        scale[:] = scale.max() if "slice" in how else scale.min()
        share = [_ALIGNED.get(align[part].lower(), 0.5) for part in (slice(1, 4), slice(5, 8))]
    else:
        share = [0.0, 0.0]
    x, y = share * (np.array([width, height]) - scale * view[2:]) - scale * view[:2]
    return np.array([[scale[0], 0, x], [0, scale[1], y], [0, 0, 1]])


def _numbers(text):
    """Numbers of a viewBox, none where it is no such thing."""
    try:
        numbers = np.array((text or "").replace(",", " ").split(), dtype=float)
    except ValueError:
        return np.empty(0)
    return numbers if len(numbers) == 4 and np.isfinite(numbers).all() and min(numbers[2:]) > 0 else np.empty(0)


def _given(own, name):
    return own.get(name, "auto") not in ("auto", "inherit", "")


def _pixels(text):
    """A width or height of the outermost element in user units, NaN where it is given by nothing, or in percent."""
    match = _LENGTH.fullmatch((text or "").strip())
    return float(match[1]) * _UNITS.get(match[2].lower(), np.nan) if match else np.nan


def _extent(text, kind, place):
    """A length in user units; 100 % are the width ("x"), the height ("y") or the normalised diagonal ("r")."""
    diagonal = np.hypot(place.width, place.height) / np.sqrt(2)
    return _length(text, {"x": place.width, "y": place.height, "r": diagonal}[kind], place.font)


def _length(text, whole, font):
    match = _LENGTH.fullmatch(text.strip())
    amount, unit = (float(match[1]), match[2].lower()) if match else (0.0, "?")
    if unit == "%" and np.isnan(whole):
        raise ValueError(
            f"{text!r} is relative to the size of the drawing, and neither viewBox nor width and height say it"
        )
    scale = {"%": whole / 100, **_UNITS, **{name: share * font for name, share in _FONT_UNITS.items()}}
    if unit not in scale:
        raise ValueError(
            f"the length {text!r} is not supported; write it in user units or in {', '.join(scale)}".replace(", ,", ",")
        )
    return amount * scale[unit]


def _share(text):
    """An opacity; 1 where it is none."""
    match = _LENGTH.fullmatch((text or "1").strip())
    if not match or match[2] not in ("", "%"):
        return 1.0
    return float(match[1]) / (100 if match[2] == "%" else 1)


def _paints(paint, opacity):
    """Whether a fill or a stroke is seen."""
    import svgelements

    paint = paint.strip().lower()
    slash = re.search(r"/([^)]*)\)$", paint)  # rgb(0 0 0 / 0%)
    if slash and _share(slash[1].strip()) <= 0:
        return False
    if paint in ("none", "transparent") or _share(opacity) <= 0:
        return False
    try:
        return svgelements.Color(paint).alpha != 0 if paint.startswith(("#", "rgb", "hsl")) else True
    except (ValueError, TypeError, IndexError):
        return True
