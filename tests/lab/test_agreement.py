"""The laboratory in a real browser, opened from the disk without a network, finds what the library finds."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from inflate_lib import describe, inflate, inverse, label_image, load_model, load_sevens
from inflate_lib.inverse.drawn import continue_drawn, read_drawn
from inflate_lib.io.pictures import read_images

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "helpers"))
import laboratory
from laboratory import N_STRUCTURES, drawn_apart, inflated_apart, opened, pictures

pytestmark = pytest.mark.slow
#: Other numbers are shown than those given.
NEW = """(before) => {
  const dd = [...document.querySelectorAll(".lab-numbers dd")].map((one) => one.textContent);
  return dd.length && dd.join() !== before.join();
}"""


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


def set_slider(slider, value):
    slider.evaluate("(s, value) => { s.value = value; s.dispatchEvent(new Event('input', { bubbles: true })); }", value)


def open_file(page, content, name="file.json"):
    told = content if isinstance(content, bytes) else json.dumps(content).encode()
    page.locator("input[type=file]").set_input_files({"name": name, "mimeType": "", "buffer": told})


def drawing(cavity, **others):
    """A cavity (28, 28) as a file of the laboratory."""
    rows = ["".join(map(str, line)) for line in np.asarray(cavity).astype(int)]
    return {"format": "inflate-lab 1", "image": rows, **others}


def has_colour(page, selector, rgb):
    """Whether a canvas shows pixels of this very colour."""
    return page.locator(selector).evaluate(
        """(canvas, rgb) => {
          const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
          copy.drawImage(canvas, 0, 0);
          const { data } = copy.getImageData(0, 0, canvas.width, canvas.height);
          for (let k = 0; k < data.length; k += 4) if (rgb.every((value, c) => data[k + c] === value)) return true;
          return false;
        }""",
        rgb,
    )


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
    panel.get_by_role("button", name="Edit this one").first.click()
    panel.get_by_role("button", name="Refine the drawing").click()
    refined = wait_for(page, "^After", ".lab-ask")
    assert float(refined.split("miss is ")[1].split(" %")[0]) <= misses[0] + 0.05
    assert ("Pixels that were changed: row" in refined) == has_colour(page, ".lab-drawing", [230, 159, 0])
    assert page.complaints == []


def test_noise_turns_into_structures_before_the_readers_eyes(page):
    """Every state of the way is painted, several structures at a time, and stays for frames of the screen."""
    page.emulate_media(reduced_motion="no-preference")
    page.evaluate(
        """() => {
          window.seen = [];
          const look = () => {
            const film = [...document.querySelectorAll(".lab-gallery canvas")].filter((c) => c.width === 28);
            const state = film.map((c) => c.toDataURL()).join(" ");
            if (film.length === 3 && state !== window.seen.at(-1)) window.seen.push(state);
            if (window.seen) requestAnimationFrame(look);
          };
          requestAnimationFrame(look);
        }"""
    )
    panel = page.locator(".lab-ask")
    set_slider(panel.get_by_label("Structures"), 3)
    panel.get_by_role("button", name="Draw structures").click()
    wait_for(page, "misses by|can be built", ".lab-ask")
    seen = page.evaluate("() => { const { seen } = window; delete window.seen; return seen; }")
    page.emulate_media(reduced_motion="reduce")
    steps = int(panel.get_by_label("Steps").input_value())
    assert len(set(seen)) >= min(steps, 5)
    set_slider(panel.get_by_label("Structures"), 4)


def test_a_second_click_stops_a_drawing(page):
    panel = page.locator(".lab-ask")
    draw = panel.get_by_role("button", name="Draw structures")
    draw.evaluate("(button) => { button.click(); button.click(); }")
    wait_for(page, "^Stopped", ".lab-ask")
    draw.click()
    wait_for(page, "misses by|can be built", ".lab-ask")
    assert page.complaints == []


@pytest.mark.parametrize(("button", "shown"), [("Stop", "can be built"), ("Clear", "blank")])
def test_a_second_click_or_a_stroke_stops_a_refinement(page, button, shown):
    """What the reader draws meanwhile stays."""
    panel = page.locator(".lab-ask")
    height = float(start_from(page, "a seven (2)")[0])
    panel.get_by_label("Height: value").fill(str(0.93 * height))
    panel.evaluate(
        """(panel, button) => {
          const status = panel.querySelector(".lab-status");
          new MutationObserver((_, observer) => {
            if (!status.textContent.startsWith("Try")) return;
            observer.disconnect();
            [...document.querySelectorAll("button")].find((one) => one.textContent === button).click();
          }).observe(status, { childList: true });
          panel.querySelectorAll(".lab-buttons button")[1].click();
        }""",
        button,
    )
    wait_for(page, "^Stopped", ".lab-ask")
    wait_for(page, shown)
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
    page.locator(".lab-status").first.click()
    page.locator(".lab-drawing").click()
    page.keyboard.press("ArrowUp")
    assert has_colour(page, ".lab-drawing", [213, 94, 0]), "where the keyboard is, is seen after a click, too"


def shown(page):
    """All that a link and a file restore, as the page would save it now, and what it inflates to."""
    return json.loads(saved(page, "JSON").read_text()), page.locator(".lab-numbers dd").all_text_contents()


def ask_for_everything(page):
    """Each field of the targets, a line dragged and a line drawn among them, and another pressure."""
    panel = page.locator(".lab-ask")
    page.locator(".lab-settings summary").click()
    set_slider(page.get_by_label("Pressure"), 0.008)
    page.locator(".lab-settings summary").click()
    pads = panel.locator(".lab-pad")
    pads.nth(0).scroll_into_view_if_needed()
    drawn, dragged = [(0.3, 0.9), (0.7, 0.9), (0.75, 0.4), (0.5, 0.3), (0.3, 0.4)], [(0.5, 0.6), (0.55, 0.6)]
    for pad, line in ((1, drawn), (0, dragged)):
        box = pads.nth(pad).bounding_box()
        places = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in line]
        page.mouse.move(*places[0])
        page.mouse.down()
        for place in places[1:]:
            page.mouse.move(*place, steps=3)
        page.mouse.up()
    for name, value in (("Height", "1.03"), ("Stress σ/μ", "1.25"), ("Stretch", "1.4")):
        panel.get_by_label(f"{name}: value").fill(value)


def test_a_link_and_a_file_restore_drawing_settings_and_targets(page, tmp_path):
    start_from(page, "a drawn structure (1)")
    ask_for_everything(page)
    wait_for(page, "can be built")
    before = content, numbers = shown(page)
    assert {*content["targets"]} == {"height", "stress", "stretch", "axis", "outline"}
    assert content["targets"]["axis"][15][0] > 0.02
    assert content["settings"]["pressure"] == 0.008
    page.get_by_role("button", name="Link").click()
    address = page.evaluate("location.hash")
    page.evaluate("location.hash = '#lab=broken'")
    assert "malformed" in wait_for(page, "malformed")
    page.evaluate("location.hash = ''")
    page.reload()
    page.wait_for_function(laboratory.READY)
    assert shown(page)[0]["targets"] == {}, "nothing has been asked for"
    for change in ("check", "uncheck"):
        getattr(page.get_by_role("checkbox", name="Height"), change)()
    assert shown(page)[0]["targets"] == {}, "nothing is asked for any longer"
    for restore in (
        lambda: page.evaluate("(hash) => { location.hash = hash; }", address),
        lambda: open_file(page, content),
    ):
        page.get_by_role("button", name="Clear").click()
        wait_for(page, "blank")
        restore()
        page.wait_for_function("(dd) => document.querySelector('.lab-numbers dd')?.textContent === dd", arg=numbers[0])
        assert shown(page) == before
    content["settings"] = {}
    (tmp_path / "structure.json").write_text(json.dumps(content))
    _, targets = read_drawn(tmp_path / "structure.json")
    for name, value in content["targets"].items():
        np.testing.assert_allclose(targets.as_dict()[name], value, atol=1e-12)
    page.evaluate("location.hash = ''")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.json", b"{", "The file is no JSON."),
        ("a.json", b'{"format": "other"}', "none of the laboratory's"),
        ("a.json", b'{"format": "inflate-lab 1", "image": ["01"]}', "28 rows of 28 digits"),
        ("a.json", drawing(np.zeros((28, 28)), targets={"height": -1}), "height must be a positive number"),
        ("a.json", drawing(np.zeros((28, 28)), settings={"pressure": 9}), "pressure must be from 0"),
        ("a.png", b"no picture", "no picture that this browser can read"),
    ],
)
def test_what_is_no_structure_is_refused_with_a_sentence(page, name, content, said):
    open_file(page, content, name)
    wait_for(page, said)
    assert page.complaints == []


@pytest.mark.parametrize(
    ("call", "said"),
    [
        ("label([], { wal: 1 })", "label has no option wal; it has threshold, wall, clamped"),
        ("inflate([], { step: 1 })", "inflate has no option step"),
        ("describe(null)", "result must be what inflate gives"),
        ("draw({ height: 1 }, { guide: 3 })", "draw has no option guide"),
        ("draw({ height: 1 }, { sampler: 'euler' })", "sampler must be one of dpm-solver++, ddim, not euler"),
    ],
)
def test_a_call_from_the_console_is_refused_with_a_sentence(page, call, said):
    refusal = page.evaluate(f"inflateLab.{call}.then(String, (error) => `${{error.name}}: ${{error.message}}`)")
    assert refusal.startswith(f"Refusal: {said}")


@pytest.mark.parametrize(
    ("number", "words", "colour"),
    [(110, "single node", [213, 94, 0]), (45, "Walls cross", [204, 0, 102])],
)
def test_a_flaw_is_marked_and_said(page, number, words, colour):
    """A circle around a joint of one node; the edges of walls that cross."""
    open_file(page, drawing(label_image(pictures()[number]) == 1))
    assert "It cannot be built." in wait_for(page, words)
    assert has_colour(page, "figure:nth-child(2) .lab-view", colour)


def test_settings_change_what_comes_out(page):
    before = start_from(page, "a seven (2)")
    page.locator(".lab-settings summary").click()
    for name, value in (("Pressure", 0.02), ("Lamé λ", 3), ("Lamé μ", 0.3), ("Wall (pixels)", 3)):
        set_slider(page.get_by_label(name), value)
        page.wait_for_function(NEW, arg=before)
        before = page.locator(".lab-numbers dd").all_text_contents()
    for name, value in (("Clamped edge", "left"), ("Element", "q1")):
        page.get_by_label(name).select_option(value)
        page.wait_for_function(NEW, arg=before)
        before = page.locator(".lab-numbers dd").all_text_contents()
    page.get_by_role("button", name="The paper's values").click()
    page.wait_for_function(NEW, arg=before)
    assert shown(page)[0]["settings"] == inverse.drawn._SETTINGS
    page.locator(".lab-settings summary").click()


def test_load_steps_are_played_and_moved(page):
    start_from(page, "a seven (2)")
    step = page.get_by_role("slider", name="Load step")
    page.emulate_media(reduced_motion="no-preference")
    page.get_by_role("button", name="Inflate").click()
    page.get_by_role("button", name="Stop").click()
    page.emulate_media(reduced_motion="reduce")
    assert int(step.input_value()) < 10
    for number in (0, 4):
        set_slider(step, number)
        assert f"load step {number} of 10" in page.locator(".lab-view").nth(1).get_attribute("aria-label")
    page.get_by_role("button", name="Inflate").press("Enter")  # with reduced motion, at once
    assert step.input_value() == "10"


def test_an_outline_is_made_with_the_keyboard_and_refused_with_what_can_be_reached(page):
    outline = page.get_by_role("group", name="Outline")
    outline.locator("summary").press("Enter")
    outline.get_by_label("Height").press("Home")
    outline.get_by_label("Width").press("End")
    assert wait_for(page, "1.350 wide", ".lab-ask").startswith("The outline is 0.500 high")
    page.locator(".lab-ask").get_by_role("button", name="Draw structures").press("Enter")
    assert "nearest reachable target" in wait_for(page, "cannot be reached", ".lab-ask")
    outline.get_by_role("checkbox").uncheck()
    outline.locator("summary").press("Enter")


def test_a_picture_that_is_dropped_is_drawn(page):
    page.get_by_role("button", name="Clear").click()
    wait_for(page, "blank")
    page.locator(".lab-drawing").evaluate(
        """async (target) => {
          const picture = new OffscreenCanvas(90, 90), pen = picture.getContext("2d");
          pen.fillStyle = "#fff"; pen.fillRect(0, 0, 90, 90); pen.fillStyle = "#000"; pen.fillRect(40, 20, 9, 50);
          const files = new DataTransfer();
          files.items.add(new File([await picture.convertToBlob()], "a.png", { type: "image/png" }));
          target.dispatchEvent(new DragEvent("drop", { dataTransfer: files, bubbles: true, cancelable: true }));
        }"""
    )
    assert "can be built" in wait_for(page, "Inflated it is")


@pytest.mark.parametrize("size", [(300, 200), (5, 28), (1000, 1000)])
def test_a_picture_of_another_size_is_drawn_smaller(page, tmp_path, size):
    width, height = size
    dark = np.full((height, width), 255, np.uint8)
    dark[height // 5 : height - height // 5, width // 3 : width - width // 3] = 0
    Image.fromarray(dark).save(tmp_path / "picture.png")
    page.locator("input[type=file]").set_input_files(tmp_path / "picture.png")
    wait_for(page, "Inflated it is")
    assert page.complaints == []


def saved(page, words):
    """What a button of `Save and share` hands out."""
    with page.expect_download() as download:
        page.get_by_role("button", name=words).click()
    return Path(download.value.path())


def test_a_picture_and_an_outline_are_of_the_structure_shown(page):
    """The library inflates the picture to the same height; the outline encloses the wall, in millimetres."""
    height, *_ = start_from(page, "a seven (2)")
    images, _ = read_images(saved(page, "PNG"))
    label = label_image(images[0])
    assert f"{describe(inflate(label)).height:.3f}" == height
    text = saved(page, "SVG (mm)").read_text()
    loops = [np.array(re.findall(r"([\d.]+),([\d.]+)", loop), float) for loop in re.findall(r"M (.*?) Z", text)]
    areas = sorted(abs(x @ (np.roll(y, -1) - np.roll(y, 1))) / 2 for x, y in (loop.T for loop in loops))
    assert 'width="100mm"' in text
    assert areas[-1] - sum(areas[:-1]) == pytest.approx((label == 0.5).sum() * (100 / 28) ** 2, rel=1e-4)


def test_what_is_drawn_stays_where_the_reader_goes_to_a_heading(page):
    start_from(page, "a seven (2)")
    before = shown(page)
    for hash in ("#how-it-works", "#lab=broken"):
        page.evaluate("(hash) => { location.hash = hash; }", hash)
    wait_for(page, "malformed.*can be built")
    assert shown(page) == before
    page.evaluate("location.hash = ''")


def test_what_is_refined_and_saved_is_what_is_drawn_at_that_moment(page):
    """Not what was inflated last."""
    start_from(page, "a seven (2)")
    page.get_by_label("Height: value").fill("1.0")
    page.locator(".lab-bench").evaluate(
        """(bench) => {
          const named = (name) => [...document.querySelectorAll("button")].find((one) => one.textContent === name);
          for (const name of ["Clear", "PNG", "Refine the drawing"]) named(name).click();
        }"""
    )
    assert wait_for(page, "blank", ".lab-ask").startswith("Image is blank")
    wait_for(page, "blank")


def test_stresses_that_can_be_reached_are_said_as_they_are_asked_for(page):
    panel = page.locator(".lab-ask")
    page.evaluate("location.hash = ''")
    panel.get_by_label("Stress σ/μ: value").fill("9")
    panel.get_by_role("button", name="Draw structures").click()
    said = wait_for(page, "out of reach|reached together", ".lab-ask")
    least, most = map(float, re.search(r"stress σ/μ ([\d.]+) to ([\d.]+)", said).groups())
    assert 0.1 < least < 1 < most < 5
    panel.get_by_role("checkbox", name="Stress σ/μ").uncheck()


def test_drawn_structures_are_inflated_with_the_settings_on_the_page(page):
    panel = page.locator(".lab-ask")
    panel.get_by_label("Height: value").fill("1.0")
    open_file(page, drawing(np.zeros((28, 28)), settings={"pressure": 0.014}, targets={"height": 1.0}))
    wait_for(page, "blank")
    panel.get_by_role("button", name="Draw structures").click()
    assert "settings above" in wait_for(page, "the best misses", ".lab-ask")
    miss = float(re.search(r"misses by ([\d.]+) %", status(page, ".lab-ask"))[1])
    panel.get_by_role("button", name="Edit this one").first.click()
    wait_for(page, "can be built")
    height = float(page.locator(".lab-numbers dd").first.text_content())
    assert 100 * abs(height - 1) == pytest.approx(miss, abs=0.11)
    page.locator(".lab-settings summary").click()
    page.get_by_role("button", name="The paper's values").click()
    page.locator(".lab-settings summary").click()


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
    open_file(page, drawing(abs(np.hypot(row - 14, column - 14) - 7) < 2))
    assert "hole" in wait_for(page, "filled")


def test_a_saved_drawing_is_carried_on_as_a_design(page, tmp_path):
    start_from(page, "a seven (2)")
    page.get_by_label("Height: value").fill("1.0")
    content, (height, *_) = shown(page)
    (tmp_path / "structure.json").write_text(json.dumps({**content, "targets": {"height": 1.0}}))
    found = continue_drawn(tmp_path / "structure.json", refine=0)
    assert f"{found.designs[0].shape.height:.3f}" == height


def test_it_costs_little(page, model):
    """In one run beside the library: an inflation at most ten times as long, a drawing at most five times."""
    inflation, drawing = laboratory.cost(page, model, load_sevens("digits", limit=8).images, repeats=2)
    assert inflation["browser"] < min(10 * inflation["python"], 0.060)
    assert drawing["browser"] < min(5 * drawing["python"], 1.0)
    start_from(page, "a seven (2)")
    assert laboratory.stroke_seconds(page) < 0.1
