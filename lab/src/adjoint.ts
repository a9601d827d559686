/**
 * How an inflated structure would change with its pixels, as `inflate_lib.mechanics.adjoint`: one linear solve for all.
 *
 * Let pixel e of the wall carry the share s_e of its energy W_e. Then dh/ds_e = −λ·∂W_e/∂x, where K λ = ∂h/∂x and K is
 * the tangent of the equilibrium.
 */

import { buildSystem, emptyState, moveTo, residual, tangent } from "./equilibrium.ts";
import { factorise, solve } from "./factor.ts";
import { deformed, type Inflation } from "./inflation.ts";
import { type Image, THICKNESS, VOID, WALL } from "./labels.ts";
import { Refusal } from "./words.ts";

/** dh/ds_e (m,) at the last load step, from the derivative (n, 2) of h with respect to the deformed nodes. */
export function sensitivities(result: Inflation, load: Float64Array): Float64Array {
  const x = deformed(result);
  if (!x.every(Number.isFinite)) {
    throw new Refusal(`the structure has no equilibrium to differentiate: ${result.reason}`);
  }
  const system = buildSystem(result.mesh, result.element, ...result.lame);
  const { order, d, m, stiffness } = system;
  const state = emptyState(system);
  const p = result.pressures[result.pressures.length - 1];
  const free = (values: Float64Array) =>
    Float64Array.from({ length: 2 * order.length }, (_, k) => values[2 * order[k >> 1] + (k & 1)]);
  moveTo(system, state, free(x));
  state.logJ.forEach((value, q) => {
    state.pi[q] = system.lam * value;
  });
  tangent(system, state, p, 1);
  residual(system, state, p);
  if (!factorise(system.pattern, state.tangent, state.inverses)) {
    throw new Refusal("the equilibrium is not stable: its tangent is not positive definite");
  }
  const solution = free(load);
  solve(system.pattern, state.tangent, state.inverses, solution);

  const found = new Float64Array(m);
  for (let e = 0; e < m; e++) {
    for (let a = 0; a < 4; a++) {
      const i = system.cells[4 * e + a];
      if (i < 0) continue;
      for (let k = 0; k < 2; k++) {
        let force = 0;
        for (let b = 1; b < 4; b++) force += stiffness[4 * a + b] * state.corners[8 * e + 2 * b + k];
        for (let q = e * d; q < (e + 1) * d; q++) force += state.slope[q] * state.c[8 * q + 2 * a + k];
        found[e] -= solution[2 * i + k] * force;
      }
    }
  }
  return found;
}

/**
 * Estimated change of a descriptor for each pixel of the cavity that might be flipped.
 *
 * A flip changes the wall in up to 5 × 5 pixels, whose derivatives are added up; a pixel that is no wall yet takes those
 * of the nearest one that is.
 */
export function flipChanges(label: Image, sensitivity: Float64Array): Float64Array {
  const size = Math.sqrt(label.length);
  // Of several nearest ones the leftmost is taken, and of those the upper, as SciPy does.
  const walls = [...label.keys()].filter((k) => label[k] === WALL).sort((a, b) => (a % size) - (b % size) || a - b);
  const element = new Map([...label.keys()].filter((k) => label[k] === WALL).map((k, e) => [k, e]));
  const apart = (a: number, b: number) =>
    (Math.floor(a / size) - Math.floor(b / size)) ** 2 + ((a % size) - (b % size)) ** 2;
  const change = Float64Array.from(label, (_, k) => {
    let best = 0;
    for (let w = 1; w < walls.length; w++) if (apart(k, walls[w]) < apart(k, walls[best])) best = w;
    return sensitivity[element.get(walls[best]) ?? 0];
  });
  const around = (values: ArrayLike<number>) =>
    Float64Array.from(label, (_, k) => {
      const [row, column] = [Math.floor(k / size), k % size];
      let sum = 0;
      for (let i = Math.max(row - THICKNESS, 0); i <= Math.min(row + THICKNESS, size - 1); i++) {
        for (let j = Math.max(column - THICKNESS, 0); j <= Math.min(column + THICKNESS, size - 1); j++)
          sum += values[i * size + j];
      }
      return sum;
    });
  const covers = around(label.map((value) => (value === VOID ? 1 : 0))); // void pixels that make this one a wall
  const gained = around(change.map((value, k) => (covers[k] < 0.5 ? value : 0)));
  const lost = around(change.map((value, k) => (label[k] === WALL && covers[k] < 1.5 ? value : 0)));
  return change.map((value, k) => (label[k] === VOID ? value - lost[k] : gained[k] - value));
}
