"""``inflate export``: the joint model as the laboratory in the page takes it."""

from pathlib import Path
from typing import Annotated

import typer

from inflate_lib import paths
from inflate_lib.cli.app import ProfileName, app


@app.command()
def export(
    profile: ProfileName = "laptop",
    out: Annotated[Path | None, typer.Option(help="The script; lab/built/laboratory_model.js.")] = None,
) -> None:
    """Write the joint model for the laboratory in the page, with the fingerprint of its weights in it."""
    paths.need_checkout("inflate export")
    from inflate_lib.io import browser
    from inflate_lib.models import load_model

    model = load_model("joint", profile)
    file = browser.export(model, profile, out or browser.FILE)
    told = browser.fingerprint(file) or ""
    print(f"{file}: {file.stat().st_size / 1e6:.2f} MB, weights {told[:12]}")
