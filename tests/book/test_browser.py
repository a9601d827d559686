"""The built book in a real browser, after `make book`: `pytest -m book`. Opened from the disk, as a reader would.

Needs Chromium or Chrome (Debian: `apt-get install chromium`) and the package playwright, which drives it.
"""

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urljoin

import numpy as np
import pytest

from inflate_lib import paths
from inflate_lib.book.pdf import _find_chromium, _print_page, _sandbox_flags
from inflate_lib.book.run import executed_under
from inflate_lib.book.sphinx_ext import _EXPLORER

pytestmark = pytest.mark.book
PROFILE = (executed_under(paths.EXECUTED / "08_dataset.ipynb") or {}).get("profile")
HTML = paths.BOOK / "_build" / "html"
PAGES = sorted(str(path.relative_to(HTML)) for path in HTML.rglob("*.html") if "_static" not in path.parts)
WIDTHS = {"phone": (390, 844), "desktop": (1280, 900)}
LARGEST = 64e6  # bytes of the whole book, 4e6 of them the laboratory
LOUD = "NO BROWSER TEST: no Chromium or Chrome found. Install one (Debian: chromium), or set INFLATE_CHROMIUM to it."


@pytest.fixture(scope="module")
def browser():
    """One browser for all tests; what Chromium says when it cannot start is shown."""
    chromium = _find_chromium()
    if chromium is None:
        pytest.skip(LOUD)
    sync_api = pytest.importorskip("playwright.sync_api", reason="NO BROWSER TEST: pip install playwright")
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(chromium), args=["--disable-gpu", *_sandbox_flags()])
        yield browser
        browser.close()


class Reader:
    """A window of the browser that notes what a page complains about and what it asks for."""

    def __init__(self, browser, width="desktop", theme="light", **options):
        self.context = browser.new_context(offline=True, **options)
        self.context.set_default_timeout(60_000)
        self.page = self.context.new_page()
        self.resize(width, theme)
        self.complaints, self.requests = [], []
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type in ("error", "warning") else None)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("requestfailed", lambda request: self.complaints.append(f"failed: {request.url}"))

    def resize(self, width, theme):
        self.page.set_viewport_size(dict(zip(("width", "height"), WIDTHS[width], strict=True)))
        self.page.emulate_media(color_scheme=theme)

    def open(self, name):
        self.page.goto("about:blank")  # what the page before breaks off is no complaint of the next one
        self.complaints.clear()
        self.requests.clear()
        self.page.goto((HTML / name).as_uri(), wait_until="load")
        self.page.evaluate("window.MathJax?.startup?.promise")  # waits until the equations are set
        return self.page

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.context.close()


@pytest.fixture(scope="module")
def desktop(browser):
    with Reader(browser) as reader:
        yield reader


def too_wide(page):
    """How many pixels the page can be scrolled sideways, and what sticks out (not in a box that scrolls)."""
    return page.evaluate(
        """() => {
          const root = document.scrollingElement, extra = root.scrollWidth - root.clientWidth;
          if (extra <= 0) return [];
          const boxes = ["auto", "scroll", "hidden", "clip"];
          const scrolls = (e) => e && e !== root &&
            (boxes.includes(getComputedStyle(e).overflowX) || scrolls(e.parentElement));
          return [extra, ...[...document.querySelectorAll("article *")].filter((e) =>
            e.getBoundingClientRect().right > root.clientWidth + 1 && !scrolls(e.parentElement))
            .slice(0, 3).map((e) => e.outerHTML.slice(0, 120))];
        }"""
    )


def test_there_are_pages():
    assert len(PAGES) > len(list(paths.NOTEBOOKS.glob("[0-9][0-9]_*.md")))


@pytest.fixture(scope="module", params=PAGES)
def one(request, desktop):
    """The name of a page that has just been opened in the window of the desktop, once for all that looks at it."""
    desktop.open(request.param)
    return request.param


def test_a_page_on_a_desktop(desktop, one):
    page = desktop.page
    assert not desktop.complaints
    assert [url for url in desktop.requests if not url.startswith(("file:", "data:", "blob:"))] == []
    assert too_wide(page) == []
    assert page.locator("main h1").count()
    assert not page.evaluate("[...document.images].filter((i) => i.complete && !i.naturalWidth).map((i) => i.src)")


def test_a_page_fits_on_paper(desktop, one):
    """Chromium shrinks a whole book if anything in it is wider than A4 between its margins, 178 mm."""
    page = desktop.page
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 672, "height": 900})
    sticking_out = too_wide(page)
    page.emulate_media(media="screen")
    desktop.resize("desktop", "light")
    assert sticking_out == []


@pytest.fixture
def phone_at_night(desktop, one):
    """The page that is open, on a screen that turns small and dark."""
    desktop.resize("phone", "dark")
    yield desktop.page
    desktop.resize("desktop", "light")


def test_a_page_on_a_phone_at_night(desktop, phone_at_night):
    page = phone_at_night
    page.wait_for_function("document.documentElement.dataset.theme === 'dark'")
    assert not desktop.complaints
    assert too_wide(page) == []
    luminance = page.evaluate(
        """() => ["color", "backgroundColor"].map((what) => {
          const here = what === "color" ? document.querySelector("article p, article h1, body") : document.body;
          const [r, g, b] = getComputedStyle(here)[what].match(/[\\d.]+/g).map(Number);
          return (0.2126 * r + 0.7152 * g + 0.0722 * b) / 255;
        })"""
    )
    assert luminance[0] > 0.6 and luminance[1] < 0.25, "dark text or a light page in the dark theme"
    sheets = page.evaluate(
        "[...document.querySelectorAll('article img')].map((i) => getComputedStyle(i).backgroundColor)"
    )
    assert set(sheets) <= {"rgb(255, 255, 255)"}, "a figure without its white sheet in the dark theme"


def test_equations_are_set_and_images_described(desktop, one):
    page = desktop.page
    sources = page.locator("article .math").count()
    assert page.locator("article mjx-container").count() >= sources
    assert page.locator("mjx-merror, [data-mjx-error]").count() == 0
    pictures = "[...document.querySelectorAll('article img:not(.toggler)')]"  # the index of modules has tiny buttons
    nameless = pictures + ".filter((i) => i.alt.trim().length < 10).map((i) => i.src)"
    assert page.evaluate(nameless) == []


def test_a_page_says_which_run_it_comes_from(desktop, one):
    if one in ("genindex.html", "search.html", "py-modindex.html"):
        return
    footer = desktop.page.locator(".extra_footer").inner_text()
    assert re.search(rf"profile {PROFILE} · commit \w{{7,10}}.* · \d{{4}}-\d\d-\d\d", footer)
    if stamp := executed_under(paths.EXECUTED / f"{one.removeprefix('notebooks/').removesuffix('.html')}.ipynb"):
        badge = desktop.page.locator(".profile-badge")
        assert badge.count() == 1 and badge.is_visible()
        assert f"{stamp['profile']} profile" in badge.inner_text()


class Anchors(HTMLParser):
    """Where the links of a page lead, and what a link can lead to on it."""

    def __init__(self, name):
        super().__init__()
        self.address, self.names, self.links = (HTML / name).as_uri(), set(), set()
        self.feed((HTML / name).read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.names.add(found.get("id"))
        if tag == "a" and "href" in found:
            self.links.add(urljoin(self.address, found["href"]))


def test_every_link_leads_somewhere():
    """Within the book every page and every anchor; links to the outside are only checked for their form."""
    pages, dead = [Anchors(name) for name in PAGES], []
    anchors = {page.address: page.names for page in pages}
    for page in pages:
        for url in page.links:
            address, _, anchor = url.partition("#")
            if address.startswith("file:"):
                path = unquote(address.removeprefix("file://").partition("?")[0])
                there = address in anchors or Path(path).is_file()
                if not there or (anchor and address in anchors and unquote(anchor) not in anchors[address]):
                    dead.append(f"{page.address}: {url}")
            elif not address.startswith(("https://", "mailto:", "javascript:")):
                dead.append(f"{page.address}: {url}")
    assert sum(len(page.links) for page in pages) > 20 * len(pages)
    assert not dead


def test_no_page_knows_where_it_was_built():
    homes = {str(paths.ROOT), str(paths.CACHE)}
    texts = [path for path in HTML.rglob("*") if path.suffix in {".html", ".js", ".txt", ".ipynb", ".md"}]
    texts = [path for path in texts if "mathjax" not in str(path).lower()]
    leaks = [f"{path.name}: {home}" for path in texts for home in homes if home in path.read_text(encoding="utf-8")]
    assert not leaks


def test_the_book_is_not_too_large():
    sizes = {path: path.stat().st_size for path in HTML.rglob("*") if path.is_file()}
    largest = sorted(sizes.items(), key=lambda item: -item[1])[:5]
    assert sum(sizes.values()) <= LARGEST, [f"{path.name}: {size}" for path, size in largest]


# --- what reacts -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def data():
    text = (paths.FIGURES / PROFILE / f"{_EXPLORER}.js").read_text(encoding="utf-8")
    assert len(text) < 5e6
    return json.loads(text.split("=", 1)[1].rstrip(";\n"))


def drawn(page, number=0):
    """The corners of one structure on the page, (n, 2), from the path of its wall."""
    path = page.locator(".explorer-gallery .explorer-wall").nth(number).get_attribute("d")
    return np.array([[float(x), -float(y)] for x, y in re.findall(r"(-?[\d.e-]+) (-?[\d.e-]+)", path)])


def expected(data, structure, state):
    numbers = np.frombuffer(base64.b64decode(data["points"]), "<i2")
    n = sum(structure["outer"] + structure["cavity"])
    points = numbers[structure["at"] : structure["at"] + 2 * n * data["states"]]
    return points.reshape(data["states"], n, 2)[state] / data["scale"]


def words(entry):
    return ", ".join(f"{value:.3f}" for value in entry["target"])


def set_slider(slider, value):
    """With the keyboard alone: to the left end, then as many steps to the right."""
    slider.focus()
    slider.press("Home")
    for _ in range(value):
        slider.press("ArrowRight")


@pytest.mark.parametrize("width", WIDTHS)
def test_the_explorer_shows_the_structures_of_its_target(browser, data, width):
    with Reader(browser, width, reduced_motion="reduce") as reader:
        page = reader.open("notebooks/22_explorer.html")
        for kind, label in (("height", "Height"), ("width", "Width"), ("area", "Hull area")):
            page.get_by_role("radio", name=label, exact=True).check()
            for number in (len(data["descriptors"][kind]) - 1, 1):
                set_slider(page.locator(".explorer-target input"), number)
                entry = data["descriptors"][kind][number]
                assert words(entry) in page.locator(".explorer-status").inner_text()
                figures = page.locator(".explorer-gallery figure")
                assert figures.count() == len(entry["structures"])
                for k, structure in enumerate(entry["structures"]):
                    assert f"{structure['achieved'][0]:.3f}" in figures.nth(k).inner_text()
                    np.testing.assert_allclose(drawn(page, k), expected(data, structure, -1), atol=1e-9)
        assert not reader.complaints
        assert too_wide(page) == []


def test_the_explorer_inflates_and_deflates(browser, data):
    with Reader(browser, reduced_motion="reduce") as reader:
        page = reader.open("notebooks/22_explorer.html")
        entries = data["descriptors"]["height"]
        structure = entries[len(entries) // 2]["structures"][0]
        for state in (0, 4, data["states"] - 1):
            set_slider(page.get_by_label("Load step"), state)
            np.testing.assert_allclose(drawn(page), expected(data, structure, state), atol=1e-9)
        play = page.get_by_role("button", name="Inflate")
        play.press("Enter")
        page.get_by_role("button", name="Stop").wait_for()
        play.wait_for()  # it ends by itself, inflated
        np.testing.assert_allclose(drawn(page), expected(data, structure, -1), atol=1e-9)


def test_a_target_in_the_plane_is_dragged_and_stepped(browser, data):
    entries = data["descriptors"]["box"]
    n = round(len(entries) ** 0.5)
    with Reader(browser, reduced_motion="reduce") as reader:
        page = reader.open("notebooks/22_explorer.html")
        page.get_by_role("radio", name="Height and width").check()
        plane = page.locator(".explorer-plane")
        plane.scroll_into_view_if_needed()
        box = plane.bounding_box()
        dots = page.locator(".explorer-plane .explorer-dot")
        places = [[float(dots.nth(i).get_attribute(name)) for name in ("cx", "cy")] for i in (0, len(entries) - 1)]
        corner, size = np.array([box["x"], box["y"]]), np.array([box["width"], box["height"]])
        first, last = (corner + size * np.array(place) / 100 for place in places)
        page.mouse.move(*first)
        page.mouse.down()
        assert words(entries[0]) in page.locator(".explorer-status").inner_text()
        page.mouse.move(*last, steps=5)
        page.mouse.up()
        assert words(entries[-1]) in page.locator(".explorer-status").inner_text()
        page.get_by_label("Width", exact=True).and_(page.locator("[type=range]")).press("Home")
        one = entries[n * (n - 1)]
        assert words(one) in page.locator(".explorer-status").inner_text()
        if one["structures"]:
            np.testing.assert_allclose(drawn(page), expected(data, one["structures"][0], -1), atol=1e-9)


INFLATED = "/built\\./.test(document.querySelector('.lab-status')?.textContent)"


@pytest.mark.parametrize("name", ["index.html", "laboratory.html"])
def test_the_laboratory_is_ready_soon_on_a_narrow_screen(browser, name):
    with Reader(browser, "phone", "dark", reduced_motion="reduce") as reader:
        reader.page.set_viewport_size({"width": 360, "height": 780})
        seconds = []
        for _ in range(3):  # the quickest, for other programs on the machine do not count
            page = reader.open(name)
            page.wait_for_function(INFLATED)
            seconds.append(page.evaluate("performance.now()") / 1000)
        assert min(seconds) < 3
        assert not reader.complaints
        assert too_wide(page) == []
        page.locator(".lab-drawing").scroll_into_view_if_needed()
        box = page.locator(".lab-drawing").bounding_box()
        page.mouse.move(box["x"] + 0.2 * box["width"], box["y"] + 0.8 * box["height"])
        before = page.locator(".lab-bench .lab-status").inner_text()
        page.mouse.down()
        page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 0.3 * box["height"], steps=5)
        page.mouse.up()
        page.wait_for_function("(said) => document.querySelector('.lab-status').textContent !== said", arg=before)


def test_the_laboratory_draws_and_its_page_is_small(browser):
    with Reader(browser, reduced_motion="reduce") as reader:
        page = reader.open("laboratory.html")
        page.get_by_role("button", name="Draw structures").click()
        page.wait_for_function("/the best misses/.test(document.querySelector('.lab-ask .lab-status').textContent)")
        assert not reader.complaints
        files = {url.partition("?")[0].removeprefix("file://") for url in reader.requests if url.startswith("file:")}
        assert any(file.endswith("laboratory_model.js") for file in files)
        assert sum(Path(unquote(file)).stat().st_size for file in files) < 12e6


@pytest.mark.parametrize("missing", ["WebAssembly", "Worker"])
def test_without_what_the_laboratory_needs_the_explorer_is_shown(browser, missing):
    with Reader(browser, reduced_motion="reduce") as reader:
        reader.page.add_init_script(f"delete window.{missing}")
        page = reader.open("laboratory.html")
        page.locator(".inflate-lab .explorer-gallery figure").first.wait_for()
        assert missing.lower() in page.locator(".inflate-lab").inner_text().lower()
        assert not reader.complaints


def test_the_forward_slider_moves_from_image_to_noise(desktop):
    page = desktop.open("notebooks/01_forward_process.html")
    slider = page.locator(".forward-slider input")

    def pixels():
        code = "c => [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].filter((_, i) => i % 4 === 0)"
        return np.array(page.locator(".forward-slider canvas").evaluate(code), dtype=float)

    slider.press("Home")
    clean = pixels()
    assert (clean < 20).mean() > 0.5, "most of a clean image is black"
    assert "1.000 times the image, 0.000 times the noise" in page.locator(".forward-slider").inner_text()
    slider.press("End")
    noise = pixels()
    assert "0.000 times the image, 1.000 times the noise" in page.locator(".forward-slider").inner_text()
    assert abs(np.corrcoef(clean, noise)[0, 1]) < 0.2


def test_without_scripts_there_is_still_a_picture(browser):
    with Reader(browser, java_script_enabled=False) as reader:
        reader.page.goto((HTML / "laboratory.html").as_uri())
        assert "runs no scripts" in reader.page.locator("article noscript").inner_text()
        assert reader.page.locator("article noscript img").evaluate("(i) => i.naturalWidth") > 500
        reader.page.goto((HTML / "notebooks" / "22_explorer.html").as_uri())
        assert "runs no scripts" in reader.page.locator("article noscript").first.inner_text()
        assert reader.page.locator("#fig-explorer-sheet img").is_visible()
        assert not reader.page.locator(".design-explorer").is_visible()


def test_a_page_with_equations_prints(browser, tmp_path):
    """The way of `make pdf`, on one chapter; the whole book takes minutes."""
    target = tmp_path / "chapter.pdf"
    _print_page(_find_chromium(), HTML / "notebooks" / "05_inflation.html", target)
    content = target.read_bytes()
    assert content.startswith(b"%PDF") and content.rstrip().endswith(b"%%EOF")
    assert len(re.findall(rb"/Type\s*/Page\b", content)) >= 5
