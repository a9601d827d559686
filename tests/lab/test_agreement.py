"""The laboratory in a real browser, opened from the disk without a network, finds what the library finds."""

import time

import numpy as np
import pytest
import torch

from inflate_lib import describe, inflate, label_image, load_model, load_sevens, paths
from inflate_lib.book.pdf import _find_chromium, _sandbox_flags
from inflate_lib.descriptors.registry import name_of
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.diffusion.sampling import noise_images
from inflate_lib.structures.labels import WALL

pytestmark = pytest.mark.slow
N_STRUCTURES = 200


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    chromium = _find_chromium()
    if chromium is None:
        pytest.skip("NO BROWSER TEST: no Chromium or Chrome found")
    sync_api = pytest.importorskip("playwright.sync_api", reason="NO BROWSER TEST: pip install playwright")
    file = tmp_path_factory.mktemp("lab") / "page.html"
    scripts = "".join(
        f'<script src="{path.as_uri()}"></script>' for path in [paths.ROOT / "lab" / "built" / "laboratory.js"]
    )
    file.write_text(f'<!doctype html><html lang="en"><title>Lab</title><div class="inflate-lab"></div>{scripts}</html>')
    with sync_api.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(chromium), args=["--disable-gpu", *_sandbox_flags()])
        context = browser.new_context(offline=True, reduced_motion="reduce")
        context.set_default_timeout(240_000)
        page = context.new_page()
        page.complaints = []
        page.on("console", lambda m: page.complaints.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.goto(file.as_uri())
        page.wait_for_function("document.querySelector('.lab-status').textContent")
        yield page
        browser.close()


def junk(rng, kind):
    """A picture that is no seven: strokes, spots, rings, noise."""
    row, column = np.mgrid[:28, :28]
    y, x = rng.uniform(4, 24, 2)
    radius = np.hypot(row - y, column - x)
    size = rng.uniform(2, 13)
    return [
        (radius < size).astype(float),
        ((radius < size) & (radius > size - rng.uniform(1, 4))).astype(float),
        rng.random((28, 28)) * (rng.random((28, 28)) < rng.uniform(0, 0.4)),
        ((abs(row - y) < 2) | (abs(column - x) < 2)) * rng.uniform(0.3, 1, (28, 28)),
    ][kind]


def pictures():
    """Sevens, sevens with strokes drawn into them, and junk; (200, 28, 28)."""
    rng = np.random.default_rng(0)
    sevens = load_sevens("digits", limit=100).images / 255
    drawn = sevens[:40].copy()
    for image in drawn:
        row, column = rng.integers(4, 20, 2)
        image[row : row + rng.integers(2, 6), column : column + rng.integers(2, 6)] = rng.integers(0, 2)
    others = [junk(rng, k % 4) for k in range(N_STRUCTURES - 140)]
    return np.concatenate([sevens, drawn, others])


def outcome(image):
    """Displacements and descriptors, or the refusal."""
    try:
        label = label_image(image)
        result = inflate(label)
    except ValueError as error:
        return str(error), None, None
    if not result.converged:
        return result.reason, None, None
    return "", result.displacement, describe(result)


IN_BROWSER = """async (images) => {
  const found = [];
  for (const image of images) {
    try {
      const result = await inflateLab.inflate(await inflateLab.label(image));
      const told = { said: result.reason };
      if (result.converged) {
        told.displacement = result.displacement.map((step) => Array.from(step));
        told.descriptors = await inflateLab.describe(result);
      }
      found.push(told);
    } catch (error) { found.push({ said: error.message }); }
  }
  return found;
}"""


def test_two_hundred_structures_inflate_alike(page):
    images = pictures()
    assert len(images) == N_STRUCTURES
    found = []
    for part in np.array_split(images, 10):
        found += page.evaluate(IN_BROWSER, part.tolist())
    inflated = 0
    for k, (image, here) in enumerate(zip(images, found, strict=True)):
        said, displacement, shape = outcome(image)
        assert here["said"] == said, k
        if displacement is None:
            continue
        inflated += 1
        there = np.reshape(here["displacement"], displacement.shape)
        assert np.abs(there - displacement).max() < 1e-8, k
        for name, value in shape.as_dict().items():
            assert np.abs(np.asarray(here["descriptors"][name]) - value).max() < 1e-8, (k, name)
    assert 120 < inflated < N_STRUCTURES - 20


def test_the_same_noise_gives_the_same_structures(page):
    model = load_model("joint").made_for("quick")
    for targets in ({"height": 1.05}, {"height": 1.1, "area": 0.8}, {"stress": 0.2, "width": 0.9}):
        wanted = model.draw(targets, 2, seed=1)
        made = noise_images(seed_for(1, name_of(targets)), range(2), (28, 28), torch.device("cpu"))
        noise = [next(made).ravel().tolist() for _ in range(model.sampling["steps"] + 1)]
        found = page.evaluate(
            """async ([targets, noise]) => (await inflateLab.draw(targets, { n: 2, noise })).map((i) => Array.from(i))""",
            [targets, noise],
        )
        assert np.abs(np.reshape(found, wanted.shape) - wanted).max() < 1e-3, targets


@pytest.mark.parametrize("targets", [{"height": 3.0}, {"height": 1.0, "width": 1.0, "area": 1.5}, {"stress": 5.0}])
def test_what_is_out_of_reach_is_refused_in_the_same_words(page, targets):
    with pytest.raises(ValueError, match="reach|contradicts") as error:
        load_model("joint").made_for("quick").draw(targets)
    said = page.evaluate("(targets) => inflateLab.draw(targets).then(String, (error) => error.message)", targets)
    assert said == str(error.value)


def test_structures_are_asked_for_ranked_and_refined(page):
    panel = page.locator(".lab-ask")
    panel.get_by_role("button", name="Draw structures").click()
    page.wait_for_function("/misses by/.test(document.querySelector('.lab-ask .lab-status').textContent)")
    captions = panel.locator(".lab-gallery figcaption").all_text_contents()
    misses = [float(text.split("misses by ")[1].split(" %")[0]) for text in captions if "misses by" in text]
    assert misses
    assert misses == sorted(misses)
    panel.get_by_role("button", name="Take it to the drawing").first.click()
    panel.get_by_role("button", name="Refine the drawing").click()
    page.wait_for_function("/^After/.test(document.querySelector('.lab-ask .lab-status').textContent)")
    refined = panel.locator(".lab-status").text_content()
    assert float(refined.split("miss is ")[1].split(" %")[0]) <= misses[0] + 0.05
    assert page.complaints == []


def test_the_page_says_what_came_out(page):
    """Clear the drawing: a sentence. Fill one: it inflates again. Nothing complains."""
    status = page.locator(".lab-status")
    page.get_by_role("button", name="Clear").click()
    page.wait_for_function("document.querySelector('.lab-status').textContent.includes('blank')")
    assert status.text_content().startswith("Nothing can be inflated. Image is blank")
    page.get_by_label("Start from").select_option(label="a seven (2)")
    page.wait_for_function("document.querySelector('.lab-status').textContent.includes('can be built')")
    assert float(page.locator(".lab-numbers dd").first.text_content()) > 0.5
    assert page.complaints == []


def test_the_keyboard_draws(page):
    page.get_by_role("button", name="Clear").click()
    page.locator(".lab-drawing").focus()
    for key in ["Space", *["Shift+ArrowDown"] * 8]:
        page.keyboard.press(key)
    page.wait_for_function("document.querySelector('.lab-numbers dd')")
    assert "18 drawn" in page.locator(".lab-drawing").get_attribute("aria-label") or "20 drawn" in page.locator(
        ".lab-drawing"
    ).get_attribute("aria-label")


def test_a_link_opens_the_same_structure(page):
    page.get_by_label("Start from").select_option(label="a drawn structure (1)")
    page.wait_for_function("document.querySelector('.lab-status').textContent.includes('can be built')")
    before = page.locator(".lab-numbers dd").all_text_contents()
    page.get_by_role("button", name="Link").click()
    address = page.evaluate("location.hash")
    page.evaluate("location.hash = '#lab=broken'")
    page.wait_for_function("document.querySelector('.lab-status').textContent.includes('malformed')")
    page.evaluate("(hash) => { location.hash = hash; }", address)
    page.wait_for_function("(dd) => document.querySelector('.lab-numbers dd')?.textContent === dd", arg=before[0])
    assert page.locator(".lab-numbers dd").all_text_contents() == before


def test_an_inflation_costs_little(page):
    """At most ten times the library's time, in one run beside it."""
    labels = [label_image(image) for image in load_sevens("digits", limit=20).images]
    assert all((label == WALL).any() for label in labels)
    timed = """async (labels) => {
      for (const label of labels) await inflateLab.inflate(label);
      const start = performance.now();
      for (const label of labels) await inflateLab.inflate(label);
      return (performance.now() - start) / 1000;
    }"""
    ratios = []
    for _ in range(3):
        start = time.perf_counter()
        for label in labels:
            inflate(label)
        python = time.perf_counter() - start
        ratios.append(page.evaluate(timed, [label.tolist() for label in labels]) / python)
    assert min(ratios) < 10
