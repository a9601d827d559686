"""Every figure is drawn in the book's style, without a screen, and closed."""

import matplotlib as mpl
import pytest

mpl.use("Agg")

from matplotlib import pyplot as plt

from inflate_lib.plotting import in_style


@pytest.fixture(autouse=True)
def styled():
    with in_style():
        yield
    plt.close("all")
