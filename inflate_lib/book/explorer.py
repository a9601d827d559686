"""Data for the interactive pages of the book, which are drawn in the browser by ``book/_static/explorer.js``.

The explorer shows generated structures as outlines, at rest and at each load step: closed polygons along the boundary
of the wall, in lengths of the unit square, rounded to 10⁻⁴. Pages opened from a disk may not fetch files, so that the
data are a script that sets one variable.
"""

import base64
import json

import numpy as np
from IPython.display import HTML

from inflate_lib.descriptors import descriptor_matrix
from inflate_lib.experiments.metrics import errors
from inflate_lib.mechanics.inflation import inflate
from inflate_lib.mechanics.mesh import boundary_loops

_SCALE = 10_000  # whole numbers per length of the unit square, within 16 bits
_VARIABLE = "inflateExplorer"  # of the script


def outline(result):
    """Boundary polygons of an inflated structure, at rest and at each load step.

    Parameters
    ----------
    result : inflate_lib.mechanics.inflation.Inflation

    Returns
    -------
    lengths : dict
        ``{"outer": [points per loop], "cavity": [points per loop]}``.
    points : (1 + steps, n, 2) int16
        All loops one after the other, outer ones first, in units of 1 / `_SCALE`.

    Raises
    ------
    ValueError
        Where a load step has no equilibrium, or a shape is too large for the format (more than three unit squares).
    """
    if not result.converged:
        raise ValueError(f"the structure has no outline at every load step: {result.reason}")
    pressurised = {tuple(edge) for edge in result.mesh.pressure_edges.tolist()}  # with the cavity on the left
    loops = {"outer": [], "cavity": []}
    for loop in boundary_loops(result.cells):  # with the wall on the left
        loops["cavity" if (loop[1], loop[0]) in pressurised else "outer"].append(loop)
    positions = result.nodes + np.concatenate([np.zeros((1, *result.nodes.shape)), result.displacement])
    points = np.rint(_SCALE * positions[:, np.concatenate(loops["outer"] + loops["cavity"])])
    if np.abs(points).max() > np.iinfo(np.int16).max:
        raise ValueError("the inflated structure is more than three times as large as the frame; it has no outline")
    lengths = {side: [len(loop) for loop in borders] for side, borders in loops.items()}
    return lengths, points.astype(np.int16)


def pick_diverse(images, error, n):
    """Choose few structures that meet their target and differ from one another.

    The first is the one with the smallest error. Each further one is, among the better half, the one whose image is
    farthest from all that were chosen.

    Parameters
    ----------
    images : (m, 28, 28) array_like
    error : (m,) array_like
        NaN where a structure is not valid.
    n : int

    Returns
    -------
    list of int
        Row numbers, `n` or as many as are valid, by increasing error.
    """
    order = np.argsort(error)[: np.isfinite(error).sum()]
    better = order[: max(n, -(-len(order) // 2))]
    flat = np.asarray(images, dtype=float).reshape(len(images), -1)[better]
    picks = [0] if len(better) else []
    while 0 < len(picks) < min(n, len(better)):
        apart = np.linalg.norm(flat[:, None] - flat[picks], axis=-1).min(axis=1)
        apart[picks] = -1
        picks.append(int(apart.argmax()))
    return better[sorted(picks)].tolist()


def scalar_targets(values, n):
    """(n, 1) evenly spaced targets over the range of a descriptor, without the outermost 2 % at either end."""
    low, high = np.quantile(values, [0.02, 0.98])
    return np.linspace(low, high, n)[:, None]


def box_targets(boxes, n):
    """A grid of targets in the plane of height and width that stays where structures are.

    Parameters
    ----------
    boxes : (m, 2) array_like
        Heights and widths of the data set.
    n : int
        Heights, and widths for each of them.

    Returns
    -------
    (n · n, 2) float
        Height by height; the widths of a row span the middle 90 % of the widths of the structures near that height.
    """
    boxes = np.asarray(boxes, dtype=float)
    heights = scalar_targets(boxes[:, 0], n)[:, 0]
    rows = []
    for height in heights:
        near = np.argsort(np.abs(boxes[:, 0] - height))[: max(10, len(boxes) // (2 * n))]
        rows.append(np.linspace(*np.quantile(boxes[near, 1], [0.05, 0.95]), n))
    return np.column_stack([np.repeat(heights, n), np.concatenate(rows)])


def explorer_script(experiments, n_shown, about):
    """The explorer's data as a script.

    Parameters
    ----------
    experiments : dict
        Descriptor → experiment of :func:`inflate_lib.experiments.run.run_experiment`, whose targets are the grid.
    n_shown : int
        Structures kept for each target, see :func:`pick_diverse`.
    about : dict
        Shown on the page: profile, data source, number drawn for each target.

    Returns
    -------
    script : str
        ``window.inflateExplorer = {…}``; the points are base64 of little-endian 16-bit numbers, structure by structure,
        state by state, point by point, x and y.
    content : dict
        What the script says, without the points.
    """
    content, pieces, place = {"scale": _SCALE, "about": about, "descriptors": {}}, [], 0
    for name, experiment in experiments.items():
        error, achieved = errors(experiment, name), descriptor_matrix(experiment, name)
        error = np.where(experiment["valid"].values, error, np.nan)
        level, target = experiment["level"].values, experiment["target"].values
        entries = []
        for k in np.unique(level):
            rows = np.flatnonzero(level == k)
            picks = rows[pick_diverse(experiment["image"].values[rows], error[rows], n_shown)]
            structures = []
            for row in picks:
                lengths, points = outline(inflate(experiment["label"].values[row].astype(float)))
                reached = [round(float(value), 4) for value in achieved[row]]
                structures.append({"achieved": reached, "error": round(float(error[row]), 4), "at": place} | lengths)
                pieces.append(points)
                place += points.size
            wanted = [round(float(value), 4) for value in target[rows[0]]]
            shares = {share: int(experiment[share].values[rows].sum()) for share in ("valid", "buildable")}
            entries.append({"target": wanted} | shares | {"structures": structures})
        content["descriptors"][name] = entries
    content["states"] = len(pieces[0]) if pieces else 0
    points = b"".join(piece.astype("<i2").tobytes() for piece in pieces)
    whole = content | {"points": base64.b64encode(points).decode()}
    return f"window.{_VARIABLE} = {json.dumps(whole, separators=(',', ':'))};\n", content


def forward_slider(states, steps, alpha_bars):
    """A slider over the forward process, as HTML for display; the book's script brings it to life.

    Parameters
    ----------
    states : (k, h, w) array_like
        One image after so many noising steps, in [−1, 1]; what lies beyond is clipped.
    steps : sequence of int
        The k numbers of steps.
    alpha_bars : sequence of float
        ᾱ_t at those steps.

    Returns
    -------
    IPython.display.HTML
        Nothing is shown where scripts do not run.
    """
    states = np.asarray(states, dtype=float)
    pixels = np.rint(127.5 * (states.clip(-1, 1) + 1)).astype(np.uint8)
    attributes = {
        "pixels": base64.b64encode(pixels.tobytes()).decode(),
        "size": " ".join(map(str, pixels.shape[1:])),
        "steps": " ".join(map(str, steps)),
        "alpha-bars": " ".join(f"{value:.6g}" for value in alpha_bars),
    }
    text = " ".join(f'data-{name}="{value}"' for name, value in attributes.items())
    return HTML(f'<div class="forward-slider" {text}></div>')
