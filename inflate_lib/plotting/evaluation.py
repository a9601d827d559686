"""Pictures of what the paper leaves out: held-out targets, novelty, baselines, best of n."""

import numpy as np

from inflate_lib.descriptors import DESCRIPTORS, descriptor_matrix, get_descriptor
from inflate_lib.descriptors.registry import registered
from inflate_lib.experiments.metrics import errors
from inflate_lib.plotting.style import COLOURS, figure, picture_axes

# Markers and colours: of the paper's descriptors, then of all others in the order in which they were registered.
_STYLES = (
    ("o", COLOURS.wall),
    ("^", COLOURS.target),
    ("s", COLOURS.medium),
    ("D", COLOURS.high),
    ("v", COLOURS.ink),
    ("P", COLOURS.low),
)


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
            colour = COLOURS.target if place == 0 else COLOURS.wall
            ax.plot([row["low"], row["high"]], [place, place], color=colour, linewidth=2.2, alpha=0.6)
            ax.plot(row["median"], place, "o", color=colour, markersize=5)
        ax.set(title=name, xlabel=f"error ({unit[name]})", xlim=(0, None))
        ax.grid(axis="x", color="#E6E6E6")
    axes[0, 0].set_yticks(range(len(methods)), methods)
    axes[0, 0].invert_yaxis()
    return fig


def plot_selection(tables):
    """Median error of the best of n candidates against n, and against the seconds that they take.

    Parameters
    ----------
    tables : Mapping
        Descriptor → table of :func:`inflate_lib.alternatives.best_of.selection`. Solid marks: ranked by simulation;
        hollow: by the surrogate.
    """
    panels = []
    for error in dict.fromkeys(get_descriptor(name).error for name in tables):
        label = f"median {error.noun} ({error.unit})"
        shown = {name: table for name, table in tables.items() if get_descriptor(name).error is error}
        panels.append((shown, "n", "candidates $n$", label))
        if not any(get_descriptor(name).is_line for name in shown):
            panels.append((shown, "seconds", "core seconds per target", label))
    fig, axes = figure(1, len(panels), height=6.4, squeeze=False)
    for ax, (shown, across, xlabel, ylabel) in zip(axes[0], panels, strict=True):
        for name, table in shown.items():
            marker, colour = _style(name)
            for by, part in table.groupby("by"):
                solid = by == "simulation"
                part = part[np.isfinite(part["median"])]
                ax.plot(part[across], part["median"], "-" if solid else ":", marker=marker, color=colour, markersize=4,
                        markerfacecolor=colour if solid else "white", label=f"{name}, {by}")  # fmt: skip
        if any(len(line.get_xdata()) for line in ax.lines):  # logarithms want something to scale to
            ax.set(xscale="log", yscale="log")
        ax.set(xlabel=xlabel, ylabel=ylabel)
    handles = {}
    for ax in axes[0]:
        handles |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    fig.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=5)
    return fig


def plot_controls(table):
    """Median error against processor time, with intervals; marks and fillings tell the controls apart without colour.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns control, seconds, median, median low, median high, as ``benchmarks/controls.py`` writes them.
    """
    fig, ax = figure(1, 1, height=9.5)
    for (name, rows), mark in zip(table.groupby("control", sort=False), "ov^sDPX*<>ph", strict=False):
        refined, steered = name.startswith("pixel"), "surrogate" in name
        colour = COLOURS.target if refined else COLOURS.medium if steered else COLOURS.wall
        interval = np.abs(rows[["median low", "median high"]].to_numpy().T - rows["median"].to_numpy())
        line = "none" if refined else ":" if steered else "--"  # refined ones differ in two efforts: no line
        ax.errorbar(rows["seconds"], rows["median"], yerr=interval, color=colour, marker=mark, markersize=6,
                    linestyle=line, elinewidth=0.8, linewidth=1.0, markerfacecolor=colour if refined else "white",
                    label=name)  # fmt: skip
    ax.set(xscale="log", yscale="log", xlabel="core seconds per target", ylabel="median error (%)")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    ax.grid(which="major", color="#E6E6E6")
    fig.legend(loc="outside right center")
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


def _style(descriptor):
    order = list(dict.fromkeys([*DESCRIPTORS, *(one.name for one in registered())]))
    return _STYLES[order.index(descriptor) % len(_STYLES)]


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
