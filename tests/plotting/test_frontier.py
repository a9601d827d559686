"""Accuracy over variety: ways that differ in their steps alone are joined."""

import matplotlib as mpl
import numpy as np
import pandas as pd

mpl.use("Agg")

from matplotlib import pyplot as plt

from inflate_lib.plotting.evaluation import plot_frontier


def test_the_frontier_joins_ways_that_differ_in_their_steps_alone():
    ways = [
        "8 steps",
        "4 steps",
        "second order, w = 5",
        "second order, w = 5, 12 steps",
        "second order",
        "w = 5",
        "η = 0",
    ]
    table = pd.DataFrame({"descriptor": "height", "way": ways, "evaluations": [16, 8, 16, 24, 16, 16, 16]})
    table["R²"], table["variety"] = np.linspace(0.8, 0.9, 7), np.linspace(0.7, 1, 7)
    fig = plot_frontier(pd.concat([table, table.assign(descriptor="axis")]))
    for ax in fig.axes[:2]:
        first, second, other = ax.lines
        assert list(first.get_xdata()) == list(table.variety[[1, 0]])  # the fewest evaluations come first
        assert list(second.get_xdata()) == list(table.variety[[2, 3]])
        assert len(other.get_xdata()) == 3 and other.get_linestyle() == "None"
    plt.close(fig)
