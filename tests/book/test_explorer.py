"""The explorer's data: outlines are the boundary of the wall, and the script gives them back as they were."""

import base64
import json

import numpy as np
import pytest
import xarray as xr

from inflate_lib.book.explorer import (
    box_targets,
    explorer_script,
    forward_slider,
    outline,
    pick_diverse,
    scalar_targets,
)
from inflate_lib.descriptors import describe
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.structures.labels import PIXEL, label_image
from inflate_lib.structures.sources import load_sevens


@pytest.fixture(scope="module")
def results():
    return [inflate(label_image(image)) for image in load_sevens("digits", limit=6).images]


def area(loop):
    x, y = loop.T
    return 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)


def test_loops_enclose_wall_and_void(results):
    """The areas within the loops are those of all pixels that are not outside, and of the void."""
    for result in results:
        lengths, points = outline(result)
        ends = np.cumsum(lengths["outer"] + lengths["cavity"])[:-1]
        loops = np.split(points[0] / 10_000, ends)
        inside = sum(area(loop) for loop in loops[: len(lengths["outer"])])
        void = -sum(area(loop) for loop in loops[len(lengths["outer"]) :])
        assert inside - void == pytest.approx(len(result.cells) * PIXEL**2, abs=1e-3)
        start, end = np.moveaxis(result.nodes[result.mesh.pressure_edges], 1, 0)
        assert void == pytest.approx(np.sum(start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1]) / 2, abs=1e-3)


def test_outlines_hold_every_load_step(results):
    for result in results:
        lengths, points = outline(result)
        assert points.shape == (11, sum(lengths["outer"] + lengths["cavity"]), 2)
        assert np.ptp(points[-1, :, 1]) / 10_000 == pytest.approx(describe(result).height, abs=1e-4)
        assert np.ptp(points[0, :, 0]) / 10_000 == pytest.approx(np.ptp(result.nodes[:, 0]), abs=1e-4)


def test_what_has_no_equilibrium_has_no_outline(results):
    burst = inflate(label_image(load_sevens("digits", limit=1).images[0]), pressure=1.0)
    with pytest.raises(ValueError, match="no outline at every load step: no equilibrium"):
        outline(burst)


def test_the_closest_comes_first_and_the_others_differ():
    images = np.zeros((6, 2, 2))
    images[1] = 0.1
    images[2] = 1.0
    error = np.array([0.01, 0.02, 0.03, 0.5, np.nan, 0.6])
    assert pick_diverse(images, error, 2) == [0, 2]
    assert pick_diverse(images, error, 9) == [0, 1, 2, 3, 5]
    assert pick_diverse(images, np.full(6, np.nan), 3) == []


def test_targets_stay_where_structures_are():
    random = np.random.default_rng(0)
    heights = random.normal(1, 0.1, 2000)
    boxes = np.column_stack([heights, 0.8 * heights + random.normal(0, 0.02, 2000)])
    targets = box_targets(boxes, 4)
    assert targets.shape == (16, 2)
    assert np.abs(targets[:, 1] - 0.8 * targets[:, 0]).max() < 0.1
    assert np.all(np.diff(targets.reshape(4, 4, 2)[:, 0, 0]) > 0)
    assert np.all(np.diff(targets.reshape(4, 4, 2)[..., 1], axis=1) > 0)
    assert scalar_targets(heights, 5).shape == (5, 1)
    assert np.quantile(heights, 0.02) == scalar_targets(heights, 5)[0, 0]


def test_the_script_gives_outlines_back(results):
    labels = np.stack([label_image(image) for image in load_sevens("digits", limit=6).images])
    level = np.repeat([0, 1], 3)
    achieved = np.array([describe(result).height for result in results])
    experiment = xr.Dataset(
        {
            "image": (("structure", "row", "column"), labels),
            "label": (("structure", "row", "column"), labels),
            "height": ("structure", achieved),
            "level": ("structure", level),
            "target": (("structure", "component"), np.where(level, 1.0, 0.9)[:, None]),
            "valid": ("structure", np.array([True, True, False, True, True, True])),
            "buildable": ("structure", np.array([True, False, False, True, True, True])),
        }
    )
    script, content = explorer_script({"height": experiment}, 2, {"profile": "test"})
    name, text = script.split("=", 1)
    assert name.strip() == "window.inflateExplorer"
    whole = json.loads(text.rstrip(";\n"))
    assert {key: whole[key] for key in content} == content
    numbers = np.frombuffer(base64.b64decode(whole["points"]), "<i2")
    entries = whole["descriptors"]["height"]
    assert [entry["target"] for entry in entries] == [[0.9], [1.0]]
    assert [(entry["valid"], entry["buildable"]) for entry in entries] == [(2, 1), (3, 3)]
    for k, entry in enumerate(entries):
        best = min((abs(achieved[i] / entry["target"][0] - 1), i) for i in np.flatnonzero(level == k) if i != 2)
        first = entry["structures"][0]
        assert first["error"] == pytest.approx(best[0], abs=1e-4)
        assert first["achieved"] == [pytest.approx(achieved[best[1]], abs=1e-4)]
        lengths, points = outline(results[best[1]])
        assert {kind: first[kind] for kind in lengths} == lengths
        found = numbers[first["at"] : first["at"] + points.size].reshape(points.shape)
        np.testing.assert_array_equal(found, points)


def test_the_slider_carries_its_images():
    states = np.array([[[-1.0, 1.0]], [[0.0, 7.0]]])
    html = forward_slider(states, [0, 1000], [1.0, 2.5e-9]).data
    assert 'data-steps="0 1000"' in html
    assert 'data-alpha-bars="1 2.5e-09"' in html
    assert 'data-size="1 2"' in html
    pixels = base64.b64decode(html.split('data-pixels="')[1].split('"')[0])
    assert list(pixels) == [0, 255, 128, 255]
