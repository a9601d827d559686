/** What descriptors are measured on, as `inflate_lib.descriptors.shape`: the deformed nodes and their convex hull. */

import { Refusal } from "./words.ts";

export const AXIS_POINTS = 30;
export const DIRECTIONS = 32; // of an outline; a multiple of four: right, up, left and down are among them

/** Numbers of the corners of the convex hull of nodes (n, 2), counter-clockwise; none of them on a side. */
export function convexHull(nodes: Float64Array): number[] {
  const x = (i: number) => nodes[2 * i];
  const y = (i: number) => nodes[2 * i + 1];
  const order = Array.from({ length: nodes.length / 2 }, (_, i) => i).sort((i, j) => x(i) - x(j) || y(i) - y(j));
  const extent = Math.max(1e-300, ...nodes.map(Math.abs));
  const tolerance = 1e-15 * extent * extent; // what rounding makes of three points on a line
  const half = (list: number[]) => {
    const chain: number[] = [];
    for (const k of list) {
      for (; chain.length > 1; chain.pop()) {
        const [i, j] = chain.slice(-2);
        if ((x(j) - x(i)) * (y(k) - y(i)) - (y(j) - y(i)) * (x(k) - x(i)) > tolerance) break;
      }
      chain.push(k);
    }
    return chain.slice(0, -1);
  };
  const hull = [...half(order), ...half([...order].reverse())];
  if (hull.length < 3) throw new Refusal("the deformed nodes span no area, so they have no convex hull");
  return hull;
}

export function polygonArea(corners: number[][]): number {
  const twice = corners.map(([x, y], k) => {
    const [nextX, nextY] = corners[(k + 1) % corners.length];
    return x * nextY - nextX * y;
  });
  return twice.reduce((sum, value) => sum + value, 0) / 2;
}

/**
 * Midpoints of the horizontal chords of a convex polygon at equal height increments (paper sec. 3.1, item v).
 *
 * `hull` has its corners counter-clockwise. From the bottom upwards; the first of the 30 points is the origin.
 */
export function medialAxis(hull: number[][]): number[][] {
  const { left, right } = hullSides(hull);
  const heights = hull.map(([, y]) => y);
  const [bottom, top] = [Math.min(...heights), Math.max(...heights)];
  const axis = Array.from({ length: AXIS_POINTS }, (_, k) => {
    const y = bottom + ((top - bottom) * k) / AXIS_POINTS;
    return [0.5 * (across(left, y) + across(right, y)), y - bottom];
  });
  const [[first]] = axis;
  return axis.map(([x, y]) => [x - first, y]);
}

/** The left and the right side of a convex polygon, each from its lowest to its highest corner, y increasing. */
function hullSides(hull: number[][]) {
  const before = (sign: number) => (a: number[], b: number[]) => sign * (a[1] - b[1]) || b[0] - a[0];
  const lowest = hull.indexOf([...hull].sort(before(1))[0]); // the right end of a flat bottom
  const highest = hull.indexOf([...hull].sort(before(-1))[0]); // the right end of a flat top
  const ring = hull.map((_, k) => hull[(lowest + k) % hull.length]);
  const split = (highest - lowest + hull.length) % hull.length;
  const right = ring.slice(0, split + 1);
  let left = [...ring.slice(split), ring[0]].reverse();
  // A flat bottom (top) belongs to neither side: drop the far end, which has the same y.
  if (left.length > 2 && left[1][1] <= left[0][1]) left = left.slice(1);
  if (left.length > 2 && left[left.length - 2][1] >= left[left.length - 1][1]) left = left.slice(0, -1);
  return { left, right };
}

/** x of a line (k, 2) with increasing y, at the height y. */
export function across(line: number[][], y: number): number {
  const next = line.findIndex(([, height]) => height > y);
  if (next === 0) return line[0][0];
  if (next < 0) return line[line.length - 1][0];
  const [[x0, y0], [x1, y1]] = line.slice(next - 1, next + 1);
  return x0 + ((x1 - x0) / (y1 - y0)) * (y - y0);
}

/** Directions (cos θ, sin θ) at θ = 2π k / 32, exact in the quarters. */
export const NORMALS = Array.from({ length: DIRECTIONS }, (_, k) => {
  const angle = (2 * Math.PI * k) / DIRECTIONS;
  return [Math.cos(angle), Math.sin(angle)].map((value) => Number(value.toFixed(15)));
});

/**
 * Outline of the convex hull of points as its support function: how far it reaches in each of the 32 directions from
 * the point of the ground below its middle.
 */
export function supportFunction(points: number[][]): number[] {
  const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
  const [middle, ground] = [(Math.min(...xs) + Math.max(...xs)) / 2, Math.min(...ys)];
  return NORMALS.map(([nx, ny]) => Math.max(...points.map(([x, y]) => nx * (x - middle) + ny * (y - ground))));
}

/** Corners (32, 2) of the polygon whose sides have the outward normals and distances of a support function. */
export function outlineCorners(supports: number[]): number[][] {
  return NORMALS.map(([a, b], k) => {
    const next = (k + 1) % DIRECTIONS;
    const [c, d] = NORMALS[next];
    const determinant = a * d - b * c;
    return [(supports[k] * d - supports[next] * b) / determinant, (supports[next] * a - supports[k] * c) / determinant];
  });
}

/** Height and width of the shape of a support function. */
export const outlineHeight = (supports: number[]) => supports[DIRECTIONS / 4] + supports[(3 * DIRECTIONS) / 4];
export const outlineWidth = (supports: number[]) => supports[0] + supports[DIRECTIONS / 2];
