"""What the laboratory has to find: structures inflated by `inflate_lib`, written to `reference.json` beside this file.

Run it where solver, labels or descriptors of the library have changed: `python lab/tests/write_reference.py`.
The structures are embedded digits, drawings of our model, and junk; no image of MNIST is among them.
"""

import base64
import json
from pathlib import Path

import numpy as np

from inflate_lib import describe, inflate, label_image, load_model, load_sevens
from inflate_lib.descriptors import get_descriptor
from inflate_lib.inverse.adjoint import flip_changes, sensitivities
from inflate_lib.mechanics import find_flaw, self_contact
from inflate_lib.structures.labels import stages

OPTIONS = (
    {},
    {"clamped": "left"},
    {"element": "q1"},
    {"pressure": 0.02},
    {"lame": (5.0, 0.5), "n_steps": 4},
    {"pressure": 0.3},
    {"clamped": "top", "time_limit": 0.002},
)


def images():
    """(name, uint8 image) of each structure."""
    sevens = load_sevens("digits", limit=6).images
    yield from ((f"digit {i}", image) for i, image in enumerate(sevens))
    drawn = load_model("joint").made_for("quick").draw({"height": 1.05}, 6, seed=3)
    yield from ((f"drawn {i}", image) for i, image in enumerate((255 * drawn).round().astype(np.uint8)))
    row, column = np.mgrid[:28, :28]
    radius = np.hypot(row - 13.5, column - 13.5)
    junk = {
        "blank": radius < 0,
        "dim": 0.4 * (radius < 5),
        "speck": radius < 1.5,
        "too wide": (row > 10) & (row < 15),
        "full": radius >= 0,
        "ring": (radius < 11) & (radius > 9),
        "two pieces": (radius < 6) | ((row < 3) & (column < 3)),
        "line": (row == 14) & (column > 3) & (column < 24),
        "two towers": (row > 8) & ((abs(column - 6) < 3) | (abs(column - 20) < 3))
        | (abs(row - 9) < 2) & (abs(column - 13) < 9),
    }
    yield from ((name, (255 * image).astype(np.uint8)) for name, image in junk.items())
    for seed, share in enumerate((0.06, 0.15, 0.3)):
        yield f"noise {seed}", (255 * (np.random.default_rng(seed).random((28, 28)) < share)).astype(np.uint8)


def outcome(image, options):
    """What becomes of an image."""
    edge = {"clamped": options.get("clamped", "bottom")}
    try:
        whole = stages(image, **edge)
        label = label_image(image, **edge)
        result = inflate(label, **options)
    except ValueError as error:
        return {"refusal": str(error)}
    found = {
        "label": base64.b64encode((2 * label).astype(np.uint8).tobytes()).decode(),
        "note": whole.note,
        "converged": result.converged,
        "reason": result.reason,
        "flaw": None if (flaw := find_flaw(result)) is None else flaw.name,
    }
    if result.converged:
        # The last load step to twelve digits; on the way there, where each step ends.
        found["displacement"] = result.displacement[-1].ravel().round(12).tolist()
        found["largest"] = np.abs(result.displacement).max(axis=(1, 2)).tolist()
        found["descriptors"] = {
            k: v for k, v in describe(result).as_dict().items() if k in get_descriptor("joint").parts
        }
        found["self_contact"] = self_contact(result)
    return found


def adjoint(image):
    """Sensitivities and estimated changes of height, width and area of one structure."""
    label = label_image(image)
    result = inflate(label)
    found = {}
    for name in ("height", "width", "area"):
        sensitivity = sensitivities(result, get_descriptor(name).gradient)
        change = flip_changes(label, sensitivity)
        found[name] = {"sensitivity": sensitivity.tolist(), "cavity": change[label == 1].tolist()}
    return found


def main():
    """Write the file."""
    cases = []
    for i, (name, image) in enumerate(images()):
        options = OPTIONS[i % len(OPTIONS)] if i % 2 else {}
        told = {"steps" if k == "n_steps" else "timeLimit" if k == "time_limit" else k: v for k, v in options.items()}
        packed = base64.b64encode(image.tobytes()).decode()
        cases.append({"name": name, "image": packed, "options": told} | outcome(image, options))
    first = next(image for name, image in images() if name == "drawn 0")
    content = {"cases": cases, "adjoint": {"image": base64.b64encode(first.tobytes()).decode()} | adjoint(first)}
    (Path(__file__).parent / "reference.json").write_text(json.dumps(content, separators=(",", ":")) + "\n")
    print({case["name"]: case.get("refusal") or case["reason"] or case["flaw"] or "inflates" for case in cases})


if __name__ == "__main__":
    main()
