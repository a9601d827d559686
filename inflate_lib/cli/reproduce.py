"""``inflate reproduce``: execute the notebooks."""

import os
from typing import Annotated

import typer

from inflate_lib.cli.app import Force, Jobs, ProfileName, Retrain, Source, app
from inflate_lib.paths import need_checkout


@app.command()
def reproduce(
    profile: ProfileName = "laptop",
    only: Annotated[list[str] | None, typer.Option(help="One notebook, by name or number; may be repeated.")] = None,
    jobs: Jobs = 2,
    force: Force = False,
    retrain: Retrain = False,
    source: Source = "auto",
    publish: Annotated[
        bool, typer.Option("--publish", help="Then replace figures/laptop, the edition that git keeps.")
    ] = False,
) -> None:
    """Execute the notebooks under a profile, by default the edition's; figures go to figures/runs/<profile>."""
    need_checkout("inflate reproduce")
    from inflate_lib.book.edition import publish_edition
    from inflate_lib.book.run import reproduce
    from inflate_lib.models.recipe import EDITION

    if publish and (profile != EDITION or only):
        raise ValueError(f"--publish is for a run of all notebooks under the profile {EDITION}")
    tell_notebooks(retrain, source)
    reproduce(profile, only or (), jobs, force)
    if publish:
        publish_edition()


def tell_notebooks(retrain: bool, source: str) -> None:
    """Hand these options to the notebooks, which run in processes of their own."""
    from inflate_lib._checks import choice
    from inflate_lib.models import RETRAIN
    from inflate_lib.structures.sources import CHOSEN, SOURCES

    choice("--source", source, SOURCES)
    if source != "auto":
        os.environ[CHOSEN] = source
    if retrain:
        os.environ[RETRAIN] = "1"
