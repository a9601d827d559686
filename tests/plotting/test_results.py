"""The figures of structures and of results: one scale, equal axes where lengths are compared, few lines to a panel."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgba

from inflate_lib import describe, inflate, label_image, load_sevens, paths, simulate_dataset
from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.experiments.targets import find_clusters
from inflate_lib.plotting import style
from inflate_lib.plotting.evaluation import plot_baselines, plot_controls, plot_frontier, plot_selection
from inflate_lib.plotting.results import plot_axis_density, plot_generated, plot_generated_axes
from inflate_lib.plotting.structures import draw_pairs, plot_clusters, plot_medial_axes
from inflate_lib.plotting.verification import plot_mesh_study, plot_tube


@pytest.fixture(scope="module")
def data():
    return simulate_dataset(load_sevens("digits").images[:60])


@pytest.fixture(scope="module")
def results():
    return [inflate(label_image(image)) for image in load_sevens("digits").images[:3]]


def experiment(data, name):
    """Three structures for each of two targets, taken from the data."""
    targets = descriptor_matrix(data, name)[[0, 1]]
    some = data.isel(structure=range(6))
    labels = np.array([label_image(image) for image in some["image"].values])
    new = {"level": [0, 0, 0, 1, 1, 1], "valid": np.ones(6, bool)}
    some = some.assign({key: ("structure", value) for key, value in new.items()})
    return some.assign(
        target=(("structure", "component"), targets[some["level"].values]), label=some.image.copy(data=labels)
    )


def boxes(ax):
    """Extents (width, height) of the walls drawn in an axes."""
    walls = [
        drawn for drawn in ax.collections if np.array_equal(drawn.get_facecolor()[:1], [to_rgba(style.COLOURS.wall)])
    ]
    return np.array([np.ptp(np.concatenate([path.vertices for path in wall.get_paths()]), axis=0) for wall in walls])


def test_pairs_are_drawn_in_their_sizes_and_side_by_side(results):
    _, ax = plt.subplots()
    placed = draw_pairs(ax, results)
    assert ax.get_aspect() == 1
    sizes = boxes(ax)
    for number, (result, nodes) in enumerate(zip(results, placed, strict=True)):
        np.testing.assert_allclose(sizes[2 * number], np.ptp(result.nodes, axis=0))
        np.testing.assert_allclose(sizes[2 * number + 1], np.ptp(result.deformed(), axis=0))
        np.testing.assert_allclose(nodes - nodes[0], result.deformed() - result.deformed()[0])
        assert nodes[:, 1].max() < 0  # below the undeformed one
    for left, right in pairwise(placed):
        assert left[:, 0].max() < right[:, 0].min()
    assert ax.get_xlim()[0] <= placed[0][:, 0].min() and placed[-1][:, 0].max() <= ax.get_xlim()[1]


def test_walls_have_no_mesh_lines(results):
    _, ax = plt.subplots()
    draw_pairs(ax, results)
    for drawn in ax.collections:
        assert isinstance(drawn, PolyCollection)
        assert drawn.get_linewidth()[0] == 0 or np.array_equal(drawn.get_edgecolor(), drawn.get_facecolor())


@pytest.mark.parametrize("name", ["height", "box", "axis"])
def test_generated_structures_of_all_targets_are_on_one_scale(data, name):
    fig = plot_generated(experiment(data, name), name, 2)
    fig.canvas.draw()
    rows = [ax for sub in fig.subfigs[:1] for ax in sub.axes]
    assert len(rows) == 2
    scales = [ax.transData.transform([[0, 0], [1, 1]]) for ax in rows]
    sides = np.array([upper - lower for lower, upper in scales])
    np.testing.assert_allclose(sides, sides[0, 0], rtol=0.02)


def test_boxes_have_equal_axes(data):
    panels = plot_generated(experiment(data, "box"), "box", 1).subfigs[1].axes
    assert len(panels) == 2 and all(ax.get_aspect() == 1 for ax in panels)


def test_axes_are_shown_with_x_stretched(data, results):
    known = experiment(data, "axis")
    fig = plot_generated_axes(known)
    fig.canvas.draw()
    panels = fig.subfigs[1].axes
    assert len(panels) == 2
    density = plot_axis_density(known)
    density.canvas.draw()
    medial = plot_medial_axes(results, [describe(result) for result in results])
    medial.canvas.draw()
    for ax in (*panels, *density.axes[:2], *medial.axes[3:]):
        (x, y), (x_1, y_1) = ax.transData.transform([[0, 0], [1, 1]])
        assert x_1 - x > 1.3 * (y_1 - y)
        assert len(ax.get_xticks()) > 1
    np.testing.assert_allclose(density.axes[-1].get_ylim(), [0.1, 1])  # the scale of the density


def test_bars_of_clusters_are_stacked(data):
    values = descriptor_matrix(data, "height")
    (ax, *_) = plot_clusters({"height": values}, {"height": find_clusters(values)}).axes
    bars = [container.patches for container in ax.containers]
    for below, above in pairwise(bars):
        for lower, upper in zip(below, above, strict=True):
            assert upper.get_y() == lower.get_y() + lower.get_height()
    assert not any(bar.get_hatch() for container in bars for bar in container)


def test_curves_of_choice_are_two_to_a_panel_with_plain_ticks():
    rows = pd.DataFrame({"by": ["simulation", "surrogate"] * 2, "n": [1, 1, 50, 50], "median": [2.0, 2.0, 0.05, 1.0]})
    fig = plot_selection({"height": rows, "box": rows, "axis": rows})
    fig.canvas.draw()
    assert [len(ax.lines) for ax in fig.axes] == [2, 2, 2]
    assert {ax.get_yscale() for ax in fig.axes} == {ax.get_xscale() for ax in fig.axes} == {"log"}
    assert fig.axes[0].get_ylim() == fig.axes[1].get_ylim()
    labels = [label.get_text() for ax in fig.axes for label in (*ax.get_xticklabels(), *ax.get_yticklabels())]
    assert {"1", "50", "0.1"} <= set(labels) and not any("10^" in label for label in labels)


def test_controls_are_five_to_a_panel_on_common_axes():
    table = pd.read_csv(paths.REFERENCE / "controls.csv")
    fig = plot_controls(table)
    assert sum(len(ax.containers) for ax in fig.axes) == table["control"].nunique()
    assert all(0 < len(ax.containers) <= 5 for ax in fig.axes)
    assert len({ax.get_ylim() for ax in fig.axes}) == len({ax.get_xlim() for ax in fig.axes}) == 1


def test_an_error_of_zero_is_seen():
    table = pd.DataFrame({"descriptor": "height", "method": ["model", "retrieval"], "median": [2.0, 0.0]})
    table = table.assign(low=table["median"], high=table["median"])
    (ax,) = plot_baselines(table, {"height": "%"}).axes
    assert ax.get_xlim()[0] < 0
    assert [text.get_text() for text in ax.texts] == ["2", "0"]


def test_errors_of_the_mesh_study_are_logarithmic_and_positive():
    table = pd.DataFrame({"structure": 0, "element": "q1", "refine": [1, 2, 4], "height_error": [-8.0, 1.0, 0.0]})
    table = table.assign(width_error=table["height_error"])
    for ax in plot_mesh_study(table).axes:
        assert ax.get_xscale() == ax.get_yscale() == "log"
        np.testing.assert_array_equal(ax.lines[0].get_ydata(), [8.0, 1.0, np.nan])


@pytest.mark.parametrize("refinements", [[2, 4], [2, 4, 8, 16, 32]])
def test_the_legend_of_the_tube_is_clear_of_its_lines(results, refinements):
    errors = {"mean-dilatation": 0.03 / np.square(refinements), "q1": 0.8 / np.square(refinements)}
    fig = plot_tube(results[0], [0.6, 1.1], refinements, errors)
    fig.canvas.draw()
    plot = fig.axes[1]
    assert plot.get_legend().get_window_extent().y0 >= plot.get_window_extent().y1


def test_the_frontier_joins_ways_that_differ_in_their_steps_alone():
    ways = [
        "8 steps",
        "4 steps",
        "second order, w = 5",
        "second order, w = 5, 12 steps",
        "second order",
        "w = 5",
        "η = 0",
        "tuned, second order, w = 5",
    ]
    table = pd.DataFrame({"descriptor": "height", "way": ways, "evaluations": [16, 8, 16, 24, 16, 16, 16, 8]})
    table["R²"], table["variety"] = np.linspace(0.8, 0.9, 8), np.linspace(0.7, 1, 8)
    fig = plot_frontier(pd.concat([table, table.assign(descriptor="axis")]))
    for ax in fig.axes[:2]:
        first, second, student, other = ax.lines
        assert list(student.get_xdata()) == [table.variety[7]]
        assert list(first.get_xdata()) == list(table.variety[[1, 0]])  # the fewest evaluations come first
        assert list(second.get_xdata()) == list(table.variety[[2, 3]])
        assert len(other.get_xdata()) == 3 and other.get_linestyle() == "None"
