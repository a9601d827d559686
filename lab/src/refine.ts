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
 * Change a structure, by a pixel or two that lie beside each other at a time, until its largest miss is at most `goal`,
 * or the tries are used up.
 *
 * A change is kept if it lowers the largest miss, leaves no crumb, and the structure can still be built. Crumbs of the
 * drawing go first; where that brings it no nearer in the end, the structure stays as it is. `watch` hears of every try.
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
  const before = largestMiss(targets, describe(result));
  const state: Try = { tried: 0, miss: before, flipped: [], label };
  const rough = crumbs(flipped(label, []));
  // Whatever comes of it, only the structure without crumbs is refined.
  let [untried, miss] = rough.length ? [[rough], Number.POSITIVE_INFINITY] : [changes(label, result, targets), before];
  let all: number[] = [];
  while (state.miss > goal && state.tried < tries && untried.length) {
    const [pixels, ...others] = untried;
    untried = others;
    const cavity = flipped(label, pixels);
    if (crumbs(cavity).length) continue;
    state.tried++;
    const next = attempt(cavity, options);
    const reached = next ? largestMiss(targets, describe(next.result)) : Number.POSITIVE_INFINITY;
    if (next && Number.isFinite(reached) && reached <= miss * (1 - LESS) && !crumbs(flipped(next.label, [])).length) {
      ({ label, result } = next);
      miss = reached;
      all = [...all, ...pixels];
      untried = changes(label, result, targets);
      if (miss < before) Object.assign(state, { miss, label, flipped: all });
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

/** What to flip, one pixel or two that lie beside each other, the change that promises the smallest miss first. */
function changes(label: Image, result: Inflation, targets: Targets): number[][] {
  const [pixels, size] = [border(label), Math.sqrt(label.length)];
  const at = new Set(pixels);
  const pairs = [1, size].flatMap((step) =>
    pixels
      .filter((k) => at.has(k + step) && (label[k] === VOID) === (label[k + step] === VOID))
      .map((k) => [k, k + step]),
  );
  const all = [...pixels.map((k) => [k]), ...pairs];
  const found = describe(result);
  const expected = new Float64Array(all.length);
  for (const [key, target] of Object.entries(targets)) {
    const name = key as DescriptorName;
    const nodes = deformed(result);
    const load = name === "outline" ? outlineGradient(nodes, target as number[]) : gradient(name, nodes);
    const change = load && flipChanges(label, sensitivities(result, load));
    const stays = deviation(name, found, target);
    all.forEach((some, i) => {
      const sum = change ? some.reduce((total, k) => total + change[k], 0) : 0; // of an axis no derivative is known
      const miss =
        change && name !== "outline" ? Math.abs(((found[name] as number) + sum) / (target as number) - 1) : stays + sum;
      expected[i] = Math.max(expected[i], miss);
    });
  }
  return [...all.keys()].sort((i, j) => expected[i] - expected[j]).map((i) => all[i]);
}

/** Pixels to flip, so that none of a cavity has at most one neighbour on its own side; and those that they uncover. */
export function crumbs(cavity: Image): number[] {
  const size = Math.sqrt(cavity.length);
  let smooth = cavity;
  for (let round = 0; round < size; round++) {
    const beside = (k: number) =>
      (k >= size ? smooth[k - size] : 0) +
      (k + size < smooth.length ? smooth[k + size] : 0) +
      (k % size ? smooth[k - 1] : 0) +
      ((k + 1) % size ? smooth[k + 1] : 0);
    const next = smooth.map((value, k) => Number(value ? beside(k) > 1 : beside(k) >= 3));
    if (next.every((value, k) => value === smooth[k])) break;
    smooth = next;
  }
  return [...cavity.keys()].filter((k) => smooth[k] !== cavity[k]);
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

/** The cavity of a structure as an image, with some pixels flipped. */
function flipped(label: Image, pixels: number[]): Image {
  const cavity = label.map((value) => Number(value === VOID));
  for (const k of pixels) cavity[k] = 1 - cavity[k];
  return cavity;
}
