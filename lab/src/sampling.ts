/** Sampling, as `inflate_lib.diffusion.sampling`: from noise to images by few steps of DDIM or DPM-Solver++(2M). */

import { Refusal } from "./words.ts";

const SAMPLERS = ["dpm-solver++", "ddim"] as const;

export interface SamplingOptions {
  sampler: (typeof SAMPLERS)[number];
  steps: number;
  eta: number; // noise between 0 (deterministic) and 1
  guidance: number;
  crowding?: number; // above 1 the steps crowd near the image
}

/** ᾱ of the cosine schedule (Nichol & Dhariwal 2021), zero-based: alphaBars[t] belongs to the paper's step t + 1. */
export function cosineSchedule(T: number, s = 0.008, maxBeta = 0.999): Float64Array {
  const squared = (t: number) => Math.cos((((t / T + s) / (1 + s)) * Math.PI) / 2) ** 2;
  const alphaBars = new Float64Array(T);
  let product = 1;
  for (let t = 0; t < T; t++) {
    product *= 1 - Math.min(1 - squared(t + 1) / squared(t), maxBeta);
    alphaBars[t] = product;
  }
  return alphaBars;
}

/** Zero-based time steps down from the last, T − 1: T (k / steps)^crowding, no two alike. */
export function timesteps(T: number, steps: number, crowding = 1): number[] {
  if (!Number.isInteger(steps) || steps < 1 || steps > T) {
    throw new Refusal(`steps must be a whole number from 1 to ${T}, not ${steps}`);
  }
  return Array.from({ length: steps }, (_, i) => {
    const even = roundHalfToEven(T * ((steps - i) / steps) ** crowding);
    return Math.min(Math.max(even, steps - i), T - i) - 1;
  });
}

function roundHalfToEven(value: number): number {
  const floor = Math.floor(value);
  return value - floor === 0.5 ? floor + (floor % 2) : Math.round(value);
}

/**
 * The reverse process, one state after another: x_T first, x_0 last.
 *
 * `predict(x, t)` is the network's answer to images (n · pixels) on the scale from −1 to 1, of which the clean image is
 * estimated and clipped; `noise()` gives standard normal images, the first of which is x_T.
 */
export async function* denoise(
  predict: (x: Float32Array, t: number) => Promise<Float32Array> | Float32Array,
  alphaBars: Float64Array,
  noise: () => Float32Array,
  objective: string,
  { sampler, steps, eta, crowding }: SamplingOptions,
): AsyncGenerator<Float32Array> {
  if (!SAMPLERS.includes(sampler)) throw new Refusal(`sampler must be one of ${SAMPLERS.join(", ")}, not ${sampler}`);
  const times = timesteps(alphaBars.length, steps, crowding);
  const snr = (t: number) => Math.log(alphaBars[t] / (1 - alphaBars[t]));
  let x = noise();
  let last: { t: number; x0: Float32Array } | null = null;
  yield x;
  for (const [k, t] of times.entries()) {
    const previous = k + 1 < times.length ? times[k + 1] : -1;
    const [now, before] = [alphaBars[t], previous >= 0 ? alphaBars[previous] : 1];
    const [signal, spread] = [Math.sqrt(now), Math.sqrt(1 - now)];
    const answer = await predict(x, t);
    const x0: Float32Array = x.map((value, i) => {
      const clean = objective === "v" ? signal * value - spread * answer[i] : (value - spread * answer[i]) / signal;
      return Math.min(Math.max(clean, -1), 1);
    });
    // DPM-Solver++(2M) is the DDIM step with x₀ extrapolated half a step along ln SNR, from the step before.
    const extrapolate = sampler === "dpm-solver++" && last && previous >= 0;
    const ratio = extrapolate && last ? (snr(previous) - snr(t)) / (snr(t) - snr(last.t)) / 2 : 0;
    const variance = eta ** 2 * ((1 - before) / (1 - now)) * (1 - now / before);
    const onNoise = Math.sqrt(Math.max(1 - before - variance, 0) / (1 - now));
    const onX0 = Math.sqrt(before) - onNoise * signal;
    const deviation = Math.sqrt(variance);
    const fresh = eta > 0 ? noise() : null;
    const estimate = last;
    x = x.map((value, i) => {
      const ahead = ratio && estimate ? x0[i] + ratio * (x0[i] - estimate.x0[i]) : x0[i];
      return onX0 * ahead + onNoise * value + (fresh ? deviation * fresh[i] : 0);
    });
    last = { t, x0 };
    yield x;
  }
}

/** Standard normal numbers that follow from a seed and the number of a structure alone (Box and Muller; mulberry32). */
export function normals(seed: number, row: number): () => number {
  let state = (Math.imul(seed + 1, 0x9e3779b1) ^ Math.imul(row + 1, 0x85ebca6b)) >>> 0;
  const uniform = () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = Math.imul(state ^ (state >>> 15), state | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
  return () => Math.sqrt(-2 * Math.log(1 - uniform())) * Math.cos(2 * Math.PI * uniform());
}
