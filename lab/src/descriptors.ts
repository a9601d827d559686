/** Descriptors of an inflated structure, as `inflate_lib.descriptors`: what a target may ask for. */

import { deformed, type Inflation } from "./inflation.ts";
import {
  AXIS_POINTS,
  convexHull,
  DIRECTIONS,
  medialAxis,
  NORMALS,
  outlineHeight,
  polygonArea,
  supportFunction,
} from "./shape.ts";
import { stress } from "./stress.ts";
import { Refusal } from "./words.ts";

export interface Descriptors {
  height: number; // extent of the deformed nodes, in sides of the frame
  width: number;
  area: number; // of their convex hull
  axis: number[][]; // (30, 2) medial axis, bottom to top, the first point at the origin
  stress: number; // largest von Mises stress of any element, in the units of λ and μ
  stretch: number; // largest principal stretch of any element
  outline: number[]; // (32) support function of the hull, from the point of the ground below its middle
}
export type DescriptorName = keyof Descriptors;
/** All of them, in the order in which the joint model takes them. */
export const NAMES: DescriptorName[] = ["height", "width", "area", "stress", "stretch", "axis", "outline"];

/** Descriptors at a load step, the last one by default. Throws a Refusal where that one has no equilibrium. */
export function describe(result: Inflation, step = (result?.displacement?.length ?? 0) - 1): Descriptors {
  if (!result?.displacement?.length) throw new Refusal("result must be what inflate gives");
  if (!Number.isInteger(step) || step < 0 || step >= result.displacement.length) {
    throw new Refusal(`step must be a whole number from 0 to ${result.displacement.length - 1}, not ${step}`);
  }
  const nodes = deformed(result, step);
  if (!nodes.every(Number.isFinite)) {
    throw new Refusal(`the structure has no equilibrium to describe: ${result.reason}`);
  }
  const { vonMisesOverMu, stretch } = stress(result.mesh, nodes);
  return {
    ...describeNodes(nodes),
    stress: result.lame[1] * Math.max(...vonMisesOverMu),
    stretch: Math.max(...stretch),
  };
}

/** What the nodes (n, 2) of a shape alone tell. */
export function describeNodes(nodes: Float64Array) {
  const hull = convexHull(nodes).map((i) => [nodes[2 * i], nodes[2 * i + 1]]);
  const extent = (axis: number) => {
    const values = nodes.filter((_, k) => k % 2 === axis);
    return Math.max(...values) - Math.min(...values);
  };
  return {
    height: extent(1),
    width: extent(0),
    area: polygonArea(hull),
    axis: medialAxis(hull),
    outline: supportFunction(hull),
  };
}

/** Derivative (n, 2) of a descriptor with respect to the nodes; null where there is none. */
export function gradient(name: DescriptorName, nodes: Float64Array): Float64Array | null {
  const found = new Float64Array(nodes.length);
  if (name === "height" || name === "width") {
    // It follows the two nodes in which the extent is attained.
    const axis = name === "height" ? 1 : 0;
    let [least, most] = [axis, axis];
    for (let k = axis; k < nodes.length; k += 2) {
      if (nodes[k] > nodes[most]) most = k;
      if (nodes[k] < nodes[least]) least = k;
    }
    found[most] = 1;
    found[least] = -1;
    return found;
  }
  if (name === "area") {
    const hull = convexHull(nodes);
    hull.forEach((node, k) => {
      const [before, after] = [hull[(k + hull.length - 1) % hull.length], hull[(k + 1) % hull.length]];
      found[2 * node] = (nodes[2 * after + 1] - nodes[2 * before + 1]) / 2;
      found[2 * node + 1] = -(nodes[2 * after] - nodes[2 * before]) / 2;
    });
    return found;
  }
  return null;
}

/** Derivative (n, 2) of how far the outline of nodes is from a target, see `deviation`, with respect to the nodes. */
export function outlineGradient(nodes: Float64Array, target: number[]): Float64Array {
  const found = new Float64Array(nodes.length);
  const hull = convexHull(nodes);
  const at = (node: number) => [nodes[2 * node], nodes[2 * node + 1]];
  const farthest = ([a, b]: number[]) =>
    hull.reduce((best, node) => (a * at(node)[0] + b * at(node)[1] > a * at(best)[0] + b * at(best)[1] ? node : best));
  const [right, left, lowest] = [
    [1, 0],
    [-1, 0],
    [0, -1],
  ].map(farthest);
  const achieved = supportFunction(hull.map(at));
  NORMALS.forEach((normal, k) => {
    const share = Math.sign(achieved[k] - target[k]) / DIRECTIONS / outlineHeight(target);
    const node = farthest(normal);
    found[2 * node] += share * normal[0];
    found[2 * node + 1] += share * normal[1];
    // It is measured from the point of the ground below the middle.
    found[2 * left] -= (share * normal[0]) / 2;
    found[2 * right] -= (share * normal[0]) / 2;
    found[2 * lowest + 1] -= share * normal[1];
  });
  return found;
}

/** How far a descriptor is from its target, as a share of it; of a line the mean distance over the height it implies. */
export function deviation(name: DescriptorName, achieved: Descriptors, target: Target): number {
  if (name === "outline") {
    const supports = target as number[];
    const apart = achieved.outline.reduce((sum, value, k) => sum + Math.abs(value - supports[k]), 0);
    return apart / DIRECTIONS / outlineHeight(supports);
  }
  if (name !== "axis") return Math.abs((achieved[name] as number) / (target as number) - 1);
  const axis = target as number[][];
  const apart = achieved.axis.map(([x, y], k) => Math.hypot(x - axis[k][0], y - axis[k][1]));
  return apart.reduce((sum, value) => sum + value, 0) / AXIS_POINTS / axisHeight(axis);
}

export type Target = number | number[] | number[][];
export type Targets = Partial<Record<DescriptorName, Target>>;

/** Height of the shape that a medial axis belongs to: the axis ends one increment below the top. */
export function axisHeight(axis: number[][]): number {
  return (axis[AXIS_POINTS - 1][1] * AXIS_POINTS) / (AXIS_POINTS - 1);
}

/** The largest of the relative misses of all targets, by which structures are ranked and refined. */
export function largestMiss(targets: Targets, achieved: Descriptors): number {
  return Math.max(
    ...Object.entries(targets).map(([name, target]) => deviation(name as DescriptorName, achieved, target)),
  );
}
