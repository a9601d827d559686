"""The book: profiles, pages and what they publish, runs of the notebooks, the built pages, the model cards."""

from typing import TYPE_CHECKING

from inflate_lib._lazy import attach

if TYPE_CHECKING:
    from inflate_lib.book.build import build_book
    from inflate_lib.book.page import Page, recorded
    from inflate_lib.book.profiles import load_profile
    from inflate_lib.book.run import reproduce

__all__ = ["Page", "build_book", "load_profile", "recorded", "reproduce"]
__getattr__, __dir__ = attach(__name__, __file__)
