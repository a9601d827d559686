"""The book: profiles, pages and what they publish, runs of the notebooks, the built pages."""

from inflate_lib._lazy import attach

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "page": ["Page", "recorded"],
        "profiles": ["load_profile"],
        "run": ["reproduce"],
        "build": ["build_book"],
    },
)
