"""Contact between walls against an independent solver, GetFEM.

    python benchmarks/contact_getfem.py write /tmp/cases     # meshes, and where walls come near
    python3 benchmarks/contact_getfem.py solve /tmp/cases    # with a Python that has getfem and NumPy, and no more
    python benchmarks/contact_getfem.py compare /tmp/cases

GetFEM (on Debian the package python3-getfem) shares nothing with us but the mesh. It writes the element as bilinear
displacements with a constant dilatation and its multiplier, and contact as an augmented Lagrangian on all free
boundaries, integrated over their edges, with rays that look for the wall opposite: no barrier, no gap. Writes
data/reference/contact_getfem.csv: for each structure the sizes that GetFEM finds at full pressure, how many load steps
it does not converge in, how many pairs of edges cross a little in its result, and how far ours are from it as the gap
shrinks. Where a corner meets a corner, as on the stairs of a seven, its rays see little, and walls intrude.
"""

import sys
from pathlib import Path

import numpy as np

GAPS = (0.2, 0.1, 0.05, 0.025, 0.0125)  # in pixels
SEVENS = (4, 15, 225)
NAMES = ("arch", *(f"seven {n}" for n in SEVENS))
STIFFNESS, ORDER = 1.0, 5  # of GetFEM's augmentation, and of the integration along an edge


def structures():
    from inflate_lib import label_image, load_sevens

    arch = np.zeros((28, 28))
    arch[4:24, 6:9] = arch[4:24, 14:17] = arch[4:7, 6:17] = 1
    sevens = load_sevens("mnist").images
    return {name: label_image(image) for name, image in zip(NAMES, [arch, *sevens[list(SEVENS)]], strict=True)}


def write(folder):
    from inflate_lib import inflate
    from inflate_lib.mechanics.contact import contact_forces

    for name, label in structures().items():
        free, guarded = inflate(label), inflate(label, contact=True)
        first = next(k for k in range(len(free.pressures)) if contact_forces(guarded, k).any())
        start = free.displacement[first - 1] if first else np.zeros_like(free.nodes)
        mesh = free.mesh
        np.savez(folder / f"{name}.npz", nodes=mesh.nodes, cells=mesh.cells, edges=mesh.pressure_edges, start=start,
                 pressures=free.pressures[first:], lame=free.lame)  # fmt: skip


def solve(folder):
    import getfem as gf

    def rounded(points):
        return [tuple(point) for point in np.round(np.asarray(points) * 1e6).astype(int).tolist()]

    for path in sorted(folder / f"{name}.npz" for name in NAMES):
        case = np.load(path)
        nodes, cells = case["nodes"], case["cells"]
        mesh = gf.Mesh("empty", 2)
        for cell in cells:
            mesh.add_convex(gf.GeoTrans("GT_QK(2,1)"), nodes[cell[[0, 1, 3, 2]]].T)
        number = {point: i for i, point in enumerate(rounded(mesh.pts().T))}
        ours = np.array([number[point] for point in rounded(nodes)])
        pressed = {tuple(sorted(ours[edge])) for edge in case["edges"]}
        regions = {"pressed": [], "held": [], "walls": []}
        for face in mesh.outer_faces().T:
            ends = tuple(sorted(int(i) for i in mesh.pid_in_faces(face[:, None])))
            held = all(abs(mesh.pts()[1, i]) < 1e-9 for i in ends)
            regions["pressed" if ends in pressed else "held" if held else "walls"].append(face)
        pressure, held, walls = 1, 2, 3
        for region, faces in zip((pressure, held, walls), regions.values(), strict=True):
            mesh.set_region(region, np.array(faces).T)
        mesh.set_region(walls, np.array(regions["walls"] + regions["pressed"]).T)
        bilinear, constant, multiplier = gf.MeshFem(mesh, 2), gf.MeshFem(mesh, 1), gf.MeshFem(mesh, 2)
        bilinear.set_fem(gf.Fem("FEM_QK(2,1)"))
        multiplier.set_fem(gf.Fem("FEM_QK(2,1)"))
        constant.set_fem(gf.Fem("FEM_QK(2,0)"))
        inside = gf.MeshIm(mesh, gf.Integ("IM_GAUSS_PARALLELEPIPED(2,3)"))
        along = gf.MeshIm(mesh, gf.Integ(f"IM_GAUSS_PARALLELEPIPED(2,{ORDER})"))

        model = gf.Model("real")
        model.add_fem_variable("u", bilinear)
        model.add_fem_variable("theta", constant)
        model.add_fem_variable("q", constant)
        for name, value in zip(("lam", "mu"), case["lame"], strict=True):
            model.add_initialized_data(name, [float(value)])
        for name, value in {"p": 0.0, "r": STIFFNESS, "friction": 0.0, "alpha": 1.0}.items():
            model.add_initialized_data(name, [value])
        F = "(Id(2)+Grad_u)"
        model.add_nonlinear_term(
            inside, f"mu/2*(Norm_sqr({F})-2)+lam/2*sqr(log(theta))-mu*log(theta)+q*(Det({F})-theta)"
        )
        model.add_nonlinear_term(inside, f"p*((Det({F})*(Inv({F}))')*Normal).Test_u", pressure)
        model.add_Dirichlet_condition_with_simplification("u", held)
        model.add_filtered_fem_variable("traction", multiplier, walls)
        brick = model.add_integral_large_sliding_contact_brick_raytracing("r", 1 / 28, "friction", "alpha")
        model.add_master_slave_contact_boundary_to_large_sliding_contact_brick(brick, along, walls, "u", "traction")

        unknowns = {}
        for i, point in enumerate(rounded(bilinear.basic_dof_nodes().T)):
            unknowns.setdefault(point, []).append(i)
        unknowns = np.array([unknowns[point] for point in rounded(nodes)])
        start = np.zeros(bilinear.nbdof())
        start[unknowns] = case["start"]
        model.set_variable("u", start)
        x = (nodes + case["start"])[cells]
        across, other = x[:, 2] - x[:, 0], x[:, 3] - x[:, 1]
        areas = 0.5 * (across[:, 0] * other[:, 1] - across[:, 1] * other[:, 0])
        model.set_variable("theta", areas * 28**2)
        found, converged = [], []
        for p in case["pressures"]:
            model.set_variable("p", [p])
            spent = model.solve("max_res", 1e-10, "max_iter", 60, "lsearch", "simplest", "alpha min", 0.05)
            print(path.stem, f"p {p:.3f}", spent, flush=True)
            found.append(model.variable("u")[unknowns])
            converged.append(spent[1])
        np.savez(path.with_name(f"found {path.name}"), displacement=found, converged=converged)


def compare(folder):
    from dataclasses import replace

    import pandas as pd
    from stored import store

    from inflate_lib import describe, inflate, self_contact

    rows = []
    for name, label in structures().items():
        solved, free = np.load(folder / f"found {name}.npz"), inflate(label)
        found = solved["displacement"]
        getfem = replace(free, displacement=found)
        theirs = describe(getfem)
        for gap in GAPS:
            result = inflate(label, contact=gap / 28)
            ours = describe(result)
            row = {"structure": name, "gap (pixels)": gap}
            for size in ("height", "width", "hull_area"):
                row |= {
                    size: getattr(theirs, size),
                    f"{size} (%)": 100 * (getattr(ours, size) / getattr(theirs, size) - 1),
                }
            row["load steps that fail"], row["pairs that cross"] = (
                int((~solved["converged"].astype(bool)).sum()),
                self_contact(getfem),
            )
            row["nodes (pixels)"] = 28 * np.linalg.norm(result.displacement[-1] - found[-1], axis=1).max()
            row["nodes without contact (pixels)"] = 28 * np.linalg.norm(free.displacement[-1] - found[-1], axis=1).max()
            rows.append(row)
    store(pd.DataFrame(rows), "contact_getfem", "contact_getfem.py", digits=9, getfem="5.4.2 (Debian)")


if __name__ == "__main__":
    command, where = sys.argv[1], Path(sys.argv[2])
    where.mkdir(parents=True, exist_ok=True)
    {"write": write, "solve": solve, "compare": compare}[command](where)
