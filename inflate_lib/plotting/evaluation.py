"""Pictures of what the paper leaves out: held-out targets, novelty, baselines, best of n."""

from itertools import cycle

import numpy as np

from inflate_lib.descriptors import descriptor_matrix, get_descriptor
from inflate_lib.experiments.metrics import errors
from inflate_lib.plotting.style import COLOURS, figure, logarithmic, picture_axes


def plot_held_out(experiments):
    """Achieved against target for held-out targets, one dot per target; of axes, the distribution of distances.

    Parameters
    ----------
    experiments : Mapping
        Descriptor → experiment with one structure per target.
    """
    shown = sorted(map(get_descriptor, experiments), key=lambda one: one.length)
    panels = [(one, column) for one in shown for column in ([0] if one.is_line else range(one.length))]
    fig, axes = figure(-(-len(panels) // 3), 3, height=5.5 * -(-len(panels) // 3), squeeze=False)
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    for ax, (one, column) in zip(axes.flat, panels, strict=False):
        experiment = experiments[one.name]
        valid = experiment["valid"].values
        if one.is_line:
            _distribution(ax, one.error.factor * errors(experiment, one.name)[valid])
            ax.set(title=one.name, xlabel=f"mean {one.error.name} ({one.error.unit})", ylabel="structures")
            continue
        target = experiment["target"].values[valid, column]
        achieved = descriptor_matrix(experiment, one.name)[valid, column]
        ax.plot(target, achieved, "o", markersize=2.5, alpha=0.6)
        _diagonal(ax, np.concatenate([target, achieved]))
        title = f"{one.name} ${one.symbol}$" if one.length == 1 else f"{one.name}: ${one.components[column]}$"
        ax.set(title=title, xlabel="target", ylabel="achieved")
    return fig


def plot_tails(table):
    """Median deviation from the target in each tenth of the targets, with a straight and with a bent calibration.

    ``table`` is a frame with the columns descriptor, calibration ("straight", "bent"), part, from, to, median, and
    median low and high, as ``benchmarks/tails.py`` stores it.
    """
    names = list(dict.fromkeys(table["descriptor"]))
    fig, axes = figure(1, len(names), height=5.5, sharey=True, squeeze=False)
    styles = {"straight": {"color": COLOURS.ghost, "fmt": "s--"}, "bent": {"color": COLOURS.wall, "fmt": "o-"}}
    for ax, name in zip(axes[0], names, strict=True):
        ax.axhline(0, color=COLOURS.ink, linewidth=0.8, linestyle=":")
        for way, style in styles.items():
            rows = table[(table["descriptor"] == name) & (table["calibration"] == way)]
            ends = [rows["median"] - rows["median low"], rows["median high"] - rows["median"]]
            ax.errorbar((rows["from"] + rows["to"]) / 2, rows["median"], ends, label=way, markersize=4, **style)
        ax.set(title=name, xlabel="target")
    axes[0, 0].set_ylabel("median deviation (%)")
    axes[0, 0].legend()
    return fig


def plot_novelty(distances, yardstick):
    """Distance to the nearest training structure: generated (blue outline) beside held-out real ones (grey).

    Parameters
    ----------
    distances : Mapping
        Descriptor → (n,) distances of what was generated for it.
    yardstick : (m,) array_like
        The same of held-out structures.
    """
    fig, axes = figure(1, len(distances), height=5.2, sharey=True, squeeze=False)
    bins = np.linspace(0, 1.02 * np.concatenate([yardstick, *distances.values()]).max(), 26)
    for ax, (name, values) in zip(axes[0], distances.items(), strict=True):
        ax.hist(yardstick, bins, weights=_even(yardstick), color="#D9D9D9", label="held-out, real")
        ax.hist(values, bins, weights=_even(values), histtype="step", color=COLOURS.wall, label="generated")
        ax.set(title=name, xlabel="distance")
    axes[0, 0].set_ylabel("share")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside upper right", ncols=2)
    return fig


def plot_neighbours(images, neighbours, distances, titles=("generated", "nearest")):
    """Images in the upper row, their neighbours in the lower, and their distances between the two."""
    columns = max(8, len(images))  # fewer are no larger
    fig, axes = figure(2, columns, height=2 * 17.0 / columns + 1.0, squeeze=False)
    for ax in axes.flat:
        picture_axes(ax)
    for column, (image, neighbour, distance) in enumerate(zip(images, neighbours, distances, strict=True)):
        axes[0, column].imshow(image, vmin=0, vmax=_white(images))
        axes[1, column].imshow(neighbour, vmin=0, vmax=_white(neighbours))
        axes[0, column].set_xlabel(f"{distance:.3f}")
    for ax, title in zip(axes[:, 0], titles, strict=True):
        ax.set_ylabel(title)
    return fig


def plot_baselines(table, unit):
    """Median error of each way to answer the targets, with its interval, one panel per descriptor.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns descriptor, method, median, low, high.
    unit : Mapping
        Descriptor → unit of its error.
    """
    names, methods = list(dict.fromkeys(table["descriptor"])), list(dict.fromkeys(table["method"]))
    fig, axes = figure(1, len(names), height=5.5, sharey=True, squeeze=False)
    for ax, name in zip(axes[0], names, strict=True):
        here = table[table["descriptor"] == name].set_index("method")
        for place, method in enumerate(methods):
            if method not in here.index:
                continue
            row = here.loc[method]
            style = {"color": COLOURS.target, "marker": "D"} if place == 0 else {"color": COLOURS.wall, "marker": "o"}
            ax.plot([row["low"], row["high"]], [place, place], color=style["color"], linewidth=2.2, alpha=0.6)
            ax.plot(row["median"], place, markersize=5, clip_on=False, zorder=3, **style)
            ax.annotate(f"{row['median']:.2g}", (row["high"], place), (6, 0), textcoords="offset points", va="center")
        widest = here["high"].replace(np.inf, np.nan).max()
        ax.set(title=name, xlabel=f"error ({unit[name]})", xlim=(-0.06 * widest, 1.5 * widest) if widest > 0 else None)
        ax.spines["left"].set_position(("data", 0))
        ax.grid(axis="x", color="#E6E6E6")
    axes[0, 0].set_yticks(range(len(methods)), methods)
    axes[0, 0].invert_yaxis()
    return fig


def plot_selection(tables):
    """Median error of the best of n candidates against n, one panel for each descriptor.

    Parameters
    ----------
    tables : Mapping
        Descriptor → table of :func:`inflate_lib.alternatives.best_of.selection`.
    """
    fig, axes = figure(1, len(tables), height=6.4, squeeze=False)
    styles = {
        "simulation": {"color": COLOURS.wall, "marker": "o", "label": "ranked by simulation"},
        "surrogate": {"color": COLOURS.target, "marker": "^", "linestyle": ":", "label": "ranked by the surrogate"},
    }
    first = {}
    for ax, (name, table) in zip(axes[0], tables.items(), strict=True):
        one = get_descriptor(name)
        for by, part in table[np.isfinite(table["median"])].groupby("by", sort=False):
            ax.plot(part["n"], part["median"], markersize=4, **styles[by])
        if one.error in first:
            ax.sharey(first[one.error])
            ax.tick_params(labelleft=False)
        if len(ax.lines):  # logarithms want something to scale to
            first.setdefault(one.error, ax)
            logarithmic(ax)
            ax.set_xticks([n for n in (1, 4, 16, 50) if n <= table["n"].max()])
        ax.set(title=name, xlabel="candidates $n$")
        if ax is first.get(one.error):
            ax.set_ylabel(f"median {one.error.noun} ({one.error.unit})")
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return fig


def plot_controls(table):
    """Median error against processor time, with intervals: one panel for each kind of control.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns control, seconds, median, median low, median high, as ``benchmarks/controls.py`` writes them.
    """
    kinds = {
        "guidance and choice": ~table["control"].str.contains("surrogate|pixel"),
        "with the surrogate": table["control"].str.contains("surrogate"),
        "pixel by pixel": table["control"].str.startswith("pixel"),
    }
    fig, axes = figure(1, len(kinds), height=8.5, sharex=True, sharey=True)
    looks = list(zip("osD^v", (COLOURS.wall, COLOURS.target, COLOURS.medium, COLOURS.high, COLOURS.ink), strict=True))
    for ax, (kind, here) in zip(axes, kinds.items(), strict=True):
        for (name, rows), (mark, colour) in zip(table[here].groupby("control", sort=False), cycle(looks)):
            interval = np.abs(rows[["median low", "median high"]].to_numpy().T - rows["median"].to_numpy())
            line = "none" if kind == "pixel by pixel" else "--"  # those differ in two efforts: no line
            style = {"color": colour, "marker": mark, "markersize": 5, "linestyle": line, "linewidth": 1}
            label = name.removeprefix(f"{kind}, ")
            ax.errorbar(rows["seconds"], rows["median"], yerr=interval, elinewidth=0.8, label=label, **style)
        ax.set(title=kind, xlabel="core seconds per target")
        ax.grid(which="major", color="#E6E6E6")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2))
    axes[0].set_ylabel("median error (%)")
    logarithmic(axes[0])
    return fig


def plot_surrogate(pairs):
    """What the surrogate predicts against what the simulation finds, for height, width and area.

    Parameters
    ----------
    pairs : Mapping
        Name of a set of structures → {descriptor: (simulated, predicted)}, each (n,); the first set below the others.
    """
    names = [name for name in next(iter(pairs.values())) if get_descriptor(name).length == 1]
    fig, axes = figure(1, len(names), height=6.0)
    for ax, name in zip(axes, names, strict=True):
        everything = []
        for (label, sets), colour, marker in zip(pairs.items(), (COLOURS.ghost, COLOURS.target), "o^", strict=False):
            simulated, predicted = sets[name]
            ax.plot(simulated, predicted, marker, color=colour, markersize=2.5, alpha=0.6, label=label)
            everything += [simulated, predicted]
        _diagonal(ax, np.concatenate(everything))
        ax.set(title=f"{name} ${get_descriptor(name).symbol}$", xlabel="simulated", ylabel="predicted")
    axes[0].legend(loc="upper left")
    return fig


def _distribution(ax, values):
    ax.hist(values, bins=24, color=COLOURS.void, edgecolor=COLOURS.wall, linewidth=0.6)
    if len(values):
        ax.axvline(np.median(values), color=COLOURS.target, linestyle="--", label="median")
        ax.legend()


def _diagonal(ax, values):
    if len(values):
        span = np.array([np.nanmin(values), np.nanmax(values)])
        ax.plot(span, span, "--", color=COLOURS.target, linewidth=1, zorder=1)


def _even(values):
    return np.full(len(values), 1 / max(1, len(values)))


def _white(images):
    return 255 if np.asarray(images).dtype == np.uint8 else 1.0


def plot_frontier(table):
    """Accuracy over variety of ways of sampling, a panel for each descriptor; at the ends of lines the evaluations.

    ``table`` is a frame with the columns descriptor, way, evaluations, R² and variety, as ``benchmarks/sampler.py``
    stores it; those of tuned students begin with "tuned, ". Ways whose names differ in the steps alone are joined by a
    line.
    """
    names = list(dict.fromkeys(table["descriptor"]))
    rows, columns = -(-len(names) // 3), min(3, len(names))
    fig, axes = figure(rows, columns, height=5.8 * rows, squeeze=False)
    for ax in axes.flat[len(names) :]:
        ax.set_axis_off()
    lines = {
        "DDIM, $w = 3$": (r"\d+ steps", COLOURS.wall, "o-"),
        "second order, $w = 5$": (r"second order, w = 5(?:, \d+ steps)?", COLOURS.target, "s--"),
        "tuned student, $w = 5$": (r"tuned, second order, w = 5(?:, \d+ steps)?", COLOURS.medium, "^-."),
        "other": (".*", COLOURS.ghost, "x"),
    }
    near = {"xytext": (3, 3), "textcoords": "offset points", "fontsize": 7}
    for ax, name in zip(axes.flat, names, strict=False):
        left = table[table["descriptor"] == name].sort_values("evaluations")
        for label, (pattern, colour, look) in lines.items():
            mine = left["way"].str.fullmatch(pattern)
            ways, left = left[mine], left[~mine]
            ax.plot(ways["variety"], ways["R²"], look, color=colour, markersize=4, linewidth=1.1, label=label)
            for _, way in ways.iloc[[0, -1][: len(ways)]].iterrows() if label != "other" else ():
                ax.annotate(way["evaluations"], (way["variety"], way["R²"]), color=colour, **near)
        ax.set_title(name)
        ax.margins(x=0.12, y=0.12)
    fig.supxlabel("variety, as a share of the data's", fontsize="medium")
    fig.supylabel("$R^2$", fontsize="medium")
    handles = axes[0, 0].get_legend_handles_labels()
    if len(names) < axes.size:
        axes.flat[-1].legend(*handles, loc="center", fontsize="medium")
    else:
        fig.legend(*handles, loc="outside upper center", ncols=4)
    return fig
