/** What can be reached, as `inflate_lib.models.reach`: targets that contradict themselves, or that nothing comes near, are refused. */

import { axisHeight, type DescriptorName, NAMES, type Targets } from "./descriptors.ts";
import { bytes, type Reach } from "./model.ts";
import { AXIS_POINTS, DIRECTIONS, outlineHeight, outlineWidth } from "./shape.ts";
import { general, Refusal } from "./words.ts";

const AGREE = 1e-3; // relative difference up to which two statements of the same length count as one
const LINES: DescriptorName[] = ["axis", "outline"]; // whose components mean little one by one
const REACH = 0.1; // a target is within reach if a structure of the data set misses it by no more than this

const read = new WeakMap<Reach, Map<string, Float64Array[]>>();

/** Values of each descriptor of all structures, component after component. */
export function readReach(reach: Reach): Map<string, Float64Array[]> {
  const known = read.get(reach);
  if (known) return known;
  const shares = new Uint16Array(bytes(reach.table).buffer);
  let at = 0;
  const table = new Map(
    reach.columns.map(({ name, length, least, most }) => {
      const components = Array.from({ length }, (_, k) => {
        const column = shares.subarray(at, at + reach.structures);
        at += reach.structures;
        return Float64Array.from(column, (share) => least[k] + (share / 65535) * (most[k] - least[k]));
      });
      return [name, components];
    }),
  );
  read.set(reach, table);
  return table;
}

/** Throw a Refusal, with what can be reached, where a target contradicts itself or no structure comes near. */
export function checkReach(targets: Targets, table: Map<string, Float64Array[]>): void {
  const asked = Object.keys(targets) as DescriptorName[];
  const numbers = asked.filter((name) => !LINES.includes(name));
  const misses = missesOf(targets, table);
  const nearest = misses.reduce((best, miss, i) => (miss < misses[best] ? i : best), 0);
  const range = (name: string) => {
    const [column] = table.get(name) ?? [new Float64Array(1)];
    return { least: column.reduce((a, b) => Math.min(a, b)), most: column.reduce((a, b) => Math.max(a, b)), column };
  };
  let problem = contradiction(targets);
  for (const name of numbers) {
    const { least, most } = range(name);
    const value = targets[name] as number;
    if (!problem && !(value >= least - AGREE * Math.abs(least) && value <= most + AGREE * Math.abs(most))) {
      problem = `${name} ${general(value, 4)} is out of reach`;
    }
  }
  if (!problem && misses[nearest] > REACH) {
    problem = asked.length === 1 ? `the ${asked[0]} cannot be reached` : "the targets cannot be reached together";
    problem += `: the closest of all structures misses by ${(100 * misses[nearest]).toFixed(0)}%`;
  }
  if (!problem) return;
  const lines = asked.length > numbers.length; // they say what height and width are
  const spokenOf = NAMES.filter((name) => numbers.includes(name) || (lines && (name === "height" || name === "width")));
  const there = spokenOf.map((name) => {
    const { least, most, column } = range(name);
    const alone = numbers.length === 1 && !lines;
    const value = alone ? Math.min(Math.max(targets[name] as number, least), most) : column[nearest];
    return `${name} ${value.toFixed(3)}`;
  });
  if (targets.axis) {
    const sideways = Math.max(...(table.get("axis") ?? []).map((column) => Math.abs(column[nearest])));
    there.push(`axis (${sideways.toFixed(3)} sideways)`);
  }
  const ranges = spokenOf.map((name) => `${name} ${range(name).least.toFixed(3)} to ${range(name).most.toFixed(3)}`);
  throw new Refusal(
    `${problem}. The ${misses.length} inflated structures of the data set reach ${ranges.join(", ")}; the nearest ` +
      `reachable target is ${there.join(", ")}.`,
  );
}

/** The largest miss of every structure, as a share of the targets. */
function missesOf(targets: Targets, table: Map<string, Float64Array[]>): Float64Array {
  const [heights] = table.get("height") ?? [new Float64Array()];
  const misses = new Float64Array(heights.length);
  for (const [name, target] of Object.entries(targets)) {
    const columns = table.get(name);
    if (!columns) throw new Refusal(`the model takes ${[...table.keys()].join(", ")}, any of them, not '${name}'`);
    misses.forEach((miss, i) => {
      let share = 0;
      if (name === "axis") {
        const axis = target as number[][];
        for (let k = 0; k < AXIS_POINTS; k++) {
          share += Math.hypot(columns[k][i] - axis[k][0], (heights[i] * k) / AXIS_POINTS - axis[k][1]);
        }
        share /= AXIS_POINTS * axisHeight(axis);
      } else if (name === "outline") {
        const supports = target as number[];
        for (let k = 0; k < DIRECTIONS; k++) share += Math.abs(columns[k][i] - supports[k]);
        share /= DIRECTIONS * outlineHeight(supports);
      } else share = Math.abs(columns[0][i] / (target as number) - 1);
      misses[i] = Math.max(miss, share);
    });
  }
  return misses;
}

/** Why no shape at all can meet the targets, or an empty text. */
function contradiction(targets: Targets): string {
  const axis = targets.axis as number[][] | undefined;
  const outline = targets.outline as number[] | undefined;
  const exact = (value: number): [number, number] => [value, value];
  const bounds: [giver: string, name: DescriptorName, least: number, most: number][] = [];
  // What a line says exactly counts as known where it is not asked for.
  const height = targets.height ?? (outline ? outlineHeight(outline) : axis && axisHeight(axis));
  const width = targets.width ?? (outline && outlineWidth(outline));
  if (typeof height === "number" && typeof width === "number") {
    bounds.push([`height ${general(height, 4)} and width ${general(width, 4)}`, "area", 0, height * width]);
  }
  if (axis) {
    const sideways = axis.map(([x]) => x);
    bounds.push(["the axis", "height", ...exact(axisHeight(axis))]);
    bounds.push(["the axis", "width", Math.max(...sideways) - Math.min(...sideways), Number.POSITIVE_INFINITY]);
  }
  if (outline) {
    bounds.push(["the outline", "height", ...exact(outlineHeight(outline))]);
    bounds.push(["the outline", "width", ...exact(outlineWidth(outline))]);
  }
  for (const [giver, name, least, most] of bounds) {
    const value = targets[name];
    if (typeof value !== "number" || (value >= least * (1 - AGREE) && value <= most * (1 + AGREE))) continue;
    const word = least === most ? "" : value < least ? "at least " : "at most ";
    const limit = general(value < least ? least : most, 4);
    return `${name} ${general(value, 4)} contradicts ${giver}, with which it is ${word}${limit}`;
  }
  return "";
}
