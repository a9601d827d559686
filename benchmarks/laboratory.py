"""How the laboratory in the page agrees with the library, and what it costs beside it, in Chromium without a network.

    python benchmarks/laboratory.py --repeats 5

Python and the browser take turns on one machine. The page is weighed as `make book` has built it.
"""

import sys
import tempfile
from pathlib import Path
from urllib.parse import unquote

import pandas as pd
import typer
from stored import store

from inflate_lib import load_model, load_sevens, paths

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from laboratory import cost, drawn_apart, inflated_apart, opened, pictures, stroke_seconds

TARGETS = ({"height": 1.05}, {"height": 1.1, "area": 0.8}, {"stress": 0.2, "width": 0.9})
PAGE = paths.BOOK / "_build" / "html" / "laboratory.html"
NONE = "–"


def main(repeats: int = 5):
    if not PAGE.is_file():
        raise SystemExit(f"{PAGE} is missing: run `make book` first")
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
        apart = [drawn_apart(page, model, way, targets) for way in ("quick", "varied") for targets in TARGETS]
        weight = _weight(page.context)
    size = sum(path.stat().st_size for path in built)
    refused = len(images) - inflated
    note = {"browser": f"Chromium {browser}"}
    beside = "at most {} times the library’s, and at most {}"
    rows = [
        ("inflating a structure in ten load steps", *map(_ms, inflation.values()), beside.format(10, "60 ms")),
        ("drawing a structure", *map(_ms, drawing.values()), beside.format(5, "1 s")),
        ("from a stroke until its inflation is shown", NONE, _ms(stroke), "at most 100 ms"),
        ("from opening the page to the first inflation", NONE, f"{min(firsts) / 1000:.1f} s", "at most 3 s"),
        ("the first drawing, with loading the network", NONE, f"{drawn_first / 1000:.1f} s", "at most 3 s"),
        ("scripts of the laboratory, with network and weights", NONE, f"{size / 1e6:.1f} MB", "at most 4 MB"),
        ("the page with all that it loads", NONE, f"{weight / 1e6:.1f} MB", "at most 12 MB"),
    ]
    store(
        pd.DataFrame(rows, columns=["cost of", "library", "laboratory", "demanded of the laboratory"]),
        "laboratory_cost",
        "laboratory.py",
        times="ms: processor time, of all processes of the browser; s: wall-clock, the first inflation of several",
        **note,
    )
    rows = [
        ("displacements, in sides of the frame", f"{inflated} structures", _power(displacements), _power(1e-8)),
        ("descriptors", f"{inflated} structures", _power(descriptors), _power(1e-8)),
        ("reasons why nothing can be inflated", f"{refused} pictures", "none", "none"),
        ("drawn images, from 0 to 1", f"{2 * len(apart)} images from the same noise", _power(max(apart)), _power(1e-3)),
    ]
    store(
        pd.DataFrame(rows, columns=["difference of", "compared", "largest difference", "allowed"]),
        "laboratory_agreement",
        "laboratory.py",
        **note,
    )


def _ms(seconds):
    return f"{1000 * seconds:.2g} ms"


def _power(value):
    """2.7e-13 as 2.7 · 10⁻¹³."""
    digits, exponent = f"{value:.1e}".split("e")
    power = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{power}" if digits == "1.0" else f"{digits} · 10{power}"


def _weight(context):
    """Bytes of all files that the page of the book loads until it has drawn structures."""
    page, urls = context.new_page(), set()
    page.on("request", lambda request: urls.add(request.url.partition("?")[0]))
    page.goto(PAGE.as_uri())
    page.evaluate("inflateLab.draw({ height: 1.05 })")
    files = [Path(unquote(url.removeprefix("file://"))) for url in urls if url.startswith("file:")]
    return sum(file.stat().st_size for file in files)


_FIRST = """() => new Promise((resolve) => {
  const look = () => (/built\\./.test(document.querySelector(".lab-status")?.textContent) ? resolve(performance.now())
    : setTimeout(look, 5));
  look();
})"""


if __name__ == "__main__":
    typer.run(main)
