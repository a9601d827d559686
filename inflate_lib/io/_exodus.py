"""Exodus II files, which MOOSE reads and writes: a mesh with its boundaries out, nodal results back in.

Exodus II is netCDF with agreed names. A mesh is written as netCDF-3 through SciPy (meshio writes Exodus too, but no
side sets, and the pressure acts on one). Results are read as netCDF-3 or netCDF-4 through xarray: MOOSE writes either.
Numbers in the file count from one.
"""

import numpy as np
from scipy.io import netcdf_file
from scipy.spatial import cKDTree

#: Names of the boundaries in the file: a side set of the edges under pressure, a node set of the nodes held.
CAVITY, CLAMPED = "cavity", "clamped"
_NAME = 33  # characters of a name, with the zero at its end


def write_mesh(mesh, path):
    """Write a mesh as element blocks of QUAD4, one for each rubber, with the side set ``cavity`` and the node set
    ``clamped``.

    Parameters
    ----------
    mesh : Mesh
    path : path_like

    Raises
    ------
    ValueError
        For a mesh with nodes that are held in one direction only, which one node set cannot say.
    """
    if mesh.clamped.ndim > 1:
        raise ValueError("mesh: nodes that are held in one direction only cannot be written to an Exodus file")
    elements, sides = _pressure_sides(mesh)
    clamped, found = np.flatnonzero(mesh.clamped), blocks(mesh)
    place = np.argsort(np.concatenate([rows for _, _, rows in found]))  # of a cell among the elements of the file
    sizes = {
        "time_step": None, "len_string": _NAME, "len_name": _NAME, "len_line": 81, "four": 4, "num_dim": 2,
        "num_nodes": len(mesh.nodes), "num_elem": len(mesh.cells), "num_el_blk": len(found),
        "num_side_sets": 1, "num_side_ss1": len(sides), "num_node_sets": 1,
        "num_nod_ns1": len(clamped),
    }  # fmt: skip
    variables = {
        "coordx": ("f8", ["num_nodes"], mesh.nodes[:, 0]),
        "coordy": ("f8", ["num_nodes"], mesh.nodes[:, 1]),
        "coor_names": ("S1", ["num_dim", "len_name"], _names("x", "y")),
        "eb_status": ("i4", ["num_el_blk"], [1] * len(found)),
        "eb_prop1": ("i4", ["num_el_blk"], np.arange(len(found)) + 1),
        "eb_names": ("S1", ["num_el_blk", "len_name"], _names(*(name for name, *_ in found))),
        "ss_status": ("i4", ["num_side_sets"], [1]),
        "ss_prop1": ("i4", ["num_side_sets"], [1]),
        "ss_names": ("S1", ["num_side_sets", "len_name"], _names(CAVITY)),
        "elem_ss1": ("i4", ["num_side_ss1"], place[elements] + 1),
        "side_ss1": ("i4", ["num_side_ss1"], sides + 1),
        "ns_status": ("i4", ["num_node_sets"], [1]),
        "ns_prop1": ("i4", ["num_node_sets"], [2]),  # not the side set's number, so that neither hides
        "ns_names": ("S1", ["num_node_sets", "len_name"], _names(CLAMPED)),
        "node_ns1": ("i4", ["num_nod_ns1"], clamped + 1),
        "time_whole": ("f8", ["time_step"], None),
    }
    for number, (_, _, rows) in enumerate(found, start=1):
        size, corners = f"num_el_in_blk{number}", f"num_nod_per_el{number}"
        sizes |= {size: len(rows), corners: 4}
        variables[f"connect{number}"] = "i4", [size, corners], mesh.cells[rows] + 1
    with netcdf_file(path, "w", version=2) as file:
        file.title = b"wall of an inflatable structure"
        file.api_version, file.version = np.float32(5.14), np.float32(5.14)
        file.floating_point_word_size, file.file_size = np.int32(8), np.int32(1)
        for name, size in sizes.items():
            file.createDimension(name, size)
        for name, (kind, dimensions, values) in variables.items():
            variable = file.createVariable(name, kind, dimensions)
            if values is not None:
                variable[:] = values
        for name in ("eb_prop1", "ss_prop1", "ns_prop1"):
            file.variables[name].name = b"ID"
        for number in range(len(found)):
            file.variables[f"connect{number + 1}"].elem_type = b"QUAD4"


def blocks(mesh):
    """The rubbers of a wall, the softest first: name of the block, stiffness, and the numbers of its cells, (k,).

    One rubber is the block ``wall``; of several, the first is ``rubber_1``.
    """
    stiffness = np.broadcast_to(mesh.stiffness, len(mesh.cells))
    found = [(float(value), np.flatnonzero(stiffness == value)) for value in np.unique(stiffness)]
    names = ["wall"] if len(found) == 1 else [f"rubber_{number + 1}" for number in range(len(found))]
    return [(name, *one) for name, one in zip(names, found, strict=True)]


def _pressure_sides(mesh):
    """Element, (k,) int, and side, (k,) int 0 to 3, of each pressure edge; side s runs from corner s to the next.

    The edges of a mesh run around the cavity, so the side of the element is the same edge the other way round.
    """
    start, end = mesh.cells.ravel(), np.roll(mesh.cells, -1, axis=1).ravel()
    n = len(mesh.nodes)
    order = np.argsort(start * n + end)
    wanted = mesh.pressure_edges[:, 1] * n + mesh.pressure_edges[:, 0]
    found = order[np.searchsorted((start * n + end)[order], wanted)]
    return np.divmod(found, 4)


def read_displacement(path, nodes):
    """Times and nodal displacements of an Exodus file, in the order of our nodes.

    Parameters
    ----------
    path : path_like
    nodes : (n, 2) float
        Undeformed coordinates; the file may number its nodes as it likes.

    Returns
    -------
    times : (t,) float
    displacement : (t, n, 2) float

    Raises
    ------
    ValueError
        Where the file is no Exodus file or half of one, lacks ``disp_x`` or ``disp_y``, or has other nodes.
    """
    import xarray as xr  # here, since `inflate simulate` is quicker without

    try:
        with open(path, "rb") as stream:
            engine = "scipy" if stream.read(3) == b"CDF" else "h5netcdf"  # others read half a file as zeros
        with xr.open_dataset(path, engine=engine, decode_cf=False) as file:
            names = ["".join(map(_character, row)) for row in file["name_nod_var"].values]
            times = file["time_whole"].values.astype(float)
            coordinates = np.column_stack([file["coordx"].values, file["coordy"].values])
            fields = [file[f"vals_nod_var{names.index(name) + 1}"].values for name in ("disp_x", "disp_y")]
    except (OSError, KeyError, ValueError, TypeError, IndexError) as error:
        raise ValueError(f"{path} holds no displacements disp_x, disp_y as Exodus writes them: {error}") from None
    distance, number = cKDTree(coordinates).query(nodes)
    if len(coordinates) != len(nodes) or distance.max() > 1e-9 or len(np.unique(number)) != len(nodes):
        raise ValueError(f"{path} has other nodes than the mesh that it should hold")
    return times, np.stack(fields, axis=-1).astype(float)[:, number]


def _names(*names):
    """Names as rows of single characters, filled up with zeros."""
    return np.array([list(name.ljust(_NAME, "\0")) for name in names], dtype="S1")


def _character(value):
    return value.decode() if isinstance(value, bytes) else str(value)
