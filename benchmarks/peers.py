"""The same inflation with FElupe and with scikit-fem, each in two ways.

All solve plain bilinear quadrilaterals (the element that all three libraries have) on the same mesh, and both peers
are given everything that a careful user would think of:

* **as documented**: the way that the library's own examples go. FElupe: `SolidBody` and `SolidBodyPressure` in a
  `Step`, driven by a `Job` that cuts back load steps where Newton's method fails (`CutbackPlugin`). scikit-fem, which
  assembles and leaves the iteration to its user: forms as in its example 36, `condense`, `solve`; a load step that
  fails is halved.
* **tuned**: the library only assembles the solid. Newton's method with a limited move needs no cut-backs; the pressure
  is one constant matrix; F is 2 × 2 instead of 3 × 3 (FElupe); the moduli are computed once per assembly instead of
  once per pair of shape functions (scikit-fem); clamped unknowns are held by a large number on the diagonal, so that
  no matrix is cut; SuperLU is told that the matrix is symmetric.
"""

import sys
import warnings
from pathlib import Path

import felupe
import numpy as np
import skfem
from scipy.sparse import coo_array, csr_array, dia_array
from scipy.sparse.linalg import splu, spsolve
from skfem.helpers import det, dot, eye, grad, inv, mul, transpose

from inflate_lib.mechanics.inflation import PRESSURE
from inflate_lib.mechanics.material import LAMBDA, MU

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "helpers"))
from mechanics_peers import felupe_system

MOVE = 0.03  # largest nodal move of a tuned Newton step; with a larger one some diverge, a smaller one is slower
TOLERANCE = 1e-10  # residual at which the tuned iterations end: displacements right to 1e-8, as the others' are
HELD = 1e10  # on the diagonal where clamped; the stiffness is of the order 10
ITERATIONS = 16  # of one load step as documented (FElupe's default)


class _Count(felupe.Plugin):
    """Counts the linear solves of a FElupe job, those of failed load steps included."""

    solves = 0

    def after_linear_solve(self, context, state):
        self.solves += 1


def _solver(matrix, right_hand_side):
    """SciPy's `spsolve`, where it can work: SuperLU spends time and complaints on the NaN of a failed step."""
    if not np.isfinite(matrix.data).all():
        return np.full_like(right_hand_side, np.nan)
    return spsolve(matrix, right_hand_side)


def felupe_as_documented(mesh, n_steps):
    """Displacement (n, 2) at full pressure and number of linear solves."""
    _, field, solid, load = felupe_system(mesh, order=1)
    clamped = {"clamped": felupe.Boundary(field[0], fy=0.0)}
    ramp = PRESSURE * np.linspace(0, 1, n_steps + 1)  # from zero, so that the first load step can be cut back, too
    step, count = felupe.Step([solid, load], ramp={load: ramp}, boundaries=clamped), _Count()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # singular matrices and logarithms of negative J, before a cut-back
        felupe.Job([step], plugins=[felupe.CutbackPlugin(), count]).evaluate(x0=field, verbose=0, solver=_solver)
    return field[0].values, count.solves


def felupe_tuned(mesh, n_steps):
    """As :func:`felupe_as_documented`, with an iteration of our own."""
    region = felupe.RegionQuad(felupe.Mesh(mesh.nodes, mesh.cells, "quad"))
    field = felupe.FieldContainer([felupe.Field(region, dim=2)])  # this law in plane strain needs the 2 × 2 part only
    body = felupe.SolidBody(felupe.NeoHookeCompressible(mu=MU, lmbda=LAMBDA), field)

    def force(u):
        field[0].values[:] = u.reshape(-1, 2)
        return body.assemble.vector(field).toarray().ravel()

    return _newton(mesh, n_steps, force, body.assemble.matrix)


def _kinematics(u):
    """F, J and F⁻ᵀ at the quadrature points."""
    F = grad(u) + eye(np.ones(u.shape[1:]), 2)
    return F, det(F), transpose(inv(F))


def _stress(u):
    F, J, G = _kinematics(u)
    return MU * (F - G) + LAMBDA * np.log(J) * G


def _moduli(u):
    _, J, G = _kinematics(u)
    return (
        MU * np.einsum("ik,jl->ijkl", np.eye(2), np.eye(2))[..., None, None]
        + LAMBDA * np.einsum("ij...,kl...->ijkl...", G, G)
        + (MU - LAMBDA * np.log(J)) * np.einsum("il...,kj...->ijkl...", G, G)
    )


def scikit_fem_as_documented(mesh, n_steps):
    """Displacement (n, 2) at full pressure and number of linear solves."""
    quads = skfem.MeshQuad(mesh.nodes.T, mesh.cells.T)
    element = skfem.ElementVector(skfem.ElementQuad1())
    wanted = np.sort(mesh.pressure_edges, axis=1) @ [len(mesh.nodes), 1]
    cavity = np.flatnonzero(np.isin(np.sort(quads.facets.T, axis=1) @ [len(mesh.nodes), 1], wanted))
    solid, inside = skfem.Basis(quads, element, intorder=3), skfem.FacetBasis(quads, element, facets=cavity, intorder=2)
    clamped = solid.get_dofs(lambda x: np.isclose(x[1], 0))

    @skfem.LinearForm
    def force(v, w):
        return np.einsum("ij...,ij...", _stress(w["u"]), grad(v))

    @skfem.BilinearForm
    def tangent(du, v, w):
        return np.einsum("ijkl...,ij...,kl...", _moduli(w["u"]), grad(du), grad(v))

    @skfem.LinearForm
    def load(v, w):  # −p n da = −p J F⁻ᵀ N dA
        _, J, G = _kinematics(w["u"])
        return -w["p"] * J * dot(mul(G, w.n), v)

    @skfem.BilinearForm
    def load_tangent(du, v, w):
        _, J, G = _kinematics(w["u"])
        change = np.einsum("kl...,kl...", G, grad(du)) * G - np.einsum("il...,kl...,kj...->ij...", G, grad(du), G)
        return -w["p"] * J * dot(mul(change, w.n), v)

    solves = 0

    def newton(u, p):
        nonlocal solves
        for _ in range(ITERATIONS):
            now, edge = solid.interpolate(u), inside.interpolate(u)
            K = tangent.assemble(solid, u=now) - load_tangent.assemble(inside, u=edge, p=p)
            r = force.assemble(solid, u=now) - load.assemble(inside, u=edge, p=p)
            step = skfem.solve(*skfem.condense(K, -r, D=clamped), solver=_solver)
            solves += 1
            u = u + step
            if not np.isfinite(step).all():
                return None
            if np.linalg.norm(step) < 1e-8:
                return u
        return None

    def advance(u, start, end):
        """From one pressure to another, by halves where Newton's method fails."""
        there = newton(u, end)
        if there is None:
            assert end - start > 1e-3 * PRESSURE / n_steps, "the peer found no equilibrium"
            middle = (start + end) / 2
            return advance(advance(u, start, middle), middle, end)
        return there

    u = np.zeros(solid.N)
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        warnings.simplefilter("ignore")
        for k in range(n_steps):
            u = advance(u, PRESSURE * k / n_steps, PRESSURE * (k + 1) / n_steps)
    return u.reshape(-1, 2), solves


def scikit_fem_tuned(mesh, n_steps):
    """As :func:`scikit_fem_as_documented`, with an iteration of our own."""
    quads = skfem.MeshQuad(mesh.nodes.T, mesh.cells.T)
    basis = skfem.Basis(quads, skfem.ElementVector(skfem.ElementQuad1()), intorder=3)  # 2 × 2 Gauss points
    form = skfem.LinearForm(lambda v, w: np.einsum("ij...,ij...", w["P"], grad(v)))
    tangent = skfem.BilinearForm(lambda du, v, w: np.einsum("ijkl...,ij...,kl...", w["A"], grad(du), grad(v)))
    now = None

    def force(u):
        nonlocal now
        now = basis.interpolate(u)
        return form.assemble(basis, P=_stress(now))

    return _newton(mesh, n_steps, force, lambda: tangent.assemble(basis, A=_moduli(now)))


def _newton(mesh, n_steps, force, stiffness):
    """Newton's method with moves of at most MOVE; ``stiffness()`` is that at the last ``force(u)``."""
    free = np.repeat(~mesh.clamped, 2)
    hessian, held = _area_hessian(mesh), dia_array((np.where(free, 0, HELD)[None], [0]), shape=(free.size, free.size))
    u, x, solves = np.zeros(free.size), mesh.nodes.ravel(), 0
    for pressure in PRESSURE * np.arange(1, n_steps + 1) / n_steps:
        load = csr_array(held - pressure * hessian)
        for _ in range(100):
            residual = np.where(free, force(u) - pressure * (hessian @ (x + u)), 0)
            if np.linalg.norm(residual) < TOLERANCE:
                break
            matrix = (csr_array(stiffness()) + load).T  # symmetric, so that its rows are the columns that SuperLU wants
            symmetric = {"SymmetricMode": True}
            step = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric).solve(-residual)
            u += step * min(1, MOVE / np.abs(step).max())
            solves += 1
        else:
            raise RuntimeError("a peer's Newton iteration did not converge")
    return u.reshape(-1, 2), solves


def _area_hessian(mesh):
    """Second derivative of the cavity's area, a sparse matrix over (x₀, y₀, x₁, y₁, …)."""
    i, j = mesh.pressure_edges.T
    half = np.full(len(i), 0.5)
    rows, columns = np.r_[2 * i, 2 * j, 2 * i + 1, 2 * j + 1], np.r_[2 * j + 1, 2 * i + 1, 2 * j, 2 * i]
    n = 2 * len(mesh.nodes)
    return csr_array(coo_array((np.r_[half, -half, -half, half], (rows, columns)), shape=(n, n)))
