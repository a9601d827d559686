/** The joint model as `inflate export` writes it: what it is, what it takes, and how it is asked. */

import type { SamplingOptions } from "./sampling.ts";

export interface Calibration {
  mean: number[];
  directions: number[][]; // (k, N) orthonormal rows
  offset: number[];
  slope: number[][];
  bends: [number[], number[]][]; // of each coordinate: x and b(x)
}

export interface StoredModel {
  fingerprint: string; // of the weights
  profile: string;
  config: {
    channels: number[];
    embedding: number;
    blocks: number;
    conditioning: string;
    objective: string;
    T: number;
    strongest: number;
  };
  groups: number;
  parts: { name: string; length: number }[];
  conditionMin: number[];
  conditionMax: number[];
  ways: Record<string, Way>; // purpose → how it is sampled for it: quick, varied
  tensors: { name: string; shape: number[]; at: number }[]; // where each begins, in numbers
  weights: string; // base64 of 16-bit floats
  reach: Reach;
}

export interface Way {
  sampling: SamplingOptions;
  calibrations: Record<string, Calibration>; // names of parts joined by + → calibration, good for this sampling alone
}

/** Descriptors of all structures of the data set: what can be reached. */
export interface Reach {
  structures: number;
  columns: { name: string; length: number; least: number[]; most: number[] }[];
  table: string; // base64 of 16-bit shares of the way from the least to the most, column after column
}

export function bytes(base64: string): Uint8Array {
  const text = atob(base64);
  const found = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) found[k] = text.charCodeAt(k);
  return found;
}

/** 16-bit floats as 32-bit ones. */
export function fromHalf(halves: Uint16Array): Float32Array {
  return Float32Array.from(halves, (half) => {
    const [sign, exponent, fraction] = [half >> 15 ? -1 : 1, (half >> 10) & 31, half & 1023];
    if (exponent === 0) return sign * fraction * 2 ** -24;
    return exponent === 31 ? Number.NaN : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  });
}

/** What to tell the model to get a target, by the calibration of `inflate_lib.models.calibration`. */
export function told(calibration: Calibration, target: number[]): number[] {
  const { mean, directions, offset, slope, bends } = calibration;
  const z = directions.map((direction) => direction.reduce((sum, value, k) => sum + value * (target[k] - mean[k]), 0));
  const straight = z.map((value, i) => {
    const [xs, ys] = bends[bends.length === 1 ? 0 : i];
    return polygon(value, ys, xs) - offset[i];
  });
  const w = solved(slope, straight);
  return target.map((value, k) => value + directions.reduce((sum, row, i) => sum + (w[i] - z[i]) * row[k], 0));
}

/** The polygon through (xs, ys), which goes on straight beyond its ends. */
function polygon(x: number, xs: number[], ys: number[]): number {
  let piece = 0;
  while (piece < xs.length - 2 && xs[piece + 1] < x) piece++;
  return ys[piece] + ((x - xs[piece]) * (ys[piece + 1] - ys[piece])) / (xs[piece + 1] - xs[piece]);
}

/** Solution of a few linear equations, by elimination with pivoting. */
function solved(matrix: number[][], rhs: number[]): number[] {
  const rows = matrix.map((row, i) => [...row, rhs[i]]);
  const n = rows.length;
  for (let k = 0; k < n; k++) {
    const pivot = rows.reduce((best, row, i) => (i >= k && Math.abs(row[k]) > Math.abs(rows[best][k]) ? i : best), k);
    [rows[k], rows[pivot]] = [rows[pivot], rows[k]];
    for (let i = 0; i < n; i++) {
      if (i === k) continue;
      const factor = rows[i][k] / rows[k][k];
      rows[i] = rows[i].map((value, j) => value - factor * rows[k][j]);
    }
  }
  return rows.map((row, i) => row[n] / row[i]);
}
