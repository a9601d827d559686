"""Figures of the book: one style, one function per kind of figure.

Importing this package applies the style of :mod:`inflate_lib.plotting.style` to matplotlib.
"""

from inflate_lib.plotting.style import COLOURS, figure, use_style

use_style()

__all__ = ["COLOURS", "figure", "use_style"]
