"""One style for every figure: the Okabe–Ito palette, thin axes, sizes in centimetres of the printed page."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator, NullFormatter

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Okabe–Ito colours (distinguishable with every common colour-vision deficiency), named by their role.
COLOURS = SimpleNamespace(
    wall="#0072B2",  # solid material
    stiff="#0B2545",  # the stiffer of two rubbers
    void="#DCE9F2",  # pressurised cavity
    ghost="#9A9A9A",  # what stands behind
    shadow="#CCCCCC",  # undeformed shape behind a deformed one
    target="#D55E00",  # what was asked for
    achieved="#0072B2",  # what came out
    low="#E69F00",
    medium="#009E73",
    high="#CC79A7",
    accent="#56B4E9",
    ink="#222222",
)

#: Colours of the three targets of a descriptor, with line styles and marks that survive black-and-white printing.
LEVELS = (COLOURS.low, COLOURS.medium, COLOURS.high)
LINE_STYLES = ("-", "--", ":")
MARKERS = ("o", "^", "s")

TEXT_WIDTH = 17.0  # cm


def use_style() -> None:
    """Set matplotlib's global settings to the book's style, whatever they were: a reader's own have no part in it."""
    mpl.rcdefaults()
    mpl.rcParams.update(
        {
            "figure.dpi": 110,
            "savefig.dpi": 200,
            "savefig.bbox": "tight",
            "savefig.facecolor": "white",
            "figure.constrained_layout.use": True,
            "font.size": 9,
            "axes.titlesize": 9,
            "axes.labelsize": 9,
            "legend.fontsize": 8,
            "xtick.labelsize": 8,
            "ytick.labelsize": 8,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.linewidth": 0.8,
            "lines.linewidth": 1.4,
            "legend.frameon": False,
            "image.cmap": "gray",
            "image.interpolation": "nearest",
            "svg.fonttype": "path",
            "svg.hashsalt": "inflate",
            "axes.prop_cycle": plt.cycler(
                color=[COLOURS.wall, COLOURS.target, COLOURS.medium, COLOURS.high, COLOURS.low, COLOURS.ink]
            ),
        }
    )


@contextmanager
def in_style() -> Iterator[None]:
    """The book's style for what is drawn and saved within; afterwards matplotlib's settings are what they were."""
    with mpl.rc_context():
        use_style()
        yield


def figure(
    rows: int = 1, cols: int = 1, *, width: float = TEXT_WIDTH, height: float = 6.0, **kwargs: Any
) -> "tuple[Figure, Any]":
    """A figure of `width` × `height` centimetres with `rows` × `cols` axes.

    Returns
    -------
    fig : matplotlib.figure.Figure
    axes : matplotlib.axes.Axes or ndarray of Axes
        As ``matplotlib.pyplot.subplots`` returns them; `kwargs` are passed on.
    """
    return plt.subplots(rows, cols, figsize=(width / 2.54, height / 2.54), **kwargs)


def picture_axes(ax):
    """Turn an axes into a bare frame for a picture: equal aspect, no ticks, no spines."""
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(False)
    return ax


def logarithmic(ax, across=True, up=True):
    """Make the axes of a plot logarithmic, with plain numbers at their ticks: 0.1, 1, 10, with 2 and 5 in between."""
    for wanted, axis, scale in ((across, ax.xaxis, ax.set_xscale), (up, ax.yaxis, ax.set_yscale)):
        if wanted:
            scale("log")
            low, high = sorted(axis.get_view_interval())
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * low else (1,)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
