/**
 * From a grey image to the structure that it stands for (Fig. 2 of the paper), as `inflate_lib.structures.labels` does.
 *
 * Images are square and kept row by row, the top row first. A label image holds 0 outside, 0.5 in the wall, 1 in the
 * void that is inflated, and stands on the clamped edge of the frame.
 */

import { counted, general, Refusal } from "./words.ts";

export const FRAME = 28; // pixels per side; the frame is the unit square
export const THICKNESS = 2; // of the wall, in pixels
export const THRESHOLD = 0.5; // between dark and bright
export const OUTSIDE = 0;
export const WALL = 0.5;
export const VOID = 1;
const MIN_PIXELS = 12; // a smaller main component is a speck, not a digit

/** Edges that a structure can be clamped at; number n comes to the bottom by n quarter turns counter-clockwise. */
export const EDGES = ["bottom", "left", "top", "right"] as const;
export type Edge = (typeof EDGES)[number];

export type Image = Float64Array; // size · size, row by row

export interface LabelOptions {
  threshold?: number;
  wall?: number;
  clamped?: Edge;
}

export interface Labelled {
  label: Image;
  note: string; // what of the drawing is not in the structure: smaller pieces, and holes
}

/** Label image of the structure in a grey image. Pieces off the largest one are dropped, holes are filled. */
export function labelImage(image: unknown, options: LabelOptions = {}): Image {
  return labelled(image, options).label;
}

/** The label image, and in words what of the drawing it leaves out or adds. */
export function labelled(image: unknown, options: LabelOptions = {}): Labelled {
  const { threshold = THRESHOLD, wall = THICKNESS, clamped = "bottom" } = options;
  if (!Number.isInteger(wall) || wall < 1 || wall > FRAME) {
    throw new Refusal(`wall must be a whole number from 1 to ${FRAME}, not ${wall}`);
  }
  if (!(threshold >= 0 && threshold < 1)) {
    throw new Refusal(`threshold must be at least 0 and below 1, not ${threshold}`);
  }
  const turns = turnsToBottom(clamped);
  const bright = asGrey(image).map((value) => (value > threshold ? 1 : 0));
  if (!bright.includes(1)) {
    const brightest = general(Math.max(...asGrey(image)), 2);
    throw new Refusal(`image is blank: no pixel is brighter than ${general(threshold)} (brightest: ${brightest})`);
  }
  const { pieces, sizes } = components(bright, FRAME, true);
  const largest = sizes.indexOf(Math.max(...sizes));
  if (sizes[largest] < MIN_PIXELS) {
    throw new Refusal(
      `image has no digit: its largest connected component has ${sizes[largest]} pixels, fewer than ${MIN_PIXELS}`,
    );
  }
  const component = Float64Array.from(pieces, (piece) => (piece === largest + 1 ? 1 : 0));
  const filled = fillHoles(component);

  // The wall may grow beyond the frame before the structure is moved into it.
  const size = FRAME + 2 * wall;
  const composite = new Float64Array(size * size);
  for (let row = 0; row < FRAME; row++) {
    for (let column = 0; column < FRAME; column++) {
      if (!filled[row * FRAME + column]) continue;
      for (let i = row; i <= row + 2 * wall; i++) {
        for (let j = column; j <= column + 2 * wall; j++) composite[i * size + j] ||= WALL;
      }
    }
  }
  for (let row = 0; row < FRAME; row++) {
    for (let column = 0; column < FRAME; column++) {
      if (filled[row * FRAME + column]) composite[(row + wall) * size + column + wall] = VOID;
    }
  }
  const standing = intoFrame(turned(composite, turns), size, wall);
  return { label: turned(standing, 4 - turns), note: leftOut(bright, component, filled) };
}

/** A checked image as numbers in [0, 1], or a Refusal that says what is wrong with it. */
export function asGrey(image: unknown): Image {
  const rows = rowsOf(image);
  const height = rows.length;
  const width = rows[0]?.length;
  if (height !== FRAME || rows.some((row) => row.length !== FRAME)) {
    throw new Refusal(`image has shape (${height}, ${width}); a single (${FRAME}, ${FRAME}) image is needed`);
  }
  const bytes = image instanceof Uint8Array || image instanceof Uint8ClampedArray;
  const grey = new Float64Array(FRAME * FRAME);
  rows.forEach((row, i) => {
    Array.from(row as ArrayLike<unknown>).forEach((value, j) => {
      if (typeof value !== "number" && typeof value !== "boolean") {
        throw new Refusal("image is not an array of numbers");
      }
      grey[i * FRAME + j] = Number(value) / (bytes ? 255 : 1);
    });
  });
  if (!grey.every(Number.isFinite)) throw new Refusal("image has pixels that are NaN or infinite");
  const [least, most] = [Math.min(...grey), Math.max(...grey)];
  if (least < 0 || most > 1) {
    throw new Refusal(
      `image is a float image with values from ${general(least)} to ${general(most)}; they must lie in [0, 1] ` +
        "(give 0 to 255 as uint8)",
    );
  }
  return grey;
}

/** Rows of an image given as rows, or as one array of all its pixels. */
function rowsOf(image: unknown): ArrayLike<unknown>[] {
  const isArray = (value: unknown): value is ArrayLike<unknown> => Array.isArray(value) || ArrayBuffer.isView(value);
  if (!isArray(image)) throw new Refusal("image is not an array of numbers");
  const items = Array.from(image as ArrayLike<unknown>);
  if (items.length && items.every(isArray)) return items as ArrayLike<unknown>[];
  const side = Math.sqrt(items.length);
  if (!Number.isInteger(side)) return [items];
  return Array.from({ length: side }, (_, i) => items.slice(i * side, (i + 1) * side));
}

/** Connected components of the pixels that are not 0, numbered from 1 in reading order; 0 elsewhere. */
export function components(image: ArrayLike<number>, size: number, diagonals: boolean) {
  const pieces = new Int32Array(size * size);
  const sizes: number[] = [];
  for (let start = 0; start < image.length; start++) {
    if (!image[start] || pieces[start]) continue;
    const piece = sizes.push(0);
    const stack = [start];
    pieces[start] = piece;
    for (let at = stack.pop(); at !== undefined; at = stack.pop()) {
      sizes[piece - 1] = sizes[piece - 1] + 1;
      for (const next of neighbours(at, size, diagonals)) {
        if (image[next] && !pieces[next]) {
          pieces[next] = piece;
          stack.push(next);
        }
      }
    }
  }
  return { pieces, sizes };
}

function neighbours(at: number, size: number, diagonals: boolean): number[] {
  const [row, column] = [Math.floor(at / size), at % size];
  const found: number[] = [];
  for (let i = Math.max(row - 1, 0); i <= Math.min(row + 1, size - 1); i++) {
    for (let j = Math.max(column - 1, 0); j <= Math.min(column + 1, size - 1); j++) {
      const steps = Math.abs(i - row) + Math.abs(j - column);
      if (steps === 1 || (diagonals && steps === 2)) found.push(i * size + j);
    }
  }
  return found;
}

/** What cannot be reached from the frame's border by steps across the sides of pixels is filled. */
function fillHoles(component: Image): Image {
  const size = FRAME + 2; // with a rim, from which all of the outside is reached
  const dark = new Float64Array(size * size).fill(1);
  component.forEach((value, k) => {
    dark[(Math.floor(k / FRAME) + 1) * size + (k % FRAME) + 1] = 1 - value;
  });
  const { pieces } = components(dark, size, false);
  return component.map((_, k) => (pieces[(Math.floor(k / FRAME) + 1) * size + (k % FRAME) + 1] === 1 ? 0 : 1));
}

/** Move the structure down to the bottom row; sideways only as far as it must to be inside the frame. */
function intoFrame(composite: Image, size: number, margin: number): Image {
  let [top, bottom, left, right] = [size, -1, size, -1];
  composite.forEach((value, k) => {
    if (!value) return;
    const [row, column] = [Math.floor(k / size), k % size];
    [top, bottom] = [Math.min(top, row), Math.max(bottom, row)];
    [left, right] = [Math.min(left, column), Math.max(right, column)];
  });
  const [height, width] = [bottom - top + 1, right - left + 1];
  if (Math.max(height, width) > FRAME) {
    throw new Refusal(
      `structure does not fit: digit and wall are ${width} pixels wide and ${height} high, the frame is ` +
        `${FRAME} by ${FRAME}`,
    );
  }
  const [first, last] = [margin, margin + FRAME - 1];
  const down = last - bottom - margin;
  const across = Math.max(first - left, 0) + Math.min(last - right, 0) - margin;
  const label = new Float64Array(FRAME * FRAME);
  composite.forEach((value, k) => {
    if (value) label[(Math.floor(k / size) + down) * FRAME + (k % size) + across] = value;
  });
  return label;
}

/** The image after so many quarter turns counter-clockwise. */
export function turned(image: Image, turns: number): Image {
  const size = Math.sqrt(image.length);
  let result = image;
  for (let turn = 0; turn < turns % 4; turn++) {
    const before = result;
    result = before.map((_, k) => before[(k % size) * size + size - 1 - Math.floor(k / size)]);
  }
  return result;
}

export function turnsToBottom(clamped: string): number {
  const turns = EDGES.indexOf(clamped as Edge);
  if (turns < 0) throw new Refusal(`clamped must be one of ${EDGES.join(", ")}, not ${clamped}`);
  return turns;
}

/** What is dropped from the bright pixels, and what is filled, in words. */
function leftOut(bright: Image, component: Image, filled: Image): string {
  const words: string[] = [];
  const say = (pixels: Image, noun: string, done: string, diagonals: boolean) => {
    const { sizes } = components(pixels, FRAME, diagonals);
    const total = sizes.reduce((sum, size) => sum + size, 0);
    if (total) words.push(`${counted(sizes.length, noun)} of ${counted(total, "pixel")} ${done}`);
  };
  say(
    bright.map((value, k) => value - component[k]),
    "smaller piece",
    "dropped",
    true,
  );
  say(
    filled.map((value, k) => value - component[k]),
    "hole",
    "filled",
    false,
  );
  return words.join(", ");
}

/** Whether the cavity leads out: void and outside share the side of a pixel. The ground closes it at the clamped edge. */
export function isOpen(label: Image, clamped: Edge = "bottom"): boolean {
  const standing = turned(label, turnsToBottom(clamped));
  const size = Math.sqrt(standing.length);
  const value = (row: number, column: number) =>
    row < 0 || column < 0 || column >= size ? OUTSIDE : (standing[row * size + column] ?? OUTSIDE);
  for (let row = 0; row < size; row++) {
    for (let column = 0; column < size; column++) {
      if (value(row, column) !== VOID) continue;
      const around = [value(row - 1, column), value(row, column - 1), value(row, column + 1)];
      if (row + 1 < size) around.push(value(row + 1, column));
      if (around.includes(OUTSIDE)) return true;
    }
  }
  return false;
}

/** Lattice points at which two wall pixels meet that share no other connection there: joints of one node. */
export function pointJoints(label: Image): number[] {
  const size = Math.sqrt(label.length);
  const wall = (row: number, column: number) =>
    row >= 0 && column >= 0 && row < size && column < size && label[row * size + column] === WALL;
  const found: number[] = [];
  for (let row = 0; row <= size; row++) {
    for (let column = 0; column <= size; column++) {
      const [a, b] = [wall(row - 1, column - 1), wall(row - 1, column)];
      const [c, d] = [wall(row, column - 1), wall(row, column)];
      if ((a && d && !b && !c) || (b && c && !a && !d)) found.push(row * (size + 1) + column);
    }
  }
  return found;
}
