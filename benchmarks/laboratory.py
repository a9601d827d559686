"""How the laboratory in the page agrees with the library, and what it costs beside it, in Chromium without a network.

    python benchmarks/laboratory.py --repeats 5

Python and the browser take turns on one machine.
"""

import sys
import tempfile
from pathlib import Path

import pandas as pd
import typer
from stored import store

from inflate_lib import load_model, load_sevens, paths

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from laboratory import cost, drawn_apart, inflated_apart, opened, pictures, stroke_seconds

TARGETS = ({"height": 1.05}, {"height": 1.1, "area": 0.8}, {"stress": 0.2, "width": 0.9})


def main(repeats: int = 5):
    model = load_model("joint")
    built = sorted((paths.ROOT / "lab" / "built").glob("*.js"))
    with tempfile.TemporaryDirectory() as folder, opened(Path(folder)) as page:
        if page is None:
            raise SystemExit("no Chromium or Chrome found")
        browser = page.context.browser.version
        firsts = []
        for _ in range(repeats):
            page.reload()
            firsts.append(page.evaluate(_FIRST))
        loaded = page.evaluate("performance.now()")
        page.evaluate("inflateLab.draw({ height: 1.05 })")
        drawn_first = page.evaluate("performance.now()") - loaded
        inflation, drawing = cost(page, model, load_sevens("digits", limit=8).images, repeats)
        stroke = stroke_seconds(page)
        images = pictures()
        displacements, descriptors, inflated = inflated_apart(page, images)
        apart = max(drawn_apart(page, model, way, targets) for way in ("quick", "varied") for targets in TARGETS)
    size = sum(path.stat().st_size for path in built)
    rows = [
        ("an inflation of ten load steps (ms)", 1000 * inflation["python"], 1000 * inflation["browser"], "60"),
        ("a drawing, in the way quick (ms)", 1000 * drawing["python"], 1000 * drawing["browser"], "1000"),
        ("a stroke, until its inflation is shown (ms)", None, 1000 * stroke, "100"),
        ("until the first inflation, from the page's opening (s)", None, min(firsts) / 1000, "3"),
        ("the first drawing, with loading the network (s)", None, drawn_first / 1000, ""),
        ("scripts of the laboratory (MB)", None, size / 1e6, "4"),
        (f"difference of displacements, {inflated} structures", None, displacements, "1e-8"),
        (f"difference of descriptors, {inflated} structures", None, descriptors, "1e-8"),
        ("difference of images from the same noise", None, apart, "1e-3"),
    ]
    table = pd.DataFrame(rows, columns=["what", "Python", "browser", "at most"])
    store(
        table,
        "laboratory",
        "laboratory.py",
        digits=2,
        times="ms: processor time, of all processes of the browser; s: wall-clock, the first inflation of several",
        browser=f"Chromium {browser}",
        compared=f"{len(images)} structures; the {len(images) - inflated} that do not inflate are refused alike",
    )


_FIRST = """() => new Promise((resolve) => {
  const look = () => (/built\\./.test(document.querySelector(".lab-status")?.textContent) ? resolve(performance.now())
    : setTimeout(look, 5));
  look();
})"""


if __name__ == "__main__":
    typer.run(main)
