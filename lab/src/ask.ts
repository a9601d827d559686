/** Structures for targets, as `inflate_lib.models.weights.Model.draw` draws them; runs in the network's worker. */

import type { DescriptorName, Targets } from "./descriptors.ts";
import { FRAME } from "./labels.ts";
import { type StoredModel, told, type Way } from "./model.ts";
import type { Network } from "./network.ts";
import { checkReach, readReach } from "./reach.ts";
import { cosineSchedule, denoise, normals, type SamplingOptions } from "./sampling.ts";
import { checkTargets } from "./targets.ts";
import { Refusal } from "./words.ts";

const PIXELS = FRAME * FRAME;
export const MOST = 16; // structures of one call

export interface DrawOptions extends Partial<SamplingOptions> {
  n?: number; // structures
  purpose?: string; // "quick", the default, or "varied"; other options of sampling have no calibration
  seed?: number;
  noise?: ArrayLike<number>[]; // standard normal images (n · 784), one for each state but the last, to take the seed's place
}

/** Images (784,) in [0, 1] that are drawn to inflate to the targets; `watch` sees every state on the way. */
export async function drawStructures(
  model: StoredModel,
  network: Network,
  targets: Targets,
  options: DrawOptions = {},
  watch: (states: Float64Array[]) => void = () => {},
): Promise<Float64Array[]> {
  const { n = 1, seed = 0, noise, purpose = "quick", ...changes } = options;
  const way = Object.hasOwn(model.ways, purpose) ? model.ways[purpose] : null;
  if (!way) throw new Refusal(`purpose must be one of ${Object.keys(model.ways).join(", ")}, not ${purpose}`);
  const sampling: SamplingOptions = { ...way.sampling, ...changes };
  const asTold = (Object.keys(changes) as (keyof SamplingOptions)[]).every(
    (key) => sampling[key] === way.sampling[key],
  );
  if (!Number.isInteger(n) || n < 1 || n > MOST)
    throw new Refusal(`n must be a whole number from 1 to ${MOST}, not ${n}`);
  if (!Number.isInteger(seed) || seed < 0) throw new Refusal(`seed must be a whole number of at least 0, not ${seed}`);
  const { strongest, T, objective } = model.config;
  if (!(sampling.guidance >= 1 && sampling.guidance <= strongest)) {
    throw new Refusal(`guidance must be from 1 to ${strongest}, not ${sampling.guidance}`);
  }
  if (!(sampling.eta >= 0 && sampling.eta <= 1)) throw new Refusal(`eta must be from 0 to 1, not ${sampling.eta}`);
  const checked = checkTargets(targets);
  checkReach(checked, readReach(model.reach));
  const conditions = scaled(model, conditionsFor(model, checked, asTold ? way : null));
  const streams = Array.from({ length: n }, (_, row) => normals(seed, row));
  let state = 0;
  const next = () => {
    const given = noise?.[state++];
    if (noise && given?.length !== n * PIXELS)
      throw new Refusal(`noise must be images of ${n * PIXELS} numbers, one for each step`);
    if (given) return Float32Array.from(given);
    const made = new Float32Array(n * PIXELS);
    streams.forEach((normal, row) => {
      for (let k = 0; k < PIXELS; k++) made[row * PIXELS + k] = normal();
    });
    return made;
  };
  const predict = async (x: Float32Array, t: number) => {
    await new Promise((resolve) => setTimeout(resolve)); // so that the page sees the state before
    return network.predict(x, FRAME, t, conditions, sampling.guidance);
  };
  let images: Float64Array[] = [];
  for await (const x of denoise(predict, cosineSchedule(T), next, objective, sampling)) {
    images = Array.from({ length: n }, (_, row) =>
      Float64Array.from(x.subarray(row * PIXELS, (row + 1) * PIXELS), (value) =>
        Math.min(Math.max((value + 1) / 2, 0), 1),
      ),
    );
    watch(images);
  }
  return images;
}

/** What the network is told, calibrated where the combination is; NaN for what is not asked for. */
function conditionsFor(model: StoredModel, targets: Targets, way: Way | null): number[] {
  const parts = model.parts.filter(({ name }) => name in targets);
  const wanted = parts.flatMap(({ name }) => [targets[name as DescriptorName] ?? []].flat(2));
  const calibration = way?.calibrations[parts.map(({ name }) => name).join("+")];
  const given = calibration ? told(calibration, wanted) : wanted;
  let at = 0;
  return model.parts.flatMap(({ name, length }) => {
    if (!(name in targets)) return new Array<number>(length).fill(Number.NaN);
    at += length;
    return given.slice(at - length, at);
  });
}

function scaled(model: StoredModel, conditions: number[]): number[] {
  return conditions.map((value, k) => {
    const extent = model.conditionMax[k] - model.conditionMin[k];
    return (value - model.conditionMin[k]) / (extent > 0 ? extent : 1);
  });
}
