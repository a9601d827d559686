/** Near misses are brought nearer pixel by pixel, as `inflate_lib.inverse.refine` does, in the order of the adjoint. */

import { flipChanges, sensitivities } from "./adjoint.ts";
import { findFlaw } from "./buildable.ts";
import {
  type DescriptorName,
  describe,
  deviation,
  gradient,
  largestMiss,
  outlineGradient,
  type Targets,
} from "./descriptors.ts";
import { deformed, type InflateOptions, type Inflation, inflate } from "./inflation.ts";
import { type Image, type LabelOptions, labelImage, VOID } from "./labels.ts";
import { Refusal } from "./words.ts";

const LESS = 1e-3; // relative decrease of the largest miss that a change must bring

export interface Try {
  tried: number; // inflations spent so far
  miss: number; // the largest miss of the best structure so far
  flipped: number[]; // pixels (row · size + column) that were changed, in order
  label: Image;
}

/**
 * Change a structure pixel by pixel until its largest miss is at most `goal`, or the tries are used up.
 *
 * A change is kept if it lowers the largest miss and the structure can still be built. `watch` hears of every try.
 */
export function refine(
  image: Image,
  targets: Targets,
  options: LabelOptions & InflateOptions = {},
  goal = 0.005,
  tries = 60,
  watch: (progress: Try) => void = () => {},
): Try {
  if (!Object.keys(targets).length) throw new Refusal("nothing is asked for: give a target to refine towards");
  let label = labelImage(image, options);
  let result = inflate(label, options);
  if (findFlaw(result)) throw new Refusal("a structure that cannot be built cannot be refined");
  const state: Try = { tried: 0, miss: largestMiss(targets, describe(result)), flipped: [], label };
  let untried = mostPromising(label, result, targets);
  while (state.miss > goal && state.tried < tries && untried.length) {
    const [pixel, ...others] = untried;
    untried = others;
    state.tried++;
    const next = attempt(flipped(label, pixel), options);
    const miss = next ? largestMiss(targets, describe(next.result)) : Number.POSITIVE_INFINITY;
    if (next && miss <= state.miss * (1 - LESS)) {
      ({ label, result } = next);
      Object.assign(state, { miss, label, flipped: [...state.flipped, pixel] });
      untried = mostPromising(label, result, targets);
    }
    watch({ ...state });
  }
  return state;
}

/** Label and inflate an image; null where it cannot be, or cannot be built. */
function attempt(image: Image, options: LabelOptions & InflateOptions) {
  try {
    const label = labelImage(image, options);
    const result = inflate(label, { timeLimit: 1, ...options });
    return findFlaw(result) ? null : { label, result };
  } catch (error) {
    if (error instanceof Refusal) return null;
    throw error;
  }
}

/** Pixels on either side of the border of the cavity, the one whose flip promises the smallest miss first. */
function mostPromising(label: Image, result: Inflation, targets: Targets): number[] {
  const pixels = border(label);
  const found = describe(result);
  const expected = new Float64Array(label.length);
  for (const [key, target] of Object.entries(targets)) {
    const name = key as DescriptorName;
    const nodes = deformed(result);
    const load = name === "outline" ? outlineGradient(nodes, target as number[]) : gradient(name, nodes);
    const change = load && flipChanges(label, sensitivities(result, load));
    const stays = deviation(name, found, target);
    for (const k of pixels) {
      let miss = stays; // of an axis no derivative is known
      if (change && name === "outline") miss = stays + change[k];
      else if (change) miss = Math.abs(((found[name] as number) + change[k]) / (target as number) - 1);
      expected[k] = Math.max(expected[k], miss);
    }
  }
  return pixels.sort((a, b) => expected[a] - expected[b]);
}

/** Void pixels with a side towards another label, and the pixels that they share it with. */
function border(label: Image): number[] {
  const size = Math.sqrt(label.length);
  const inside = (row: number, column: number) => row >= 0 && column >= 0 && row < size && column < size;
  return [...label.keys()].filter((k) => {
    const [row, column] = [Math.floor(k / size), k % size];
    return [
      [row - 1, column],
      [row + 1, column],
      [row, column - 1],
      [row, column + 1],
    ].some(([i, j]) => (inside(i, j) && label[i * size + j] === VOID) !== (label[k] === VOID));
  });
}

/** The cavity of a structure as an image, with one pixel flipped. */
function flipped(label: Image, pixel: number): Image {
  return label.map((value, k) => Number((value === VOID) !== (k === pixel)));
}
