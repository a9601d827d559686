"""Figures of the book: one style, one function per kind of figure.

Importing this package leaves matplotlib's settings alone. The style of :mod:`inflate_lib.plotting.style` is that of a
notebook once it has made its page, and of the pictures that the library writes; a session of one's own has it after
:func:`~inflate_lib.plotting.style.use_style`, or within :func:`~inflate_lib.plotting.style.in_style`.
"""

from inflate_lib.plotting.style import COLOURS, figure, in_style, use_style

__all__ = ["COLOURS", "figure", "in_style", "use_style"]
