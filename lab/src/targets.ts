/** What can be asked for: checked, and written into a link. */

import { axisHeight, type DescriptorName, NAMES, type Target, type Targets } from "./descriptors.ts";
import { AXIS_POINTS, DIRECTIONS, supportFunction } from "./shape.ts";
import { Refusal } from "./words.ts";

/**
 * Targets in the order in which the model takes them: numbers, an axis of thirty rising points from the origin, an
 * outline as its support function or as the corners of a polygon. Anything else is a Refusal.
 */
export function checkTargets(targets: Targets): Targets {
  const entries = Object.entries(targets ?? {}).filter(([, value]) => value !== undefined && value !== null);
  if (!entries.length) throw new Refusal(`nothing is asked for: give ${NAMES.join(", ")}, one at least`);
  const found = Object.fromEntries(entries) as Targets;
  for (const [name, value] of entries) {
    if (!NAMES.includes(name as DescriptorName))
      throw new Refusal(`the model takes ${NAMES.join(", ")}, any of them, not '${name}'`);
    if (name === "axis") {
      const axis = value as number[][];
      const points =
        Array.isArray(axis) &&
        axis.length === AXIS_POINTS &&
        axis.every((p) => Array.isArray(p) && p.length === 2 && p.every(Number.isFinite));
      const rises = points && axis[0].every((x) => x === 0) && axis.every(([, y], k) => k === 0 || y > axis[k - 1][1]);
      if (!rises) throw new Refusal(`axis must be ${AXIS_POINTS} points that begin at the origin and rise`);
    } else if (name === "outline") {
      found.outline = asSupports(value);
    } else if (!(typeof value === "number" && Number.isFinite(value) && value > 0)) {
      throw new Refusal(`${name} must be a positive number, not ${value}`);
    }
  }
  return Object.fromEntries(NAMES.filter((name) => name in found).map((name) => [name, found[name]]));
}

/** The support function of an outline that is given as such, or by points (k, 2). */
function asSupports(value: unknown): number[] {
  const list = Array.isArray(value) ? (value as unknown[]) : [];
  const finite = (one: unknown): one is number => typeof one === "number" && Number.isFinite(one);
  const points = list.every((p) => Array.isArray(p) && p.length === 2 && p.every(finite)) ? (list as number[][]) : [];
  const supports = points.length > 2 ? supportFunction(points) : (list as number[]);
  const opposite = (k: number) => supports[(k + DIRECTIONS / 2) % DIRECTIONS];
  if (supports.length !== DIRECTIONS || !supports.every((s, k) => finite(s) && s + opposite(k) > 0)) {
    throw new Refusal(
      `outline must be the corners of a polygon, or ${DIRECTIONS} numbers: how far the shape reaches in each direction`,
    );
  }
  return supports;
}

const BETWEEN = "_"; // of the numbers of a line in a link: stays as it is in an address

/** A target in a link: a number, the numbers of an outline, or of an axis its height and how far it is sideways. */
export function targetToText(name: DescriptorName, target: Target): string {
  if (name !== "axis") return [target].flat(2).join(BETWEEN);
  const axis = target as number[][];
  return [rounded(axisHeight(axis)), ...axis.map(([x]) => x)].join(BETWEEN);
}

/** What a link says about a descriptor, still to be checked. */
export function textToTarget(name: DescriptorName, text: string): Target {
  const numbers = text.split(BETWEEN).map((part) => (part === "" ? Number.NaN : Number(part)));
  if (name === "outline") return numbers;
  const [first, ...others] = numbers;
  return name === "axis" ? axisOf(first, others) : first;
}

/** Points of an axis at equal increments of height, from how far each is sideways. */
export const axisOf = (height: number, sideways: number[]) => sideways.map((x, k) => [x, (height * k) / AXIS_POINTS]);

/** Targets are given to four digits. */
export const rounded = (value: number) => Number(value.toFixed(4));
