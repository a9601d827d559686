/** Everything that the page shows of one drawing: label, inflation, stress, flaws and descriptors, or why there is none. */

import { FLAWS, findFlaw } from "./buildable.ts";
import { crossingEdges } from "./contact.ts";
import { type Descriptors, describe } from "./descriptors.ts";
import { deformed, type InflateOptions, type Inflation, inflate } from "./inflation.ts";
import { type Image, type LabelOptions, labelled, pointJoints } from "./labels.ts";
import { stress } from "./stress.ts";
import { Refusal } from "./words.ts";

export interface Simulation {
  label: Image;
  note: string; // what of the drawing is not in the structure
  result: Inflation;
  reached: number; // load steps with an equilibrium
  positions: Float64Array[]; // of the nodes at rest and at each load step that was reached
  stretch: Float64Array[]; // of each element, likewise
  vonMises: Float64Array[]; // σ/μ, likewise
  joints: number[]; // nodes that alone hold parts of the wall together
  crossing: number[][][]; // pairs of edges whose walls cross, at rest and at each load step
  descriptors: Descriptors | null; // at the last load step; null where that has no equilibrium
  flaw: string; // why it cannot be built, in words; empty where it can be
}

export function simulate(image: unknown, options: LabelOptions & InflateOptions = {}): Simulation {
  const { label, note } = labelled(image, options);
  const result = inflate(label, { timeLimit: 1, ...options });
  const { mesh } = result;
  const reached = result.displacement.filter((step) => Number.isFinite(step[0])).length;
  const steps = Array.from({ length: reached }, (_, step) => step);
  const positions = [mesh.nodes, ...steps.map((step) => deformed(result, step))];
  const stresses = positions.map((x) => stress(mesh, x));
  const joints = new Set(pointJoints(label));
  const flaw = findFlaw(result);
  return {
    label,
    note,
    result,
    reached,
    positions,
    stretch: stresses.map((one) => one.stretch),
    vonMises: stresses.map((one) => one.vonMisesOverMu),
    joints: [...mesh.lattice.keys()].filter((node) => joints.has(mesh.lattice[node])),
    crossing: [[], ...steps.map((step) => crossingEdges(result, step))],
    descriptors: result.converged ? describe(result) : null,
    flaw: flaw === null ? "" : flaw === "NO_EQUILIBRIUM" ? sentence(result.reason) : FLAWS[flaw],
  };
}

/** The same, or the sentence that says why there is nothing to show. */
export function trySimulate(image: unknown, options: LabelOptions & InflateOptions = {}): Simulation | string {
  try {
    return simulate(image, options);
  } catch (error) {
    if (error instanceof Refusal) return sentence(error.message);
    throw error;
  }
}

/** A message as a sentence. */
export function sentence(message: string): string {
  return message && `${message[0].toUpperCase()}${message.slice(1)}${message.endsWith(".") ? "" : "."}`;
}
