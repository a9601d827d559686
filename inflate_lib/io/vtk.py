"""From an inflated structure to a ParaView series."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from inflate_lib._files import hand_out_folder, naming
from inflate_lib.io.pictures import reached_steps, with_ending
from inflate_lib.mechanics import stress
from inflate_lib.mechanics.inflation import Inflation


def write_vtk(result: Inflation, path: str | Path) -> list[Path]:
    """ParaView series: a ``.vtu`` for each load step, t = 0 included, and the ``.pvd`` that lists them with times.

    Point data: ``displacement`` (3). Cell data, means over the Gauss points: ``F``, ``P`` and ``cauchy_stress`` (9, row
    by row, with the components across the plane), ``von_mises``, ``largest_stretch``, and ``shear_modulus``, μ.

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

    Raises
    ------
    ValueError
        For another suffix, and where no load step has an equilibrium.
    OSError
        Where a file cannot be written, or would replace one that is not as this library wrote it; none is left behind
        then.
    """
    import meshio

    steps = reached_steps(result)
    files = vtk_files(path, steps)
    pvd, *series = files
    points = np.column_stack([result.nodes, np.zeros(len(result.nodes))])
    fields = _cell_fields(result)
    collection = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    listed = ElementTree.SubElement(collection, "Collection")
    with hand_out_folder(pvd.parent) as folder:
        for step, file in enumerate(series):
            step = min(step, steps)  # the last one twice, where it is asked for by name
            displacement = np.zeros_like(points)
            if step:
                displacement[:, :2] = result.displacement[step - 1]
            cells = [("quad", result.cells)]
            cell_data = {name: [values[step]] for name, values in fields.items()}
            with naming(file):
                meshio.Mesh(points, cells, {"displacement": displacement}, cell_data).write(
                    folder / file.name, file_format="vtu"
                )
        for step, file in enumerate(series[: steps + 1]):
            time = result.load_steps[step - 1] if step else 0.0
            ElementTree.SubElement(listed, "DataSet", timestep=f"{time:.12g}", part="0", file=file.name)
        ElementTree.indent(collection)
        with naming(pvd):
            ElementTree.ElementTree(collection).write(folder / pvd.name, encoding="utf-8", xml_declaration=True)
    return files


def vtk_files(path, n_steps):
    """What :func:`write_vtk` writes, and in which order; a ValueError where the name has another ending."""
    asked = with_ending(path, ".pvd", ".vtu")
    series = [asked.with_name(f"{asked.stem}_{step:03d}.vtu") for step in range(n_steps + 1)]
    if asked.suffix.lower() == ".pvd":
        return [asked, *series]
    return [asked.with_suffix(".pvd"), *series, asked]


def _cell_fields(result):
    """(steps + 1, m, …) cell data by name; the first row is the undeformed state."""
    m = len(result.cells)
    sigma = stress.cauchy_stress(result)
    F, P = np.zeros((2, *sigma.shape))
    across = result.stretch_across
    F[..., :2, :2], F[..., 2, 2] = across[..., None, None] * result.deformation_gradient, across
    P[..., :2, :2] = result.first_piola_kirchhoff
    P[..., 2, 2] = sigma[..., 2, 2] * across**2 * stress.area_ratio(result)  # P = J σ F⁻ᵀ

    def rows(tensor, start):
        return np.concatenate([np.broadcast_to(start.ravel(), (1, m, 9)), tensor.mean(axis=2).reshape(-1, m, 9)])

    return {
        "F": rows(F, np.eye(3)),
        "P": rows(P, np.zeros((3, 3))),
        "cauchy_stress": rows(sigma, np.zeros((3, 3))),
        "von_mises": np.concatenate([np.zeros((1, m)), stress.von_mises(result)]),
        "largest_stretch": np.concatenate([np.ones((1, m)), stress.largest_stretch(result)]),
        "shear_modulus": np.broadcast_to(result.lame[1] * result.mesh.stiffness, (len(across) + 1, m)),
    }
