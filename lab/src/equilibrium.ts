/**
 * The equilibrium equations of a mesh and the march through the load steps: the second half of
 * `inflate_lib.mechanics._kernels`, for meshes of pixels, whose elements are all congruent.
 *
 * An equilibrium is a stationary point of Π(x) = Σ ½ x·k x + Σ w φ(J(x)) − p A(x), φ(J) = λ/2 ln² J − μ ln J. In two
 * dimensions F:F, J and the cavity's area A are quadratic in x, so that k, the second derivative G of J and the second
 * derivative H of A are constants, and with c = ∂J/∂x the tangent is K = k + w φ″ c cᵀ + w φ′ G − p H.
 */

import { blockNumber, eliminate, factorise, type Pattern, solve } from "./factor.ts";
import type { Mesh } from "./mesh.ts";

const MAX_ITERATIONS = 40; // Newton iterations of one load step
export const MAX_HALVINGS = 6; // of a load step that does not converge
const MAX_MOVE = 0.1; // largest nodal move of one Newton iteration, in lengths of the unit square
const MIN_J = 0.05; // smallest area ratio allowed on the way
const TOLERANCE = 1e-11; // largest nodal move of an iteration at which a load step has converged
const ROUNDED = 1e-8; // the same where rounding keeps the moves from shrinking any further
const REUSE = 3e-5; // nodal move of an iteration from which on the tangent is kept

/** Where λ ln J is taken: once per element as the mean dilatation (no locking), or at the four Gauss points. */
export const ELEMENTS = ["mean-dilatation", "q1"] as const;
export type Element = (typeof ELEMENTS)[number];

/** Everything about a mesh and its material that an inflation does not change, in the order of elimination. */
export interface System {
  lam: number;
  mu: number;
  d: number; // values of J per element
  m: number; // elements
  pattern: Pattern;
  order: Int32Array; // (free,) mesh node of each free node
  x0: Float64Array; // (2 free,) undeformed coordinates of the free nodes
  cells: Int32Array; // (m, 4) free nodes of each element, -1 where clamped
  fixed: Float64Array; // (m, 4, 2) coordinates, used where clamped
  stiffness: Float64Array; // (4, 4) μ ∫ ∇N_a·∇N_b dV
  dilatation: Float64Array; // (d, 4, 4) antisymmetric G with J = Σ x_a G_ab y_b
  weight: number; // undeformed area that belongs to each J
  gauss: Float64Array; // (4, 4, 4) G at the Gauss points, whatever the element
  place: Int32Array; // (m, 4, 4) block of each pair a >= b of an element's nodes, -1 where one is clamped
  edges: Int32Array; // (k, 2) free nodes of the pressure edges, -1 where clamped
  edgesFixed: Float64Array; // (k, 2, 2)
  constant: Float64Array; // (blocks, 4) k, the part of the tangent that does not change
  pressure: Float64Array; // (blocks, 4) H
}

/** What depends on the positions; one set of arrays, written anew at each of them. */
export interface State {
  corners: Float64Array; // (m, 4, 2) of each element, seen from its first one
  edgeCorners: Float64Array; // (k, 2, 2) of each pressure edge, likewise
  J: Float64Array; // (m, d) ratio of deformed to undeformed area
  c: Float64Array; // (m, d, 4, 2) ∂J/∂x of the element's corners
  logJ: Float64Array; // (m, d)
  pi: Float64Array; // (m, d) what stands for λ ln J in the tangent
  slope: Float64Array; // (m, d) w φ′
  curvature: Float64Array; // (m, d) w φ″
  residual: Float64Array; // (2 free,) ∂Π/∂x
  tangent: Float64Array; // (blocks, 4) ∂²Π/∂x², and its factor L
  inverses: Float64Array; // (free, 4) of the factor D
}

/** Gradients ∂N_a/∂X of the bilinear shape functions of a square pixel at its 2 × 2 Gauss points, (4, 4, 2). */
export function shapeGradients(size: number): Float64Array {
  const corners = [
    [-1, -1],
    [1, -1],
    [1, 1],
    [-1, 1],
  ];
  const gradients = new Float64Array(32);
  corners.forEach(([qx, qy], q) => {
    const [xi, eta] = [qx / Math.sqrt(3), qy / Math.sqrt(3)];
    corners.forEach(([ax, ay], a) => {
      gradients[8 * q + 2 * a] = (ax * (1 + eta * ay) * size) / 2;
      gradients[8 * q + 2 * a + 1] = (ay * (1 + xi * ax) * size) / 2;
    });
  });
  return gradients;
}

export function buildSystem(mesh: Mesh, element: Element, lam: number, mu: number): System {
  const number = new Int32Array(mesh.n).fill(-1);
  const free: number[] = [];
  for (let node = 0; node < mesh.n; node++) if (!mesh.clamped[node]) number[node] = free.push(node) - 1;
  const pattern = eliminate(
    free.length,
    mesh.cells.map((node) => number[node]),
  );
  const order = pattern.order.map((node) => free[node]);
  order.forEach((node, i) => {
    number[node] = i;
  });
  const cells = mesh.cells.map((node) => number[node]);
  const edges = mesh.pressureEdges.map((node) => number[node]);
  const coordinates = (list: Int32Array) => {
    const found = new Float64Array(2 * list.length);
    list.forEach((node, i) => {
      found.set(mesh.nodes.subarray(2 * node, 2 * node + 2), 2 * i);
    });
    return found;
  };

  const m = cells.length / 4;
  const area = 1 / mesh.size ** 2;
  const gradients = shapeGradients(mesh.size);
  const [stiffness, gauss, mean] = [new Float64Array(16), new Float64Array(64), new Float64Array(16)];
  for (let q = 0; q < 4; q++) {
    for (let a = 0; a < 4; a++) {
      for (let b = 0; b < 4; b++) {
        const [ax, ay] = [gradients[8 * q + 2 * a], gradients[8 * q + 2 * a + 1]];
        const [bx, by] = [gradients[8 * q + 2 * b], gradients[8 * q + 2 * b + 1]];
        stiffness[4 * a + b] += (mu * area * (ax * bx + ay * by)) / 4;
        gauss[16 * q + 4 * a + b] = ax * by - ay * bx;
        mean[4 * a + b] += (ax * by - ay * bx) / 4;
      }
    }
  }
  const d = element === "q1" ? 4 : 1;

  const blocks = pattern.rows.length + pattern.n;
  const [constant, pressure] = [new Float64Array(4 * blocks), new Float64Array(4 * blocks)];
  const place = new Int32Array(16 * m).fill(-1);
  for (let e = 0; e < m; e++) {
    for (let a = 0; a < 4; a++) {
      for (let b = 0; b <= a; b++) {
        const [i, j] = [cells[4 * e + a], cells[4 * e + b]];
        if (i < 0 || j < 0) continue;
        const k = blockNumber(pattern, Math.max(i, j), Math.min(i, j));
        place[16 * e + 4 * a + b] = k;
        constant[4 * k] += stiffness[4 * a + b];
        constant[4 * k + 3] += stiffness[4 * a + b];
      }
    }
  }
  for (let k = 0; k < edges.length; k += 2) {
    const [i, j] = [edges[k], edges[k + 1]]; // A = ½ Σ (x_i y_j − x_j y_i)
    if (i < 0 || j < 0) continue;
    const block = blockNumber(pattern, Math.max(i, j), Math.min(i, j));
    const half = i > j ? 0.5 : -0.5;
    pressure[4 * block + 1] += half;
    pressure[4 * block + 2] -= half;
  }
  return {
    lam,
    mu,
    d,
    m,
    pattern,
    order,
    x0: coordinates(order),
    cells,
    fixed: coordinates(mesh.cells),
    stiffness,
    dilatation: d === 4 ? gauss : mean,
    weight: area / d,
    gauss,
    place,
    edges,
    edgesFixed: coordinates(mesh.pressureEdges),
    constant,
    pressure,
  };
}

export function emptyState(system: System): State {
  const { m, d, order, edges, constant } = system;
  const perJ = () => new Float64Array(m * d);
  return {
    corners: new Float64Array(8 * m),
    edgeCorners: new Float64Array(2 * edges.length),
    J: perJ(),
    c: new Float64Array(8 * m * d),
    logJ: perJ(),
    pi: perJ(),
    slope: perJ(),
    curvature: perJ(),
    residual: new Float64Array(2 * order.length),
    tangent: new Float64Array(constant.length),
    inverses: new Float64Array(4 * order.length),
  };
}

/** Deformed corners of groups of `size` nodes, seen from the first one: small numbers, so that little is rounded. */
function gather(x: Float64Array, list: Int32Array, fixed: Float64Array, size: number, out: Float64Array): void {
  for (let k = 0; k < list.length; k += size) {
    for (let d = 0; d < 2; d++) {
      const start = list[k] >= 0 ? x[2 * list[k] + d] : fixed[2 * k + d];
      for (let a = k; a < k + size; a++) {
        out[2 * a + d] = (list[a] >= 0 ? x[2 * list[a] + d] : fixed[2 * a + d]) - start;
      }
    }
  }
}

/** Corners at the positions `x`, and J, ln J and ∂J/∂x. */
export function moveTo(system: System, state: State, x: Float64Array): void {
  const { m, d, dilatation: G } = system;
  const { corners, J, c, logJ } = state;
  gather(x, system.cells, system.fixed, 4, corners);
  gather(x, system.edges, system.edgesFixed, 2, state.edgeCorners);
  for (let e = 0; e < m; e++) {
    for (let q = 0; q < d; q++) {
      let value = 0;
      const at = 8 * (e * d + q);
      for (let a = 0; a < 4; a++) {
        let cx = 0;
        let cy = 0;
        for (let b = 1; b < 4; b++) {
          const g = G[16 * q + 4 * a + b];
          cx += g * corners[8 * e + 2 * b + 1];
          cy -= g * corners[8 * e + 2 * b]; // G is antisymmetric
        }
        c[at + 2 * a] = cx;
        c[at + 2 * a + 1] = cy;
        value += corners[8 * e + 2 * a] * cx;
      }
      J[e * d + q] = value;
      logJ[e * d + q] = Math.log(value);
    }
  }
}

/** Gradient of the potential, r = k x + Σ w φ′ c − p ∂A/∂x. */
export function residual(system: System, state: State, p: number): void {
  const { m, d, cells, edges, stiffness, lam, mu, weight } = system;
  const { residual: r, c, corners, edgeCorners, slope, logJ, J } = state;
  r.fill(0);
  for (let k = 0; k < edges.length; k += 2) {
    const dx = edgeCorners[2 * k + 2] - edgeCorners[2 * k];
    const dy = edgeCorners[2 * k + 3] - edgeCorners[2 * k + 1];
    for (let end = k; end < k + 2; end++) {
      if (edges[end] < 0) continue;
      r[2 * edges[end]] -= 0.5 * p * dy;
      r[2 * edges[end] + 1] += 0.5 * p * dx;
    }
  }
  for (let e = 0; e < m; e++) {
    for (let q = e * d; q < (e + 1) * d; q++) slope[q] = (weight * (lam * logJ[q] - mu)) / J[q];
    for (let a = 0; a < 4; a++) {
      const i = cells[4 * e + a];
      if (i < 0) continue;
      let fx = 0;
      let fy = 0;
      for (let b = 1; b < 4; b++) {
        fx += stiffness[4 * a + b] * corners[8 * e + 2 * b];
        fy += stiffness[4 * a + b] * corners[8 * e + 2 * b + 1];
      }
      for (let q = e * d; q < (e + 1) * d; q++) {
        fx += slope[q] * c[8 * q + 2 * a];
        fy += slope[q] * c[8 * q + 2 * a + 1];
      }
      r[2 * i] += fx;
      r[2 * i + 1] += fy;
    }
  }
}

/** Blocks of the tangent; π stands for λ ln J and is blended with μ by `theta` (θ = 0: convex but for −p H). */
export function tangent(system: System, state: State, p: number, theta: number): void {
  const { m, d, cells, place, dilatation: G, lam, mu, weight, constant, pressure } = system;
  const { tangent: blocks, c, slope, curvature, J, pi } = state;
  for (let k = 0; k < blocks.length; k++) blocks[k] = constant[k] - p * pressure[k];
  for (let e = 0; e < m; e++) {
    for (let q = e * d; q < (e + 1) * d; q++) {
      const blended = mu + theta * (pi[q] - mu);
      slope[q] = (weight * (blended - mu)) / J[q];
      curvature[q] = (weight * (lam - blended + mu)) / (J[q] * J[q]);
    }
    for (let a = 0; a < 4; a++) {
      for (let b = 0; b <= a; b++) {
        const k = 4 * place[16 * e + 4 * a + b];
        if (k < 0) continue;
        let xx = 0;
        let xy = 0;
        let yx = 0;
        let yy = 0;
        for (let q = 0; q < d; q++) {
          const at = e * d + q;
          const gx = curvature[at] * c[8 * at + 2 * a];
          const gy = curvature[at] * c[8 * at + 2 * a + 1];
          const bx = c[8 * at + 2 * b];
          const by = c[8 * at + 2 * b + 1];
          const g = slope[at] * G[16 * q + 4 * a + b];
          xx += gx * bx;
          xy += gx * by + g;
          yx += gy * bx - g;
          yy += gy * by;
        }
        const lower = cells[4 * e + a] >= cells[4 * e + b]; // only the lower triangle is kept
        blocks[k] += xx;
        blocks[k + 1] += lower ? xy : yx;
        blocks[k + 2] += lower ? yx : xy;
        blocks[k + 3] += yy;
      }
    }
  }
}

export interface March {
  positions: Float64Array[]; // (2 free,) of each load step that was reached
  factorisations: number;
  turnedOver: boolean; // whether the next load step was not reached because an element turned over
}

/**
 * Follow the equilibrium through the load steps.
 *
 * Newton's method on Π, with two changes to the tangent. Mixed integration points (Magisano et al. 2017): λ ln J is
 * replaced by its linear extrapolation from the last iterate. And once the moves are shorter than REUSE, a factorised
 * tangent is used again as long as that shrinks the next move to a tenth or less. The residual, and so the solution, is
 * that of Π. A load step that fails is approached in halves; after `allowed` factorisations it gives up.
 */
export function march(system: System, pressures: ArrayLike<number>, allowed: number): March {
  const state = emptyState(system);
  const positions: Float64Array[] = [];
  let x = system.x0.slice();
  let lastPressure = 0;
  let factorisations = 0;
  let converged = false;
  for (let target = 0; target < pressures.length; target++) {
    let p = pressures[target];
    let halvings = 0;
    for (;;) {
      // sub-steps from lastPressure to pressures[target]
      const trial = x.slice();
      const found = newton(system, state, trial, p, converged, allowed - factorisations);
      converged = found.converged;
      factorisations += found.factorisations;
      if (converged) {
        x = trial;
        lastPressure = p;
        if (p === pressures[target]) break;
        p = pressures[target];
      } else {
        halvings++;
        if (halvings > MAX_HALVINGS || factorisations >= allowed)
          return { positions, factorisations, turnedOver: false };
        p = 0.5 * (lastPressure + p);
      }
    }
    gather(x, system.cells, system.fixed, 4, state.corners);
    if (turnedOver(system, state.corners)) return { positions, factorisations, turnedOver: true };
    positions.push(x.slice());
  }
  return { positions, factorisations, turnedOver: false };
}

/** Move `x` to equilibrium under the pressure p, with the tangent that `state` has where it is `factorised` already. */
function newton(system: System, state: State, x: Float64Array, p: number, factorised: boolean, allowed: number) {
  const { pattern, lam } = system;
  const step = state.residual;
  let factorisations = 0;
  let lastLength = 0;
  for (let iteration = 0; iteration < MAX_ITERATIONS; iteration++) {
    moveTo(system, state, x);
    if (iteration === 0)
      state.logJ.forEach((value, q) => {
        state.pi[q] = lam * value;
      });
    residual(system, state, p);
    let theta = 1;
    const fresh = !factorised;
    while (!factorised) {
      if (factorisations >= allowed || theta < 0) return { converged: false, factorisations };
      tangent(system, state, p, theta);
      factorisations++;
      factorised = factorise(pattern, state.tangent, state.inverses);
      if (!factorised) theta = theta > 0.25 ? 0.5 * theta : theta - 0.25; // 1, 0.5, 0.25, 0
    }
    solve(pattern, state.tangent, state.inverses, step);
    let length = 0;
    for (let i = 0; i < step.length; i++) {
      if (!Number.isFinite(step[i])) return { converged: false, factorisations };
      step[i] = -step[i];
      length = Math.max(length, Math.abs(step[i]));
    }
    let s = 1;
    // Shorter moves turn no element inside out, and are the last but a few.
    if (length > REUSE) s = shareOfStep(system, state, step, Math.min(1, MAX_MOVE / Math.max(length, MAX_MOVE)));
    for (let i = 0; i < x.length; i++) x[i] += s * step[i];
    const shrinkage = lastLength > 0 ? length / lastLength : 1;
    const whole = s === 1 && theta === 1; // θ = 1: positive definite, so stable
    const stalled = fresh && length <= ROUNDED && shrinkage > 0.5;
    if (whole && (length <= TOLERANCE || stalled)) return { converged: true, factorisations };
    factorised = whole && length <= REUSE && shrinkage <= 0.1;
    lastLength = length;
  }
  return { converged: false, factorisations };
}

/** Largest share s ≤ `longest` of a step along which every J stays above MIN_J; π is extrapolated along it. */
function shareOfStep(system: System, state: State, step: Float64Array, longest: number): number {
  const { m, d, cells, dilatation: G, lam } = system;
  const { J, c, pi, logJ } = state;
  const move = new Float64Array(8);
  let s = longest;
  for (let e = 0; e < m; e++) {
    for (let k = 0; k < 2; k++) {
      const start = cells[4 * e] >= 0 ? step[2 * cells[4 * e] + k] : 0;
      for (let a = 0; a < 4; a++) {
        const i = cells[4 * e + a];
        move[2 * a + k] = (i >= 0 ? step[2 * i + k] : 0) - start;
      }
    }
    for (let q = 0; q < d; q++) {
      const at = e * d + q;
      let slope = 0;
      let bend = 0;
      for (let a = 0; a < 4; a++) {
        let cx = 0;
        for (let b = 1; b < 4; b++) cx += G[16 * q + 4 * a + b] * move[2 * b + 1];
        slope += c[8 * at + 2 * a] * move[2 * a] + c[8 * at + 2 * a + 1] * move[2 * a + 1];
        bend += move[2 * a] * cx;
      }
      s = shareOfDescent(J[at] - MIN_J, slope, bend, s);
      pi[at] = slope;
    }
  }
  for (let at = 0; at < m * d; at++) pi[at] = lam * (logJ[at] + (s * pi[at]) / J[at]);
  return s;
}

/** Largest share ≤ s up to which height + s·slope + s²·bend stays positive. */
function shareOfDescent(height: number, slope: number, bend: number, s: number): number {
  const discriminant = slope * slope - 4 * bend * height;
  if (discriminant >= 0 && (slope < 0 || bend < 0)) {
    const below = Math.sqrt(discriminant) - slope; // the smallest positive root, in the form that does not cancel
    if (below > 0) return Math.min(s, (2 * height) / below);
  }
  return s;
}

/** Whether J ≤ 0 at a Gauss point, which a mean over the element does not show. */
function turnedOver(system: System, corners: Float64Array): boolean {
  const { m, gauss } = system;
  for (let e = 0; e < m; e++) {
    for (let q = 0; q < 4; q++) {
      let J = 0;
      for (let a = 0; a < 4; a++) {
        for (let b = 1; b < 4; b++) {
          J += corners[8 * e + 2 * a] * gauss[16 * q + 4 * a + b] * corners[8 * e + 2 * b + 1];
        }
      }
      if (!(J > 0)) return true;
    }
  }
  return false;
}
