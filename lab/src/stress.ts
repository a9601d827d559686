/**
 * Von Mises stress and largest stretch of each element, as `inflate_lib.mechanics.stress`: means over its Gauss points.
 *
 * σ = μ b / J + φ′ I in plane strain, b = F Fᵀ and b₃₃ = 1; the pressure φ′ has no part in the von Mises stress.
 */

import { shapeGradients } from "./equilibrium.ts";
import type { Mesh } from "./mesh.ts";

export interface Stress {
  vonMisesOverMu: Float64Array; // (m,) σ/μ
  stretch: Float64Array; // (m,) largest principal stretch in the plane
}

/** Stress and stretch of the elements of a mesh whose nodes have these positions (n, 2). */
export function stress(mesh: Mesh, positions: Float64Array): Stress {
  const gradients = shapeGradients(mesh.size);
  const m = mesh.cells.length / 4;
  const [vonMisesOverMu, stretch] = [new Float64Array(m), new Float64Array(m)];
  for (let e = 0; e < m; e++) {
    for (let q = 0; q < 4; q++) {
      let [f00, f01, f10, f11] = [0, 0, 0, 0];
      for (let a = 0; a < 4; a++) {
        const node = 2 * mesh.cells[4 * e + a];
        const [gx, gy] = [gradients[8 * q + 2 * a], gradients[8 * q + 2 * a + 1]];
        f00 += positions[node] * gx;
        f01 += positions[node] * gy;
        f10 += positions[node + 1] * gx;
        f11 += positions[node + 1] * gy;
      }
      const J = f00 * f11 - f01 * f10;
      const [xx, yy, xy] = [f00 * f00 + f01 * f01, f10 * f10 + f11 * f11, f00 * f10 + f01 * f11]; // of b
      const squares = ((xx - yy) ** 2 + (yy - 1) ** 2 + (1 - xx) ** 2) / 2 + 3 * xy * xy;
      vonMisesOverMu[e] += Math.sqrt(squares) / J / 4;
      const trace = xx + yy; // λ₁² + λ₂², where λ₁ λ₂ = J
      const difference = Math.sqrt(Math.max(trace * trace - 4 * J * J, 0));
      stretch[e] += Math.sqrt((trace + difference) / 2) / 4;
    }
  }
  return { vonMisesOverMu, stretch };
}
