"""The laboratory in a real browser, opened from the disk without a network, finds what the library finds."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from inflate_lib import load_model, load_sevens
from inflate_lib.inverse.drawn import continue_drawn

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "helpers"))
import laboratory
from laboratory import N_STRUCTURES, drawn_apart, inflated_apart, opened, pictures

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    pytest.importorskip("playwright.sync_api", reason="NO BROWSER TEST: pip install playwright")
    with opened(tmp_path_factory.mktemp("lab")) as page:
        if page is None:
            pytest.skip("NO BROWSER TEST: no Chromium or Chrome found")
        yield page


@pytest.fixture(scope="module")
def model():
    return load_model("joint")


def status(page, of=".lab-bench"):
    return page.locator(f"{of} .lab-status").text_content()


def wait_for(page, words, of=".lab-bench"):
    page.wait_for_function(
        "([of, words]) => new RegExp(words).test(document.querySelector(`${of} .lab-status`).textContent)",
        arg=[of, words],
    )
    return status(page, of)


def start_from(page, name):
    page.get_by_role("button", name="Clear").click()
    assert wait_for(page, "blank").startswith("Nothing can be inflated. Image is blank")
    page.get_by_label("Start from").select_option(label=name)
    wait_for(page, "can be built")
    return page.locator(".lab-numbers dd").all_text_contents()


def test_two_hundred_structures_inflate_alike(page):
    images = pictures()
    assert len(images) == N_STRUCTURES
    displacements, descriptors, inflated = inflated_apart(page, images)
    assert displacements < 1e-8
    assert descriptors < 1e-8
    assert 120 < inflated < N_STRUCTURES - 20


@pytest.mark.parametrize("purpose", ["quick", "varied"])
def test_the_same_noise_gives_the_same_structures(page, model, purpose):
    row = {name: model.reach[name].values[40] for name in ("outline", "hull_area")}
    axis = model.reach["medial_axis"].values[7]
    for targets in (
        {"height": 1.05},
        {"height": 1.1, "area": 0.8},
        {"stress": 0.2, "width": 0.9},
        {"axis": axis},
        {"outline": row["outline"], "area": row["hull_area"]},
    ):
        assert drawn_apart(page, model, purpose, targets) < 1e-3, targets


@pytest.mark.parametrize(
    "targets",
    [
        {"height": 3.0},
        {"height": 1.0, "width": 1.0, "area": 1.5},
        {"stress": 5.0},
        {"outline": [0.8] * 32},
        {"outline": [0.5] * 32, "height": 1.2},
        {"axis": [[0.02 * k, 0.03 * k] for k in range(30)], "width": 0.3},
    ],
)
def test_what_is_out_of_reach_is_refused_in_the_same_words(page, model, targets):
    with pytest.raises(ValueError, match=r"reach|contradicts") as error:
        model.made_for("quick").draw(targets)
    said = page.evaluate("(targets) => inflateLab.draw(targets).then(String, (error) => error.message)", targets)
    assert said == str(error.value)


def test_structures_are_asked_for_ranked_and_refined(page):
    panel = page.locator(".lab-ask")
    panel.get_by_role("button", name="Draw structures").click()
    wait_for(page, "misses by", ".lab-ask")
    captions = panel.locator(".lab-gallery figcaption").all_text_contents()
    misses = [float(text.split("misses by ")[1].split(" %")[0]) for text in captions if "misses by" in text]
    assert misses
    assert misses == sorted(misses)
    panel.get_by_role("button", name="Take it to the drawing").first.click()
    panel.get_by_role("button", name="Refine the drawing").click()
    refined = wait_for(page, "^After", ".lab-ask")
    assert float(refined.split("miss is ")[1].split(" %")[0]) <= misses[0] + 0.05
    assert page.complaints == []


def test_a_second_click_stops_what_is_computed(page):
    panel = page.locator(".lab-ask")
    panel.get_by_role("button", name="Draw structures").click()
    panel.get_by_role("button", name="Stop").click()
    wait_for(page, "^Stopped", ".lab-ask")
    panel.get_by_role("button", name="Draw structures").click()
    wait_for(page, "misses by|can be built", ".lab-ask")
    assert page.complaints == []


def test_the_page_says_what_came_out(page):
    """Clear the drawing: a sentence. Fill one: it inflates again. Nothing complains."""
    height, *_ = start_from(page, "a seven (2)")
    assert 0.5 < float(height) < 1.5
    assert height in status(page)
    assert page.complaints == []


def test_the_keyboard_draws(page):
    page.get_by_role("button", name="Clear").click()
    page.locator(".lab-drawing").focus()
    for key in ["Space", *["Shift+ArrowDown"] * 8]:
        page.keyboard.press(key)
    page.wait_for_function("document.querySelector('.lab-numbers dd')")
    assert "20 drawn" in page.locator(".lab-drawing").get_attribute("aria-label")
    assert page.locator(".lab-draw [role=status]").text_content() == "Row 23, column 15: drawn"


def test_a_link_opens_the_same_structure(page):
    before = start_from(page, "a drawn structure (1)")
    page.get_by_role("button", name="Link").click()
    address = page.evaluate("location.hash")
    page.evaluate("location.hash = '#lab=broken'")
    wait_for(page, "malformed")
    page.evaluate("(hash) => { location.hash = hash; }", address)
    page.wait_for_function("(dd) => document.querySelector('.lab-numbers dd')?.textContent === dd", arg=before[0])
    assert page.locator(".lab-numbers dd").all_text_contents() == before


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.json", b"{", "The file is no JSON."),
        ("a.json", b'{"format": "other"}', "none of the laboratory's"),
        ("a.json", b'{"format": "inflate-lab 1", "image": ["01"]}', "28 rows of 28 digits"),
        ("a.png", b"no picture", "no picture that this browser can read"),
    ],
)
def test_what_is_no_structure_is_refused_with_a_sentence(page, name, content, said):
    page.locator("input[type=file]").set_input_files({"name": name, "mimeType": "", "buffer": content})
    wait_for(page, said)
    assert page.complaints == []


@pytest.mark.parametrize("size", [(300, 200), (5, 28), (1000, 1000)])
def test_a_picture_of_another_size_is_drawn_smaller(page, tmp_path, size):
    width, height = size
    dark = np.full((height, width), 255, np.uint8)
    dark[height // 5 : height - height // 5, width // 3 : width - width // 3] = 0
    Image.fromarray(dark).save(tmp_path / "picture.png")
    page.locator("input[type=file]").set_input_files(tmp_path / "picture.png")
    wait_for(page, "Inflated it is")
    assert page.complaints == []


def test_a_page_in_the_background_computes(page):
    page.get_by_role("button", name="Clear").click()
    wait_for(page, "blank")
    other = page.context.new_page()
    other.bring_to_front()
    page.evaluate("(hash) => { location.hash = hash; }", f"#lab={'_' * 130}8")
    wait_for(page, "Nothing can be inflated|Inflated it is")
    drawing = page.evaluate("inflateLab.draw({ height: 1.05 }).then((images) => images.length)")
    assert drawing == 1
    other.close()
    page.evaluate("location.hash = ''")


def test_a_ring_is_filled_and_says_so(page):
    row, column = np.mgrid[:28, :28]
    ring = abs(np.hypot(row - 14, column - 14) - 7) < 2
    content = {"format": "inflate-lab 1", "image": ["".join(map(str, line)) for line in ring.astype(int)]}
    page.locator("input[type=file]").set_input_files(
        {"name": "ring.json", "mimeType": "", "buffer": json.dumps(content).encode()}
    )
    assert "hole" in wait_for(page, "filled")


def test_a_saved_structure_opens_again(page, tmp_path):
    before = start_from(page, "a seven (2)")
    with page.expect_download() as download:
        page.get_by_role("button", name="JSON").click()
    download.value.save_as(tmp_path / "structure.json")
    continue_drawn(tmp_path / "structure.json", refine=0)
    page.get_by_role("button", name="Clear").click()
    wait_for(page, "blank")
    page.locator("input[type=file]").set_input_files(tmp_path / "structure.json")
    wait_for(page, "can be built")
    assert page.locator(".lab-numbers dd").all_text_contents() == before


def test_it_costs_little(page, model):
    """In one run beside the library: an inflation at most ten times as long, a drawing at most five times."""
    inflation, drawing = laboratory.cost(page, model, load_sevens("digits", limit=8).images, repeats=2)
    assert inflation["browser"] < min(10 * inflation["python"], 0.060)
    assert drawing["browser"] < min(5 * drawing["python"], 1.0)
    start_from(page, "a seven (2)")
    assert laboratory.stroke_seconds(page) < 0.1
