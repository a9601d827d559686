"""``inflate reproduce``: execute the notebooks."""

import os
from typing import Annotated

import typer

from inflate_lib.cli.app import Force, Jobs, ProfileName, Retrain, app


@app.command()
def reproduce(
    profile: ProfileName = "ci",
    only: Annotated[list[str] | None, typer.Option(help="One notebook, by number or name; may be repeated.")] = None,
    jobs: Jobs = 2,
    force: Force = False,
    retrain: Retrain = False,
) -> None:
    """Execute the notebooks under a profile and regenerate their figures and tables."""
    from inflate_lib.book.run import reproduce

    set_retrain(retrain)
    reproduce(profile, only or (), jobs, force)


def set_retrain(retrain: bool) -> None:
    """Tell the notebooks, which run in processes of their own."""
    from inflate_lib._cache import RETRAIN

    if retrain:
        os.environ[RETRAIN] = "1"
