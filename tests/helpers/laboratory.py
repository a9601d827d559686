"""The laboratory in a real browser, opened from the disk with the network off, beside the library."""

import json
import time
from contextlib import contextmanager, suppress

import numpy as np
import psutil

from inflate_lib import describe, inflate, label_image, load_sevens, paths
from inflate_lib.book.pdf import _find_chromium, _sandbox_flags
from inflate_lib.descriptors.registry import name_of
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.diffusion.sampling import noise_images

N_STRUCTURES = 200
READY = "/built\\./.test(document.querySelector('.lab-status')?.textContent)"  # something has been inflated
#: Asks for structures by given noise, {n, purpose, noise} beside the targets.
_DRAWN = """async (told) => {
  const images = await inflateLab.draw(...JSON.parse(told));
  return JSON.stringify(images.map((image) => Array.from(image)));
}"""
_INFLATED = """async (images) => {
  const found = [];
  for (const image of JSON.parse(images)) {
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
  return JSON.stringify(found);
}"""


def _called(page, function, *told):
    """What a function of the page makes of JSON; Playwright's own way takes long for many numbers."""
    return json.loads(page.evaluate(function, json.dumps(told if len(told) > 1 else told[0])))


@contextmanager
def opened(folder, small=False, **options):
    """A page in `folder` with nothing but the laboratory, in Chromium; None where there is no browser.

    `page.complaints` lists what the console was told. `options` are those of a browser's context.
    """
    chromium = _find_chromium()
    if chromium is None:
        yield None
        return
    from playwright.sync_api import sync_playwright

    file, script = folder / "page.html", (paths.ROOT / "lab" / "built" / "laboratory.js").as_uri()
    place = f'<div class="inflate-lab"{" data-small" * small}></div><script src="{script}"></script>'
    file.write_text(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>Laboratory</title><main>{place}</main></html>"
    )
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(chromium), args=["--disable-gpu", *_sandbox_flags()])
        context = browser.new_context(**{"offline": True, "reduced_motion": "reduce", **options})
        context.set_default_timeout(240_000)
        page = context.new_page()
        page.complaints = []
        page.on("console", lambda m: page.complaints.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.goto(file.as_uri())
        page.wait_for_function(READY)
        yield page
        browser.close()


def _junk(rng, kind):
    """A picture that is no seven: a spot, a ring, noise, a cross."""
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


def pictures(n=N_STRUCTURES):
    """Sevens, sevens with something drawn into them, and junk; (n, 28, 28)."""
    rng = np.random.default_rng(0)
    sevens = load_sevens("digits", limit=n // 2).images / 255
    drawn = sevens[: n // 5].copy()
    for image in drawn:
        row, column = rng.integers(4, 20, 2)
        image[row : row + rng.integers(2, 6), column : column + rng.integers(2, 6)] = rng.integers(0, 2)
    others = [_junk(rng, k % 4) for k in range(n - len(sevens) - len(drawn))]
    return np.concatenate([sevens, drawn, others])


def _outcome(image):
    """Displacements and descriptors, or the refusal."""
    try:
        result = inflate(label_image(image))
    except ValueError as error:
        return str(error), None, None
    if not result.converged:
        return result.reason, None, None
    return "", result.displacement, describe(result).as_dict()


def inflated_apart(page, images):
    """How far page and library are apart, and how many inflate: (displacements, descriptors, n); same refusals."""
    found = [one for part in np.array_split(images, 10) for one in _called(page, _INFLATED, part.tolist())]
    displacements, descriptors = [], []
    for k, (image, here) in enumerate(zip(images, found, strict=True)):
        said, displacement, values = _outcome(image)
        assert here["said"] == said, (k, here["said"], said)
        if displacement is None:
            continue
        displacements.append(np.abs(np.reshape(here["displacement"], displacement.shape) - displacement).max())
        descriptors.append(
            max(np.abs(np.asarray(here["descriptors"][name]) - value).max() for name, value in values.items())
        )
    return max(displacements), max(descriptors), len(displacements)


def drawn_apart(page, model, purpose, targets, n=2):
    """How far images of page and library are apart that begin with the same noise."""
    import torch

    model = model.made_for(purpose)
    wanted = model.draw(targets, n, seed=1)
    made = noise_images(seed_for(1, name_of(targets)), range(n), (1, 28, 28), torch.device("cpu"))
    noise = [next(made).ravel().tolist() for _ in range(model.sampling["steps"] + 1)]
    told = {name: np.asarray(value).tolist() for name, value in targets.items()}
    found = _called(page, _DRAWN, told, {"n": n, "purpose": purpose, "noise": noise})
    return np.abs(np.reshape(found, wanted.shape) - wanted).max()


def cost(page, model, images, repeats=5):
    """Seconds of processor time of an inflation and of a drawing, here and in the browser, in turns.

    So other programs on the machine do not count. The browser's is that of all its processes together.
    """
    labels = [label_image(image) for image in images]
    quick = model.made_for("quick")
    told = [label.tolist() for label in labels]

    def inflate_here():
        for label in labels:
            inflate(label)

    return (
        _apiece(
            len(labels),
            repeats,
            inflate_here,
            lambda: page.evaluate(_INFLATE_ALL, told),
        ),
        _apiece(
            5,
            repeats,
            lambda: [quick.draw({"height": 1.05}) for _ in range(5)],
            lambda: page.evaluate(_DRAW_FIVE),
        ),
    )


def _apiece(n, repeats, here, there):
    spent = {"python": [], "browser": []}
    for k in range(repeats + 1):
        for name, task, clock in (("python", here, time.process_time), ("browser", there, _browser_time)):
            start = clock()
            task()
            if k:  # the first time everything is compiled
                spent[name].append((clock() - start) / n)
    return {name: float(np.median(seconds)) for name, seconds in spent.items()}


def _browser_time():
    """Processor time of all processes that this one has started, in seconds."""
    spent = 0.0
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            spent += sum(process.cpu_times()[:2])
    return spent


def stroke_seconds(page, n=8):
    """Processor time of the browser, from a stroke until what it inflates to is shown; the mean of several."""
    page.evaluate(_STROKES, 1)
    start = _browser_time()
    page.evaluate(_STROKES, n)
    return (_browser_time() - start) / n


_INFLATE_ALL = "async (labels) => { for (const label of labels) await inflateLab.inflate(label); }"
_DRAW_FIVE = "async () => { for (let k = 0; k < 5; k++) await inflateLab.draw({ height: 1.05 }); }"
_STROKES = """async (n) => {
  const canvas = document.querySelector(".lab-drawing"), numbers = document.querySelector(".lab-numbers");
  const { left, top, width, height } = canvas.getBoundingClientRect();
  for (let k = 0; k < n; k++) {
    const shown = new Promise((resolve) => {
      const watch = new MutationObserver(() => { watch.disconnect(); resolve(); });
      watch.observe(numbers, { childList: true });
    });
    const place = { pointerId: 1, clientX: left + (0.35 + 0.02 * k) * width, clientY: top + 0.5 * height };
    canvas.dispatchEvent(new PointerEvent("pointerdown", place));
    canvas.dispatchEvent(new PointerEvent("pointerup", place));
    await shown;
  }
}"""
