"""Problems whose answers are known, and studies of the choices behind the simulation (appendix "Verification").

Nothing here is needed to inflate a structure; it is needed to believe the result.
"""

import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

from inflate_lib.mechanics.material import first_piola_kirchhoff, tangent_moduli
from inflate_lib.mechanics.mesh import Mesh


def quarter_ring(n, inner=0.5, outer=1.0):
    """Mesh of a quarter of a tube's cross-section, x ≥ 0 and y ≥ 0, under pressure inside and free outside.

    The two straight ends are lines of symmetry, along which their nodes slide.

    Parameters
    ----------
    n : int
        Elements through the wall; around the quarter there are 3 n.
    inner, outer : float
        Radii.
    """
    radius, angle = np.linspace(inner, outer, n + 1), np.linspace(0, np.pi / 2, 3 * n + 1)
    x, y = np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))
    x[:, -1] = y[:, 0] = 0
    number = np.arange(x.size).reshape(x.shape)
    cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    nodes = np.column_stack([x.ravel(), y.ravel()])
    return Mesh(nodes, cells, np.column_stack([number[0, :-1], number[0, 1:]]), nodes == 0)


def tube(pressure, lame, inner=0.5, outer=1.0):
    """Exact solution of a long, thick-walled tube under internal follower pressure, free outside, in plane strain.

    A ring of radius R moves to r(R). With the stretches r′ along the radius and r/R around it, equilibrium is the
    boundary value problem

        d P_R/dR + (P_R − P_Θ)/R = 0,   P_R = −p r/R at the inner radius,   P_R = 0 at the outer one,

    which SciPy solves.

    Parameters
    ----------
    pressure : float
    lame : (float, float)
        Lamé parameters (λ, μ).
    inner, outer : float
        Undeformed radii.

    Returns
    -------
    callable
        Deformed radius r, (k,), at undeformed radii R, (k,).

    Raises
    ------
    RuntimeError
        Where no solution is found, as near the largest pressure that the tube can bear.
    """

    def stresses(along, across):
        zero = np.zeros_like(along)
        F = np.stack([np.stack([along, zero], -1), np.stack([zero, across], -1)], -2)
        return first_piola_kirchhoff(F, lame), tangent_moduli(F, lame)

    def radial_stretch(R, r, radial):
        """r′ at which P_R is `radial`; Newton's method from the incompressible one."""
        along = R / r
        for _ in range(12):
            P, A = stresses(along, r / R)
            along = along - (P[:, 0, 0] - radial) / A[:, 0, 0, 0, 0]
        return along

    def equations(R, y):  # of r and P_R: unlike r″, P_R stays finite and smooth as λ → ∞
        along = radial_stretch(R, *y)
        P, _ = stresses(along, y[0] / R)
        return along, (P[:, 1, 1] - P[:, 0, 0]) / R

    def ends(a, b):
        return a[1] + pressure * a[0] / inner, b[1]

    def excess(inflated):
        return incompressible_tube(inflated, lame[1], inner, outer) - pressure

    if excess(100 * inner) < 0:
        raise RuntimeError(f"the tube finds no equilibrium at the pressure {pressure:.4g}: it bears less")
    inflated = brentq(excess, inner, 100 * inner)  # start from the incompressible tube
    R = np.linspace(inner, outer, 41)
    start = np.stack(
        [np.sqrt(R**2 + inflated**2 - inner**2), -pressure * inflated / inner * (outer - R) / (outer - inner)]
    )
    found = solve_bvp(equations, ends, R, start, tol=1e-9)
    if not found.success:
        raise RuntimeError(f"the tube finds no equilibrium at the pressure {pressure:.4g}: {found.message}")
    return lambda radii: found.sol(radii)[0]


def incompressible_tube(inflated, mu, inner=0.5, outer=1.0):
    """Pressure that holds an incompressible tube at the deformed inner radius `inflated`: the limit λ → ∞, exactly.

    Incompressible means r² = R² + c. With a, b and A, B the inner and outer radius after and before,

        p = μ [ ln(B/A) − ln(b/a) + c/2 (1/a² − 1/b²) ],

    which tends to μ ln(B/A) as the tube grows: more it cannot bear.
    """
    c = inflated**2 - inner**2
    b = np.sqrt(outer**2 + c)
    return mu * (np.log(outer / inner) - np.log(b / inflated) + c / 2 * (1 / inflated**2 - 1 / b**2))
