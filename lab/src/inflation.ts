/** Inflation of a structure, as `inflate_lib.mechanics.inflation`: plane strain, neo-Hookean, follower pressure. */

import { buildSystem, ELEMENTS, type Element, march, type System } from "./equilibrium.ts";
import { multiplications } from "./factor.ts";
import type { Edge, Image } from "./labels.ts";
import { buildMesh, type Mesh } from "./mesh.ts";
import { general, Refusal } from "./words.ts";

export const PRESSURE = 0.01; // internal pressure at t = 1: p(t) = PRESSURE · t
export const LAMBDA = 16.44; // Lamé parameters (paper sec. 3)
export const MU = 0.1644;

const FACTORISATIONS = [1000, 100] as const; // allowed in all, or per load step if that is more
const SPEED = 1.25e9; // multiply-adds per second of the nominal core that turns a time limit into factorisations
const ASSEMBLY = 300; // multiply-adds per element and factorisation
const MOST_STEPS = 200; // more would not be seen, and keep the page waiting

export interface InflateOptions {
  steps?: number; // equal load steps
  element?: Element;
  pressure?: number; // at t = 1, which it grows to in proportion to t
  lame?: [number, number]; // (λ, μ)
  clamped?: Edge;
  timeLimit?: number; // seconds of the nominal core, which become a number of factorisations
}

/** An inflated structure, with every load step. */
export interface Inflation {
  mesh: Mesh;
  element: Element;
  pressures: number[];
  displacement: Float64Array[]; // (steps) of (n, 2); NaN from the first load step that did not converge
  converged: boolean;
  reason: string; // why not; empty where converged
  factorisations: number;
  lame: [number, number];
}

/** Inflate a structure given as a label image. Throws a Refusal where it, or an option, cannot be taken. */
export function inflate(label: Image, options: InflateOptions = {}): Inflation {
  const { steps = 10, element = "mean-dilatation", pressure = PRESSURE, lame = [LAMBDA, MU] } = options;
  const { clamped = "bottom", timeLimit } = options;
  if (!ELEMENTS.includes(element)) throw new Refusal(`element must be one of ${ELEMENTS.join(", ")}, not ${element}`);
  if (!Number.isInteger(steps) || steps < 1 || steps > MOST_STEPS) {
    throw new Refusal(`steps must be a whole number from 1 to ${MOST_STEPS}, not ${steps}`);
  }
  if (!Number.isFinite(pressure)) throw new Refusal(`pressure must be a finite number, not ${pressure}`);
  if (lame.length !== 2 || !lame.every((value) => Number.isFinite(value) && value > 0)) {
    throw new Refusal(`lame must be two positive numbers (λ, μ), not ${lame}`);
  }
  if (!(timeLimit === undefined || timeLimit > 0)) {
    throw new Refusal(`timeLimit must be a positive number of seconds, not ${timeLimit}`);
  }
  const mesh = buildMesh(label, clamped);
  const system = buildSystem(mesh, element, ...lame);
  const pressures = Array.from({ length: steps }, (_, k) => pressure * ((k + 1) / steps));
  let allowed = Math.max(FACTORISATIONS[0], FACTORISATIONS[1] * steps);
  let limit = "";
  if (timeLimit !== undefined && timeLimit < allowed * nominalSeconds(system)) {
    allowed = Math.floor(timeLimit / nominalSeconds(system));
    limit = `, the time limit of ${general(timeLimit)} s`;
  }
  const { positions, factorisations, turnedOver } = march(system, pressures, allowed);
  const displacement = pressures.map((_, step) => {
    const found = new Float64Array(2 * mesh.n).fill(step < positions.length ? 0 : Number.NaN);
    if (step < positions.length) {
      system.order.forEach((node, i) => {
        for (let d = 0; d < 2; d++) found[2 * node + d] = positions[step][2 * i + d] - mesh.nodes[2 * node + d];
      });
    }
    return found;
  });
  const reached = positions.length;
  let reason = "";
  if (reached < steps) {
    const at = `load step ${reached + 1} of ${steps} (pressure ${general(pressures[reached], 4)})`;
    reason = `no equilibrium was found at ${at}`;
    if (turnedOver) reason += ": an element turns inside out";
    else if (factorisations >= allowed) reason += ` within ${allowed} factorisations${limit}`;
  }
  return { mesh, element, pressures, displacement, converged: reached === steps, reason, factorisations, lame };
}

function nominalSeconds(system: System): number {
  return (multiplications(system.pattern) + ASSEMBLY * system.m) / SPEED;
}

/** (n, 2) deformed coordinates at a load step, the last one by default; step −1 + steps. At rest: `mesh.nodes`. */
export function deformed(result: Inflation, step = result.displacement.length - 1): Float64Array {
  return result.mesh.nodes.map((value, k) => value + result.displacement[step][k]);
}
