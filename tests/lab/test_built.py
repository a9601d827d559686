"""What the page loads is made from the sources as they are, is small, and needs no Node."""

import hashlib
import re

from inflate_lib import paths

LAB = paths.ROOT / "lab"
BUILT = sorted((LAB / "built").glob("*.js"))


def sources_digest():
    """As lab/build.mjs computes it."""
    total = hashlib.sha256()
    sources = sorted(path.name for path in (LAB / "src").iterdir())
    for name in ["build.mjs", "package-lock.json", *(f"src/{name}" for name in sources)]:
        total.update(name.encode() + b"\0" + (LAB / name).read_bytes() + b"\0")
    return total.hexdigest()


def test_what_is_built_is_current():
    made_of = {path.name: re.match(r"/\* Made by lab/build\.mjs from (\w+) \*/", path.read_text()) for path in BUILT}
    assert "laboratory.js" in made_of
    stale = [name for name, found in made_of.items() if found and found[1] != sources_digest()]
    assert stale == [], "run `npm run build` in lab/"


def test_all_of_it_is_small():
    assert sum(path.stat().st_size for path in BUILT) < 4e6
