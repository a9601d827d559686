"""``inflate card``: measure weights, write their card."""

from pathlib import Path
from typing import Annotated

import typer

from inflate_lib import paths
from inflate_lib.cli.app import ProfileName, app


@app.command()
def card(
    profile: ProfileName = "laptop",
    folder: Annotated[Path | None, typer.Option(help="Folder of the weights; data/pretrained/<profile>.")] = None,
    targets: Annotated[
        int | None, typer.Option(min=2, help="Held-out targets for each model; all, by default.")
    ] = None,
) -> None:
    """Measure the weights of a profile on held-out targets, and write the model card beside them."""
    paths.need_checkout("inflate card")
    from inflate_lib.book.card import write_card
    from inflate_lib.datasets.simulate import simulated_sevens
    from inflate_lib.models.recipe import load_recipe

    recipe = load_recipe(profile)
    data = simulated_sevens(recipe.source, recipe.n_structures)
    print(write_card(folder or paths.PRETRAINED / profile, data, recipe, targets))
