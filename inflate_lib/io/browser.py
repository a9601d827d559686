"""A model as the laboratory in the page takes it: weights, calibrations and reach in one script.

A page opened from a disk may fetch nothing, so the script sets a variable. What is drawn in the browser comes from the
very weights: the 16-bit numbers of the committed file, and their fingerprint.
"""

import base64
import json
import re
from pathlib import Path

import numpy as np

from inflate_lib import paths
from inflate_lib._files import check_outputs, draft
from inflate_lib.descriptors import POINT_DISTANCE, descriptor_matrix, get_descriptor
from inflate_lib.models.weights import Model

FILE = paths.ROOT / "lab" / "built" / "laboratory_model.js"
_HEAD = "window.inflateModel = "
_WAYS = ("quick", "varied")  # purposes, all answered by the network of the first
_NETWORK = ("channels", "embedding", "blocks", "conditioning", "objective", "T", "strongest")


def model_script(model: Model, profile: str) -> str:
    """The script of a model of several parts, the joint one, as it draws for designs: its student, where it has one.

    Raises
    ------
    ValueError
        Its network has what the laboratory's lacks, or it has no parts to ask for.
    """
    ways = {purpose: model.made_for(purpose) for purpose in _WAYS}
    model = ways["quick"]
    config = model.trained.config
    if config.attention or not config.parts:
        raise ValueError(f"the {model.name} model has {'attention' if config.attention else 'no parts'}")
    if model.reach is None:
        raise ValueError(f"the {model.name} model says nothing about what can be reached")
    tensors, pieces, at = [], [], 0
    for name, value in model.trained.net.state_dict().items():
        tensors.append({"name": name, "shape": list(value.shape), "at": at})
        pieces.append(value.half().numpy().astype("<f2").tobytes())
        at += value.numel()
    content = {
        "fingerprint": model.trained.fingerprint,
        "profile": profile,
        "config": {name: config.as_dict()[name] for name in _NETWORK},
        "groups": model.trained.net.norm.num_groups,
        "parts": [{"name": name, "length": get_descriptor(name).length} for name in model.takes],
        "conditionMin": model.trained.condition_min.tolist(),
        "conditionMax": model.trained.condition_max.tolist(),
        "ways": {
            purpose: {"sampling": dict(way.sampling), "calibrations": _calibrations(way)}
            for purpose, way in ways.items()
            if way.trained.fingerprint == model.trained.fingerprint
        },
        "tensors": tensors,
        "weights": base64.b64encode(b"".join(pieces)).decode(),
        "reach": _reach(model),
    }
    return f"{_HEAD}{json.dumps(content, separators=(',', ':'))};\n"


def export(model: Model, profile: str, file: Path) -> Path:
    """Write the script of a model; a file of the same name that is none is an OSError, and stays."""
    check_outputs([file], ours=lambda there: fingerprint(there) is not None)
    script = model_script(model, profile)
    with draft(file) as place:
        place.write_text(script, encoding="ascii")
    return file


def fingerprint(file: Path) -> str | None:
    """Of the weights in a script; None where it is no such script."""
    try:
        found = re.match(re.escape(_HEAD) + r'\{"fingerprint":"(\w+)"', Path(file).read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
    return found[1] if found else None


def _calibrations(model):
    return {
        "+".join(get_descriptor(name).parts): calibration.as_dict() for name, calibration in model.calibrations.items()
    }


def _reach(model):
    """Descriptors of the structures, each component as 16-bit shares of the way from the least to the most.

    The points of an axis stand at equal increments of the height, so that what they reach sideways is enough.
    """
    columns, pieces = [], []
    for name in model.takes:
        values = descriptor_matrix(model.reach, name)
        if get_descriptor(name).error is POINT_DISTANCE:
            values = values[:, ::2]
        least, most = values.min(axis=0), values.max(axis=0)
        shares = (values - least) / np.where(most > least, most - least, 1)
        pieces.append(np.rint(65535 * shares).astype("<u2").T.tobytes())
        columns.append({"name": name, "length": values.shape[1], "least": least.tolist(), "most": most.tolist()})
    return {
        "structures": model.reach.sizes["structure"],
        "columns": columns,
        "table": base64.b64encode(b"".join(pieces)).decode(),
    }
