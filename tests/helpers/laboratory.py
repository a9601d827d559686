"""The laboratory in a real browser, opened from the disk with the network off, beside the library."""

import time
from contextlib import contextmanager

import numpy as np

from inflate_lib import describe, inflate, label_image, load_sevens, paths
from inflate_lib.book.pdf import _find_chromium, _sandbox_flags
from inflate_lib.descriptors.registry import name_of
from inflate_lib.diffusion.randomness import seed_for
from inflate_lib.diffusion.sampling import noise_images

N_STRUCTURES = 200
READY = "/built\\./.test(document.querySelector('.lab-status')?.textContent)"  # something has been inflated
#: Asks for structures by given noise, {n, purpose, noise} beside the targets.
_DRAWN = "async ([targets, options]) => (await inflateLab.draw(targets, options)).map((image) => Array.from(image))"
_INFLATED = """async (images) => {
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
    found = [one for part in np.array_split(images, 10) for one in page.evaluate(_INFLATED, part.tolist())]
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
    made = noise_images(seed_for(1, name_of(targets)), range(n), (28, 28), torch.device("cpu"))
    noise = [next(made).ravel().tolist() for _ in range(model.sampling["steps"] + 1)]
    told = {name: np.asarray(value).tolist() for name, value in targets.items()}
    found = page.evaluate(_DRAWN, [told, {"n": n, "purpose": purpose, "noise": noise}])
    return np.abs(np.reshape(found, wanted.shape) - wanted).max()


def cost(page, model, images, repeats=7):
    """Seconds of an inflation and of a drawing, here and in the browser, one after the other on one core.

    Of each structure, and of the drawing, the quickest of several times: other programs on the machine hardly count.
    The browser's clock is that of the wall, Python's that of the processor, which is never behind.
    """
    labels = [label_image(image) for image in images]
    quick = model.made_for("quick")
    inflated = [_quickest(lambda label=label: inflate(label), repeats) for label in labels]
    here = page.evaluate(_TIMED_INFLATIONS, [[label.tolist() for label in labels], repeats])
    drawn = _quickest(lambda: quick.draw({"height": 1.05}), repeats)
    there = page.evaluate(_TIMED_DRAWINGS, repeats)
    return (
        {"python": float(np.median(inflated)), "browser": float(np.median(here)) / 1000},
        {"python": drawn, "browser": there / 1000},
    )


def _quickest(task, repeats):
    task()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        task()
        times.append(time.process_time() - start)
    return min(times)


_TIMED_INFLATIONS = """async ([labels, repeats]) => {
  const best = labels.map(() => Infinity);
  for (let k = 0; k <= repeats; k++)
    for (const [i, label] of labels.entries()) {
      const start = performance.now();
      await inflateLab.inflate(label);
      if (k) best[i] = Math.min(best[i], performance.now() - start);
    }
  return best;
}"""
_TIMED_DRAWINGS = """async (repeats) => {
  let best = Infinity;
  for (let k = 0; k <= repeats; k++) {
    const start = performance.now();
    await inflateLab.draw({ height: 1.05 }, { seed: k });
    if (k) best = Math.min(best, performance.now() - start);
  }
  return best;
}"""
