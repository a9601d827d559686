/** Can a structure be built? As `inflate_lib.mechanics.buildable`: of several flaws the first is told. */

import { firstContact } from "./contact.ts";
import type { Inflation } from "./inflation.ts";
import { boundaryEdges } from "./mesh.ts";

export const FLAWS = {
  NO_EQUILIBRIUM: "No equilibrium was found at one of the load steps.",
  POINT_JOINT: "Parts of the wall hold together in a single node.",
  CROSSING_WALLS: "Walls cross at one of the load steps.",
} as const;
export type Flaw = keyof typeof FLAWS;

/** Why an inflated structure cannot be built, or null where it can be. Its wall is in one piece: else it has no mesh. */
export function findFlaw(result: Inflation): Flaw | null {
  if (!result.converged) return "NO_EQUILIBRIUM";
  const passes = new Uint8Array(result.mesh.n);
  for (const node of boundaryEdges(result.mesh.cells)) passes[node]++;
  if (passes.some((count) => count > 2)) return "POINT_JOINT"; // the border passes through a node twice
  return firstContact(result) >= 0 ? "CROSSING_WALLS" : null;
}
