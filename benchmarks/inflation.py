"""Inflation against peers: seconds per structure on one core, the same element and mesh, interleaved in one run.

    python benchmarks/inflation.py --structures 5 --repeats 3

FElupe and scikit-fem are libraries for any problem; they assemble with NumPy and factorise with SuperLU, and a reader
who writes an inflation with them pays what is measured here. All three solve plain bilinear quadrilaterals (the element
that all have), ten load steps, to the same displacements; the table prints by how much they differ. Newton's method and
the limit on its step are the same in the peers, and the pressure, whose potential is quadratic in the coordinates, is
added in the same way.
"""

import time
from typing import Annotated

import felupe
import numpy as np
import skfem
import typer
from rich.console import Console
from rich.table import Table
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, grad
from threadpoolctl import threadpool_limits

from inflate_lib import build_mesh, inflate, label_image, load_sevens
from inflate_lib.inflation import LAMBDA, MU, PRESSURE

MOVE = 0.02  # largest nodal move of one of the peers' Newton steps; a larger one makes some of them diverge
TOLERANCE = 1e-9  # residual at which the peers' Newton iterations end; forces are of the order 1e-3


def area_hessian(mesh):
    """Second derivative of the cavity's area, a sparse matrix over (x₀, y₀, x₁, y₁, …)."""
    i, j = mesh.pressure_edges.T
    half = np.full(len(i), 0.5)
    n = 2 * len(mesh.nodes)
    rows, columns = np.r_[2 * i, 2 * j, 2 * i + 1, 2 * j + 1], np.r_[2 * j + 1, 2 * i + 1, 2 * j, 2 * i]
    return csc_array((np.r_[half, -half, -half, half], (rows, columns)), shape=(n, n))


def newton(mesh, n_steps, stiffness):
    """Displacement (n, 2) after `n_steps` load steps; ``stiffness(u)`` gives the inner forces and their tangent."""
    free = np.flatnonzero(np.repeat(~mesh.clamped, 2))
    hessian, u = area_hessian(mesh), np.zeros_like(mesh.nodes)
    for pressure in PRESSURE * np.arange(1, n_steps + 1) / n_steps:
        for _ in range(100):
            force, tangent = stiffness(u)
            residual = (force - pressure * (hessian @ (mesh.nodes + u).ravel()))[free]
            if np.linalg.norm(residual) < TOLERANCE:
                break
            matrix = csc_array(tangent - pressure * hessian)[free][:, free]
            step = np.zeros(u.size)
            step[free] = splu(csc_array(matrix)).solve(-residual)
            u += (step * min(1, MOVE / np.abs(step).max())).reshape(u.shape)
        else:
            raise RuntimeError("a peer's Newton iteration did not converge")
    return u


def with_felupe(mesh, n_steps):
    region = felupe.RegionQuad(felupe.Mesh(mesh.nodes, mesh.cells, "quad"))
    field = felupe.FieldContainer([felupe.FieldPlaneStrain(region, dim=2)])
    body = felupe.SolidBody(felupe.NeoHookeCompressible(mu=MU, lmbda=LAMBDA), field)

    def stiffness(u):
        field[0].values[:] = u
        return body.assemble.vector(field).toarray().ravel(), body.assemble.matrix(field)

    return newton(mesh, n_steps, stiffness)


def with_scikit_fem(mesh, n_steps):
    quads = skfem.MeshQuad(mesh.nodes.T, mesh.cells.T)
    basis = skfem.Basis(quads, skfem.ElementVector(skfem.ElementQuad1()), intorder=3)  # 2 × 2 Gauss points
    identity = np.eye(2)[:, :, None, None]

    def kinematics(w):
        F = grad(w["u"]) + identity
        J = F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
        inverse_transposed = np.array([[F[1, 1], -F[1, 0]], [-F[0, 1], F[0, 0]]]) / J
        return F, np.log(J), inverse_transposed

    @skfem.LinearForm
    def force(v, w):
        F, log_j, G = kinematics(w)
        return ddot(MU * (F - G) + LAMBDA * log_j * G, grad(v))

    @skfem.BilinearForm
    def tangent(du, v, w):
        _, log_j, G = kinematics(w)
        turned = np.einsum("iK...,kK...,kJ...->iJ...", G, grad(du), G)  # −dF⁻ᵀ = F⁻ᵀ dFᵀ F⁻ᵀ
        return ddot(MU * grad(du) + (MU - LAMBDA * log_j) * turned + LAMBDA * ddot(G, grad(du)) * G, grad(v))

    def stiffness(u):
        w = basis.interpolate(u.ravel())
        return force.assemble(basis, u=w), tangent.assemble(basis, u=w)

    return newton(mesh, n_steps, stiffness)


def with_inflate_lib(mesh, n_steps):
    return inflate(mesh, n_steps=n_steps, element="q1").displacement[-1]


SOLVERS = {"inflate_lib": with_inflate_lib, "FElupe": with_felupe, "scikit-fem": with_scikit_fem}


def main(
    structures: Annotated[int, typer.Option(help="How many sevens.")] = 5,
    repeats: Annotated[int, typer.Option(help="Rounds; the median counts.")] = 3,
    steps: Annotated[int, typer.Option(help="Load steps.")] = 10,
):
    """Time the three solvers on the same meshes, one after the other in each round."""
    meshes = [build_mesh(label_image(image)) for image in load_sevens(limit=structures).images]
    ours = [with_inflate_lib(mesh, steps) for mesh in meshes]  # compiles before the clock starts
    seconds = {name: np.zeros((repeats, len(meshes))) for name in SOLVERS}
    apart = dict.fromkeys(SOLVERS, 0.0)
    for round_ in range(repeats):
        for k, mesh in enumerate(meshes):
            for name, solver in SOLVERS.items():
                start = time.perf_counter()
                u = solver(mesh, steps)
                seconds[name][round_, k] = time.perf_counter() - start
                apart[name] = max(apart[name], np.abs(u - ours[k]).max())
    table = Table(title=f"{len(meshes)} sevens, plain bilinear quadrilaterals, {steps} load steps, one core")
    for column in ("solver", "ms per structure (median)", "times ours", "largest difference"):
        table.add_column(column, justify="right" if column != "solver" else "left")
    base = np.median(seconds["inflate_lib"], axis=0).mean()
    for name in SOLVERS:
        mean = np.median(seconds[name], axis=0).mean()
        table.add_row(name, f"{1e3 * mean:.1f}", f"{mean / base:.1f}", f"{apart[name]:.1e}")
    Console().print(table)


if __name__ == "__main__":
    with threadpool_limits(1):  # one core for everybody
        typer.run(main)
