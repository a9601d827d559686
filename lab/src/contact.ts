/**
 * Self-contact, as `inflate_lib.mechanics.contact`: where walls of an inflated structure pass through one another.
 *
 * Boundary edges that share no node and cross are wall upon wall. Edges that merely touch do not count.
 */

import { deformed, type Inflation } from "./inflation.ts";
import { boundaryEdges } from "./mesh.ts";

/** Pairs of boundary edges that cross at a load step, as numbers of nodes [i, j, k, l] of edges i–j and k–l. */
export function crossingEdges(result: Inflation, step = result.displacement.length - 1): number[][] {
  return crossings(deformed(result, step), boundaryEdges(result.mesh.cells));
}

/** Number of pairs of boundary edges that cross at a load step; 0 also where there is no equilibrium. */
export function selfContact(result: Inflation, step = result.displacement.length - 1): number {
  return crossingEdges(result, step).length;
}

/** Index of the first load step at which walls cross, −1 where they never do. */
export function firstContact(result: Inflation): number {
  const edges = boundaryEdges(result.mesh.cells);
  return result.displacement.findIndex((_, step) => crossings(deformed(result, step), edges).length > 0);
}

/** Crossing pairs among edges (k, 2): a sweep from left to right holds an edge against those that begin before it ends. */
export function crossings(x: Float64Array, edges: Int32Array): number[][] {
  const n = edges.length / 2;
  const box = (axis: number, pick: (...values: number[]) => number) =>
    Float64Array.from({ length: n }, (_, e) => pick(x[2 * edges[2 * e] + axis], x[2 * edges[2 * e + 1] + axis]));
  const [left, right] = [box(0, Math.min), box(0, Math.max)];
  const [bottom, top] = [box(1, Math.min), box(1, Math.max)];
  const order = Array.from({ length: n }, (_, e) => e).sort((e, f) => left[e] - left[f]);
  const found: number[][] = [];
  for (let first = 0; first < n; first++) {
    const e = order[first];
    const [i, j] = [edges[2 * e], edges[2 * e + 1]];
    for (let second = first + 1; second < n; second++) {
      const f = order[second];
      if (left[f] > right[e]) break;
      // NaN fails every comparison and ends at the last test.
      if (bottom[f] > top[e] || top[f] < bottom[e]) continue;
      const [k, l] = [edges[2 * f], edges[2 * f + 1]];
      if (i === k || i === l || j === k || j === l) continue;
      const here = side(x, i, j, k) * side(x, i, j, l);
      const there = side(x, k, l, i) * side(x, k, l, j);
      if (here < 0 && there < 0) found.push(e < f ? [i, j, k, l] : [k, l, i, j]);
    }
  }
  return found;
}

/** Twice the signed area of the triangle i, j, k: positive where k is on the left of the way from i to j. */
function side(x: Float64Array, i: number, j: number, k: number): number {
  const [ix, iy] = [x[2 * i], x[2 * i + 1]];
  return (x[2 * j] - ix) * (x[2 * k + 1] - iy) - (x[2 * j + 1] - iy) * (x[2 * k] - ix);
}
