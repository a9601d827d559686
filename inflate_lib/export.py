"""From an inflated structure to what mechanicians look at: stresses, a picture, an animation, a ParaView series.

Stresses follow from P = μ F + φ′(J) cof F of :mod:`inflate_lib.inflation`. Plane strain means F₃₃ = 1, which leaves a
stress across the plane. With φ′J = (P − μ F) : F / 2, the Cauchy stress is

    σ = P Fᵀ / J in the plane,   σ₃₃ = μ / J + φ′   (for one point: λ ln J / J),

and the von Mises stress is that of all of it: √(½ [(σ₁₁ − σ₂₂)² + (σ₂₂ − σ₃₃)² + (σ₃₃ − σ₁₁)²] + 3 σ₁₂²).
"""

import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

#: What a picture can be coloured by: the function of this module, the label of its colour bar, the value at rest.
QUANTITIES = {
    "von-mises": ("von_mises", "von Mises stress", 0.0),
    "stretch": ("largest_stretch", "largest stretch", 1.0),
}


def cauchy_stress(result):
    """(steps, m, 4, 3, 3) Cauchy stress σ at the Gauss points, in the units of λ and μ; zero where none is written.

    Parameters
    ----------
    result : Inflation

    Returns
    -------
    ndarray
        NaN at load steps without equilibrium. With mean dilatation φ′ is the element's, as in the equilibrium.
    """
    F, P, J = result.deformation_gradient, result.first_piola_kirchhoff, _area_ratio(result)
    mu = result.lame[1]
    slope = ((P - mu * F) * F).sum((-1, -2)) / (2 * J)  # φ′
    sigma = np.zeros((*F.shape[:-2], 3, 3))
    sigma[..., :2, :2] = P @ np.swapaxes(F, -1, -2) / J[..., None, None]
    sigma[..., 2, 2] = mu / J + slope
    return sigma


def von_mises(result):
    """(steps, m) von Mises stress of each element, the mean over its Gauss points, with σ₃₃; units of λ and μ."""
    s = cauchy_stress(result)
    normal = np.diagonal(s, axis1=-2, axis2=-1)
    differences = ((normal - np.roll(normal, -1, axis=-1)) ** 2).sum(-1)
    return np.sqrt(differences / 2 + 3 * s[..., 0, 1] ** 2).mean(-1)


def largest_stretch(result):
    """(steps, m) largest principal stretch in the plane of each element, the mean over its Gauss points."""
    F = result.deformation_gradient
    trace = (F**2).sum((-1, -2))  # λ₁² + λ₂²
    J = _area_ratio(result)  # λ₁ λ₂
    return np.sqrt((trace + np.sqrt(np.maximum(trace**2 - 4 * J**2, 0))) / 2).mean(-1)


def peaks(result, step=-1):
    """Peak von Mises stress and largest principal stretch at a load step (the last one by default), of any element.

    They sit in the corners of the cavity and grow as the mesh is refined, without bound in the limit of a sharp corner:
    compare structures on equal meshes.

    Returns
    -------
    (float, float)
        In the units of λ and μ, and a ratio of lengths; NaN where there is no equilibrium.
    """
    at = replace(result, displacement=result.displacement[[step]])
    return float(von_mises(at).max()), float(largest_stretch(at).max())


def _area_ratio(result):
    """(steps, m, 4) J at the Gauss points; not numpy's determinant, which warns where there is no equilibrium."""
    F = result.deformation_gradient
    return F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]


def reached_steps(result):
    """Number of load steps that have an equilibrium; the first ones.

    Raises
    ------
    ValueError
        Where there is none, and so nothing to show.
    """
    n = int(np.isfinite(result.displacement).all(axis=(1, 2)).sum())
    if n == 0:
        raise ValueError(f"nothing to export: {result.reason}")
    return n


def write_picture(result, path, quantity="von-mises"):
    """Picture of the undeformed and the deformed structure, coloured by a quantity.

    Parameters
    ----------
    result : Inflation
        At the last load step that has an equilibrium.
    path : path_like
        Any format that matplotlib writes, by its suffix.
    quantity : {"von-mises", "stretch"}

    Returns
    -------
    Path

    Raises
    ------
    ValueError
        For an unknown quantity or suffix, and where no load step has an equilibrium.
    """
    import matplotlib.pyplot as plt

    from inflate_lib.plotting.mechanics import plot_inflation

    steps = reached_steps(result)
    values, label = _coloured(result, quantity)
    path = _ready(path)
    fig = plot_inflation(result, values[1:], label, steps - 1)
    try:
        fig.savefig(path)
    finally:
        plt.close(fig)
    return path


def write_animation(result, path, quantity="von-mises", frames_per_second=5):
    """Animated GIF of the load steps, from the undeformed structure to the last equilibrium; same arguments."""
    import matplotlib.pyplot as plt
    from matplotlib.animation import PillowWriter

    from inflate_lib.plotting.mechanics import animate_inflation

    steps = reached_steps(result)
    values, label = _coloured(result, quantity)
    path = _ready(path, ".gif")
    fig, animation = animate_inflation(result, values, label, steps)
    try:
        animation.save(path, writer=PillowWriter(fps=frames_per_second), dpi=90)
    finally:
        plt.close(fig)
    return path


def write_vtk(result, path):
    """ParaView series: a ``.vtu`` for each load step, t = 0 included, and the ``.pvd`` that lists them with times.

    Point data: ``displacement`` (3). Cell data, means over the Gauss points: ``F``, ``P`` and ``cauchy_stress`` (9, row
    by row, with the components across the plane), ``von_mises``, ``largest_stretch``.

    Parameters
    ----------
    result : Inflation
        Load steps without an equilibrium are left out.
    path : path_like
        ``name.pvd`` or ``name.vtu``; either way ``name.pvd``, ``name_000.vtu``, ``name_001.vtu``, … are written, and
        with ``name.vtu`` the last load step under that name as well.

    Returns
    -------
    list of Path
        The ``.pvd`` first, then the ``.vtu`` files in the order of time, then ``name.vtu`` if it was asked for.
    """
    import meshio

    asked = _ready(path, ".pvd", ".vtu")
    path = asked.with_suffix(".pvd")
    steps = reached_steps(result)
    points = np.column_stack([result.nodes, np.zeros(len(result.nodes))])
    fields = _cell_fields(result)
    collection = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    listed = ElementTree.SubElement(collection, "Collection")
    written = [path]
    for step in range(steps + 1):
        displacement = np.zeros_like(points)
        if step:
            displacement[:, :2] = result.displacement[step - 1]
        file = path.with_name(f"{path.stem}_{step:03d}.vtu")
        cells = [("quad", result.cells)]
        cell_data = {name: [values[step]] for name, values in fields.items()}
        meshio.Mesh(points, cells, {"displacement": displacement}, cell_data).write(file)
        time = result.load_steps[step - 1] if step else 0.0
        ElementTree.SubElement(listed, "DataSet", timestep=f"{time:.12g}", part="0", file=file.name)
        written.append(file)
    ElementTree.indent(collection)
    ElementTree.ElementTree(collection).write(path, encoding="utf-8", xml_declaration=True)
    if asked.suffix.lower() == ".vtu":
        written.append(Path(shutil.copy(written[-1], asked)))
    return written


def _cell_fields(result):
    """(steps + 1, m, …) cell data by name; the first row is the undeformed state."""
    m = len(result.cells)
    sigma = cauchy_stress(result)
    F, P = np.zeros((2, *sigma.shape))
    F[..., :2, :2], F[..., 2, 2] = result.deformation_gradient, 1.0
    P[..., :2, :2] = result.first_piola_kirchhoff
    P[..., 2, 2] = sigma[..., 2, 2] * _area_ratio(result)  # P = J σ F⁻ᵀ, and F₃₃ = 1

    def rows(tensor, start):
        return np.concatenate([np.broadcast_to(start.ravel(), (1, m, 9)), tensor.mean(axis=2).reshape(-1, m, 9)])

    return {
        "F": rows(F, np.eye(3)),
        "P": rows(P, np.zeros((3, 3))),
        "cauchy_stress": rows(sigma, np.zeros((3, 3))),
        "von_mises": np.concatenate([np.zeros((1, m)), von_mises(result)]),
        "largest_stretch": np.concatenate([np.ones((1, m)), largest_stretch(result)]),
    }


def _coloured(result, quantity):
    """Values (steps + 1, m) of a quantity, the undeformed state first, and its label."""
    if quantity not in QUANTITIES:
        raise ValueError(f"colour must be one of {', '.join(QUANTITIES)}, not {quantity!r}")
    function, label, at_rest = QUANTITIES[quantity]
    values = globals()[function](result)
    return np.concatenate([np.full_like(values[:1], at_rest), values]), label


def _ready(path, *suffixes):
    """`path` with its folder made; a ValueError where the suffix is another one."""
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise ValueError(f"{path}: the name must end with {' or '.join(suffixes)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
