/** What can be reached, as `inflate_lib.models.reach`: targets that contradict themselves, or that nothing comes near, are refused. */

import { AXIS_POINTS } from "./shape.ts";
import { axisHeight, type DescriptorName, type Targets } from "./descriptors.ts";
import { bytes, type Reach } from "./model.ts";
import { general, Refusal } from "./words.ts";

const AGREE = 1e-3; // relative difference up to which two statements of the same length count as one
const REACH = 0.1; // a target is within reach if a structure of the data set misses it by no more than this

/** Values of each descriptor of all structures, component after component. */
export function readReach(reach: Reach): Map<string, Float64Array[]> {
  const shares = new Uint16Array(bytes(reach.table).buffer);
  let at = 0;
  return new Map(
    reach.columns.map(({ name, length, least, most }) => {
      const components = Array.from({ length }, (_, k) => {
        const column = shares.subarray(at, at + reach.structures);
        at += reach.structures;
        return Float64Array.from(column, (share) => least[k] + (share / 65535) * (most[k] - least[k]));
      });
      return [name, components];
    }),
  );
}

/** Throw a Refusal, with what can be reached, where a target contradicts itself or no structure comes near. */
export function checkReach(targets: Targets, table: Map<string, Float64Array[]>): void {
  const asked = Object.keys(targets) as DescriptorName[];
  const numbers = asked.filter((name) => name !== "axis");
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
  const spokenOf = [...table.keys()].filter(
    (name) => (numbers as string[]).includes(name) || (targets.axis && (name === "height" || name === "width")),
  );
  const there = spokenOf.map((name) => {
    const { least, most, column } = range(name);
    const alone = numbers.length === 1 && !targets.axis;
    const value = alone ? Math.min(Math.max(targets[name as DescriptorName] as number, least), most) : column[nearest];
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
      } else share = Math.abs(columns[0][i] / (target as number) - 1);
      misses[i] = Math.max(miss, share);
    });
  }
  return misses;
}

/** Why no shape at all can meet the targets, or an empty text. */
function contradiction(targets: Targets): string {
  const { width, area, axis } = targets as { width?: number; area?: number; axis?: number[][] };
  const implied = axis && axisHeight(axis);
  const height = (targets.height as number | undefined) ?? implied;
  const broken = (name: string, value: number, giver: string, least: number, most: number) => {
    if (value >= least * (1 - AGREE) && value <= most * (1 + AGREE)) return "";
    const word = least === most ? "" : value < least ? "at least " : "at most ";
    return `${name} ${general(value, 4)} contradicts ${giver}, with which it is ${word}${general(value < least ? least : most, 4)}`;
  };
  if (height !== undefined && width !== undefined && area !== undefined) {
    const giver = `height ${general(height, 4)} and width ${general(width, 4)}`;
    const problem = broken("area", area, giver, 0, height * width);
    if (problem) return problem;
  }
  if (axis && implied !== undefined) {
    if (targets.height !== undefined) {
      const problem = broken("height", targets.height as number, "the axis", implied, implied);
      if (problem) return problem;
    }
    const sideways = axis.map(([x]) => x);
    const least = Math.max(...sideways) - Math.min(...sideways);
    if (width !== undefined) return broken("width", width, "the axis", least, Number.POSITIVE_INFINITY);
  }
  return "";
}
