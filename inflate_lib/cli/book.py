"""``inflate book`` and ``inflate pdf``: the book, on the screen and on paper."""

from inflate_lib.cli.app import Force, Jobs, ProfileName, Retrain, Source, app
from inflate_lib.cli.reproduce import tell_notebooks
from inflate_lib.paths import need_checkout


@app.command()
def book(
    profile: ProfileName = "laptop",
    jobs: Jobs = 2,
    force: Force = False,
    retrain: Retrain = False,
    source: Source = "auto",
) -> None:
    """Execute what is not fresh, then build the book with warnings as errors; by default its edition, laptop."""
    need_checkout("inflate book")
    from inflate_lib.book.build import SECONDS, build_book
    from inflate_lib.book.run import reproduce

    tell_notebooks(retrain, source)
    reproduce(profile, (), jobs, force, then=SECONDS)
    build_book(profile)


@app.command()
def pdf() -> None:
    """Print the book that was built last as one PDF file, with Chromium."""
    need_checkout("inflate pdf")
    from inflate_lib.book.pdf import print_book

    print(f"The book on paper: {print_book()}")
