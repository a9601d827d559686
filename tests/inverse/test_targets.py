"""What a design can be asked for: exact shapes in every way of drawing them, and every way to ask for too much."""

import re

import numpy as np
import pytest
from PIL import Image, ImageDraw

from inflate_lib import describe
from inflate_lib.datasets.simulate import simulate_dataset
from inflate_lib.descriptors import get_descriptor
from inflate_lib.descriptors.shape import axis_height
from inflate_lib.inverse.drawings import read_outline
from inflate_lib.inverse.targets import (
    Targets,
    _outline_targets,
    _read_axis,
    as_targets,
    deviations,
    read_targets,
)
from inflate_lib.models.reach import _contradiction, check_reach
from inflate_lib.structures.sources import load_sevens


@pytest.fixture(scope="module")
def data():
    return simulate_dataset(load_sevens("digits").images[:40], n_steps=1)


def svg(path, body, head='width="100mm" height="100mm" viewBox="0 0 100 100"'):
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {head}>{body}</svg>')
    return path


def test_a_circle_has_the_descriptors_of_a_circle(tmp_path):
    targets = _outline_targets(read_outline(svg(tmp_path / "a.svg", '<circle cx="50" cy="50" r="40"/>'), unit=100))
    assert (targets.height, targets.width) == pytest.approx((0.8, 0.8), abs=1e-12)
    assert targets.area == pytest.approx(np.pi * 0.16, rel=1e-3)  # a polygon with 128 corners
    assert np.allclose(targets.axis, np.column_stack([np.zeros(30), 0.8 * np.arange(30) / 30]), atol=1e-12)
    assert targets.drawing[:, 1].min() == 0 and targets.asked == ("height", "width", "area", "axis", "outline")


@pytest.mark.parametrize(
    "body",
    [
        '<rect x="10" y="20" width="30" height="60"/>',
        '<polygon points="10,20 40,20 40,80 10,80"/>',
        '<polyline points="10,20 40,20 40,80 10,80 10,20"/>',
        '<path d="M10 20 h30 v60 h-30 z"/>',
        '<path d="M10 20 C 20 20 30 20 40 20 L 40 80 10 80 10 20"/>',
        '<g transform="translate(5,5) scale(2)"><rect x="2" y="3" width="15" height="30"/></g>',
        '<rect transform="rotate(90)" x="10" y="-60" width="60" height="30" style="stroke:none"/>',
    ],
)
@pytest.mark.parametrize("head", ["", 'width="100mm" height="100mm" viewBox="0 0 100 100"', 'viewBox="0 0 9 9"'])
def test_every_way_to_write_a_rectangle_means_the_same(tmp_path, body, head):
    targets = _outline_targets(read_outline(svg(tmp_path / "a.svg", body, head), unit=50))
    assert (targets.height, targets.width, targets.area) == pytest.approx((1.2, 0.6, 0.72), abs=1e-9)
    assert np.allclose(targets.axis[:, 0], 0, atol=1e-9)


@pytest.mark.parametrize("filled", [True, False])
@pytest.mark.parametrize("inverted", [True, False])
def test_a_picture_is_measured_at_the_edges_of_its_pixels(tmp_path, filled, inverted):
    picture = Image.new("L", (90, 120), 255 * inverted)
    ink = 255 * (not inverted)
    ImageDraw.Draw(picture).rectangle((20, 30, 59, 109), fill=ink if filled else None, outline=ink)
    picture.save(tmp_path / "a.png")
    targets = _outline_targets(read_outline(tmp_path / "a.png", unit=80))
    assert (targets.height, targets.width) == pytest.approx((1.0, 0.5), abs=1e-12)
    assert targets.area == pytest.approx(0.5, rel=2e-3)  # the border cuts the four corners off


def test_a_slanted_outline_leans_as_drawn(tmp_path):
    """Up is up: the picture's y runs downwards, and the axis leans to the side that the drawing leans to."""
    drawn = _outline_targets(read_outline(svg(tmp_path / "a.svg", '<path d="M0 80 h40 L60 0 h-40 z"/>'), unit=80))
    assert np.allclose(drawn.axis[:, 0], 0.25 * np.arange(30) / 30, atol=1e-12)
    picture = Image.new("L", (200, 200))
    ImageDraw.Draw(picture).polygon([(20, 180), (100, 180), (140, 20), (60, 20)], fill=255)
    picture.save(tmp_path / "a.png")
    pixels = _outline_targets(read_outline(tmp_path / "a.png", unit=160))
    assert np.abs(pixels.axis - drawn.axis).max() < 2 / 160


def test_the_outline_of_a_structure_asks_for_that_structure(tmp_path, data):
    from scipy.spatial import ConvexHull

    from inflate_lib import inflate, label_image

    result = inflate(label_image(load_sevens("digits").images[1]))
    hull = result.deformed()[ConvexHull(result.deformed()).vertices]
    points = " ".join(f"{x:.17g},{-y:.17g}" for x, y in 40 * hull)
    shape = describe(result)
    drawn = _outline_targets(read_outline(svg(tmp_path / "a.svg", f'<polygon points="{points}"/>'), unit=40))
    assert max(deviations(drawn, shape).values()) < 1e-12
    check_reach(drawn.vectors, data)


def test_an_axis_file_gives_back_its_points(tmp_path, data):
    axis = data["medial_axis"].values[3]
    lines = [f"{x!r},{y!r}" for x, y in axis.tolist()]
    for text in ("\n".join(lines), "x,y\n" + "\n".join(lines), "\ufeffX, Y\r\n\r\n" + "\r\n".join(lines) + "\r\n"):
        (tmp_path / "axis.csv").write_text(text, encoding="utf-8")
        assert np.allclose(_read_axis(tmp_path / "axis.csv"), axis, rtol=0, atol=1e-15)
    assert Targets(axis=axis).vector("height")[0] == pytest.approx(data["height"].values[3], rel=1e-12)


def test_few_points_are_a_line_from_bottom_to_top():
    targets = Targets(axis=[(0.2, 0.1), (0.2, 0.4), (0.5, 1.0)])
    y = 0.9 * np.arange(30) / 30
    assert np.allclose(targets.axis, np.column_stack([np.maximum(0, (y - 0.3) / 2), y]), atol=1e-12)
    assert axis_height(targets.axis) == pytest.approx(0.9)


def test_what_is_not_asked_is_nan():
    targets = Targets(height=1.1, area=0.8)
    assert targets.asked == ("height", "area")
    assert np.array_equal(targets.vector("joint"), [1.1, np.nan, 0.8, *[np.nan] * 94], equal_nan=True)
    assert np.array_equal(targets.vector("box"), [1.1, np.nan], equal_nan=True)
    for name, value in (("height", 1.1), ("area", 0.8), ("stress", 0.2), ("stretch", 1.4)):
        alone = Targets(**{name: value}).vector("joint")
        assert np.array_equal(alone, get_descriptor("joint").conditions(name, [[value]])[0], equal_nan=True)


def test_deviations_are_relative_and_zero_where_met(data):
    shape = describe(np.array([(0, 0), (1, 0), (1, 2), (0, 2.0)]))
    targets = Targets(height=2.5, width=1, area=1.6, axis=[(0, 0), (0.2, 2)])
    found = deviations(targets, shape)
    assert found["height"] == pytest.approx(0.2) and found["width"] == 0 and found["area"] == pytest.approx(0.25)
    assert found["axis"] == pytest.approx(np.mean(0.2 * np.arange(30) / 30) / 2)


def test_whatever_the_data_set_holds_is_within_reach(data):
    for row in range(data.sizes["structure"]):
        one = data.isel(structure=row)
        everything = {"height": float(one.height), "width": float(one.width), "area": float(one.hull_area)}
        everything |= {"stress": float(one.peak_stress), "stretch": float(one.peak_stretch)}
        everything["axis"] = one.medial_axis.values
        some = ["height"], ["width", "area"], ["stress", "stretch"], ["axis"], ["axis", "width"]
        for names in (*some, list(everything)):
            check_reach(as_targets({name: everything[name] for name in names}).vectors, data)


@pytest.mark.parametrize(
    ("targets", "problem"),
    [
        ({"height": 3}, "height 3 is out of reach"),
        ({"width": 0.1}, "width 0.1 is out of reach"),
        (
            {"height": 1.0, "width": 0.9, "area": 1.2},
            "area 1.2 contradicts height 1 and width 0.9, .* at most 0.9",
        ),
        ({"height": 1.3, "axis": [(0, 0), (0, 0.9)]}, "height 1.3 contradicts the axis, with which it is 0.9"),
        ({"width": 0.2, "axis": [(0, 0), (0.5, 0.9)]}, "width 0.2 contradicts the axis, with which it is at least 0.4"),
        ({"axis": [(0, 0), (2, 0.9)]}, "the axis cannot be reached"),
    ],
)
def test_the_impossible_is_refused_with_the_range_and_the_nearest(data, targets, problem):
    with pytest.raises(ValueError, match=problem) as refused:
        check_reach(as_targets(targets).vectors, data)
    message = str(refused.value)
    for name in ("height", "width", "area"):
        if name in targets:
            column = "hull_area" if name == "area" else name
            values = data[column].values
            assert f"{name} {values.min():.3f} to {values.max():.3f}" in message
    nearest = message.split("the nearest reachable target is")[1]
    found = {name: float(value) for name, value in re.findall(r"(height|width|area) (\d+\.\d+)", nearest)}
    if "axis" not in targets:
        assert set(found) == set(targets)
    check_reach(as_targets(found).vectors, data)  # asking for it is no error


@pytest.mark.parametrize("name", ["stress", "stretch"])
def test_peaks_out_of_reach_are_refused_in_their_own_units(data, name):
    values = data[f"peak_{name}"].values
    for wanted in (1.01 * values.max(), 1.5 * values.max()):
        with pytest.raises(ValueError, match=f"{name} {wanted:.4g} is out of reach") as refused:
            check_reach(as_targets({name: wanted}).vectors, data)
        assert f"reach {name} {values.min():.3f} to {values.max():.3f}" in str(refused.value)
        assert str(refused.value).endswith(f"target is {name} {values.max():.3f}.")


def test_the_stress_follows_from_the_stretch(data):
    """Rubber keeps its volume: the largest stress with the smallest stretch is a contradiction, though each occurs."""
    with pytest.raises(ValueError, match="targets cannot be reached together"):
        check_reach(Targets(stress=float(data.peak_stress.max()), stretch=float(data.peak_stretch.min())).vectors, data)


def test_stress_goes_with_an_outline():
    box = [(0, 0), (0.8, 0), (0.8, 1), (0, 1)]
    targets = as_targets({"outline": box, "stress": 0.2})
    assert targets.asked == ("height", "width", "area", "stress", "axis", "outline") and targets.drawing is not None
    assert targets.vector("joint")[:5] == pytest.approx([1, 0.8, 0.8, 0.2, np.nan], nan_ok=True)
    assert targets.as_dict()["stress"] == 0.2


def test_each_within_reach_is_not_both(data):
    """The tallest structure with the width of the slimmest one: both occur, never together."""
    targets = as_targets({"height": float(data.height.max()), "width": float(data.width.min())})
    assert not _contradiction(targets.vectors)
    with pytest.raises(ValueError, match="reached together: the closest of all structures misses by"):
        check_reach(targets.vectors, data)


@pytest.mark.parametrize(
    ("targets", "message"),
    [
        ({}, "nothing is asked for"),
        ({"hight": 1}, "unknown target 'hight'"),
        ({"height": -1}, "height must be a positive number"),
        ({"height": float("nan")}, "height must be a positive number"),
        ({"height": True}, "height must be a positive number"),
        ({"area": "large"}, "area must be a positive number"),
        ({"stress": 0}, "stress must be a positive number"),
        ({"stretch": 0.9}, "stretch must be a number of at least 1, not 0.9"),
        ({"axis": [(0, 0)]}, "two points at least"),
        ({"axis": [(0, 0), (0, 1), (0, 0.5)]}, "point 3 does not"),
        ({"axis": [(0, 0, 0)]}, r"points of shape \(k, 2\)"),
        ({"axis": [(0, 0), (0, np.inf)]}, "NaN or infinite"),
        ({"outline": []}, r"points of shape \(k, 2\)"),
        ({"outline": [(0, 0), (1, 0), (0, 0)]}, "empty"),
        ({"outline": [(0, 0), (1, 0), (2, 0), (3, 0)]}, "empty"),
        ({"outline": [(0, 0), (1, 1), (1, 0), (0, 1)]}, "crosses itself"),
        ({"outline": [(0, 0), (2, 0), (1, 1), (2, 2), (0, 2), (1, 1)]}, "crosses itself"),
        ({"outline": [(0, 0), (1, 0), (1, 1)], "height": 1}, "leave the others out"),
        ([1.0], "must be a mapping"),
    ],
)
def test_what_is_no_target_is_refused(targets, message):
    with pytest.raises(ValueError, match=message):
        as_targets(targets)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.svg", None, "does not exist"),
        ("empty.svg", "<svg xmlns='http://www.w3.org/2000/svg'/>", "empty"),
        ("text.svg", "no drawing", "cannot be read as an SVG"),
        ("cut.svg", "<svg><path d='M0 0", "cannot be read as an SVG"),
        ("two.svg", "<svg><rect width='1' height='1'/><rect x='3' width='1' height='1'/></svg>", "2 separate curves"),
        ("open.svg", "<svg><path d='M0 0 L10 0 L10 20'/></svg>", "open"),
        ("cross.svg", "<svg><path d='M0 0 L10 10 L10 0 L0 10 z'/></svg>", "cross.svg: outline: it crosses itself"),
        ("loop.svg", "<svg><path d='M0 0 C 30 20 -20 20 10 0 z'/></svg>", "crosses itself"),
        ("line.svg", "<svg><path d='M0 0 L10 0 z'/></svg>", "empty"),
        ("black.png", Image.new("L", (9, 9)), "empty"),
        ("cut.png", Image.fromarray(np.eye(9, dtype=np.uint8) * 255), "four corners"),
        ("two.png", Image.fromarray(np.pad(np.array([[255, 0, 255]], np.uint8), 2)), "2 separate shapes"),
        ("huge.png", Image.new("L", (2001, 5)), "2000 per side"),
        ("text.png", "no picture", "cannot be read as a picture"),
    ],
)
def test_drawings_that_are_no_outline_are_named(tmp_path, name, content, message):
    if isinstance(content, str):
        (tmp_path / name).write_text(content)
    elif content is not None:
        content.save(tmp_path / name)
    with pytest.raises(ValueError, match=message) as refused:
        read_targets(outline=tmp_path / name)
    assert name in str(refused.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        ("", "two points at least"),
        ("x,y\n", "two points at least"),
        ("0,0\n0.1\n", "line 2: two numbers x,y are needed"),
        ("0,0\n0.1,0.2,0.3\n", "line 2"),
        ("x,y\n0,0\n0.1;0.2\n", "line 3"),
        ("0,0\nup,1\n", "line 2"),
        ("0,0\nnan,1\n", "NaN or infinite"),
        ("0,0\n0,1\n0,1\n", "point 3 does not"),
        (b"\xff\xfe\x00", "cannot be read"),
    ],
)
def test_axis_files_that_are_none_are_named(tmp_path, content, message):
    path = tmp_path / "axis.csv"
    if content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=message) as refused:
        read_targets(axis=path)
    assert "axis.csv" in str(refused.value)
