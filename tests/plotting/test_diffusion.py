"""The figures of the diffusion chapters show what they are given."""

import numpy as np
import pytest

from inflate_lib.diffusion import cosine_schedule, linear_schedule
from inflate_lib.plotting import diffusion as figures


def test_denoising_strip_picks_the_states_by_step():
    states = [np.full((28, 28), k / 1000) for k in range(1001)]
    steps = [1, *range(200, 1001, 100)]
    axes = figures.plot_denoising(states, steps).axes
    assert [ax.get_title() for ax in axes] == [f"step {k}" for k in steps]
    assert [ax.images[0].get_array()[0, 0] for ax in axes] == [k / 1000 for k in steps]


def test_noising_strip_shows_the_range_of_the_network():
    (ax,) = figures.plot_noising(np.zeros((1, 28, 28)), [0]).axes
    assert ax.images[0].get_clim() == (-1, 1)


def test_schedules_are_drawn_over_the_whole_chain():
    schedules = {"cosine": cosine_schedule(), "linear": linear_schedule()}
    left, right = figures.plot_schedules(schedules).axes
    for line, schedule in zip(left.lines, schedules.values(), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), schedule.alpha_bars)
    assert right.get_yscale() == "log"
    assert [text.get_text() for text in left.get_legend().get_texts()] == list(schedules)


def test_losses_of_five_models_have_a_panel_each():
    history = {"step": [1, 2], "simple": [1.0, 0.5], "vlb": [2.0, 1.0]}
    fig = figures.plot_losses(dict.fromkeys(("height", "width", "box", "area", "axis"), history))
    assert [len(ax.lines) for ax in fig.axes] == [1] * 10
    assert [ax.get_title() for ax in fig.axes[:5]] == ["height", "width", "box", "area", "axis"]
    np.testing.assert_array_equal(fig.axes[5].lines[0].get_ydata(), [2.0, 1.0])


def test_the_legend_of_the_answers_is_off_the_axes():
    wanted = np.linspace(0.8, 1.2, 5)
    fig = figures.plot_answers(dict.fromkeys(("w = 1", "w = 3"), (wanted, wanted, np.poly1d([1, 0]))))
    fig.canvas.draw()
    (legend,) = fig.legends
    assert all(legend.get_window_extent().y0 > ax.get_window_extent().y1 for ax in fig.axes)
    assert all(ax.get_aspect() == 1 for ax in fig.axes)


def test_schematic_has_both_lanes_and_no_text_outside_the_frame():
    fig = figures.plot_schematic()
    fig.canvas.draw()
    (ax,) = fig.axes
    texts = [text.get_text() for text in ax.texts]
    assert {"training", "sampling", "U-Net", "inflate (FEM)"} <= set(texts)
    frame = ax.get_window_extent()
    for text in ax.texts:
        box = text.get_window_extent()
        assert frame.x0 <= box.x0 and box.x1 <= frame.x1 and frame.y0 <= box.y0 and box.y1 <= frame.y1


def test_posterior_and_weights_draw():
    x = np.linspace(-1, 1, 101)
    bell = np.exp(-(x**2))
    (ax,) = figures.plot_posterior(x, bell, bell, 3 * bell, bell, marks={"here": 0.0}).axes
    assert max(line.get_ydata()[50] for line in ax.lines[:3]) == pytest.approx(1)
    (ax,) = figures.plot_vlb_weights({"ε": np.array([1.0, 2.0, 300.0])}, capped=2.0).axes
    assert ax.lines[-1].get_xdata()[0] == 3 and ax.lines[-1].get_ydata()[0] == 2.0
    (ax,) = figures.plot_spread([1, 2], np.ones((2, 2)), np.ones((2, 2))).axes
    assert len(ax.lines) == 4
