/** Pictures of a structure: its elements in colours of stretch or stress, what is wrong with it, and what was asked for. */

import { make } from "./dom.ts";
import { cavityLines } from "./mesh.ts";
import type { Simulation } from "./simulate.ts";

export type Quantity = "stretch" | "vonMises";
export const QUANTITIES: Record<Quantity, { words: string; rest: number }> = {
  vonMises: { words: "von Mises stress σ/μ", rest: 0 },
  stretch: { words: "largest stretch", rest: 1 },
};

const MESH = 400; // canvas pixels of a picture that shows the lines of the mesh

// Viridis, at even distances.
const RAMP = [
  [68, 1, 84],
  [70, 50, 127],
  [54, 92, 141],
  [39, 127, 142],
  [31, 161, 135],
  [74, 194, 109],
  [159, 218, 58],
  [253, 231, 37],
];

/** Colour of a share from 0 to 1. */
export function colour(share: number): string {
  const place = Math.min(Math.max(share, 0), 1) * (RAMP.length - 1);
  const low = Math.min(Math.floor(place), RAMP.length - 2);
  const channels = RAMP[low].map((value, k) => Math.round(value + (RAMP[low + 1][k] - value) * (place - low)));
  return `rgb(${channels.join(" ")})`;
}

/** Largest value of a quantity at any load step, at which the colours end. */
export function largest(simulation: Simulation, quantity: Quantity): number {
  const { rest } = QUANTITIES[quantity];
  return simulation[quantity].reduce((most, values) => values.reduce((a, b) => Math.max(a, b), most), rest + 1e-9);
}

/** What all states of a structure fit into. */
export function frameOf(simulation: Simulation) {
  const box = { left: 0, right: 1, bottom: 0, top: 1 };
  for (const x of simulation.positions) {
    for (let k = 0; k < x.length; k += 2) {
      box.left = Math.min(box.left, x[k]);
      box.right = Math.max(box.right, x[k]);
      box.bottom = Math.min(box.bottom, x[k + 1]);
      box.top = Math.max(box.top, x[k + 1]);
    }
  }
  return box;
}

/** Draw a structure at a load step (0: at rest) on a canvas that is `size` CSS pixels wide and high. */
export function draw(canvas: HTMLCanvasElement, simulation: Simulation, step: number, quantity: Quantity): void {
  const context = canvas.getContext("2d");
  if (!context) return;
  const size = canvas.width;
  context.fillStyle = "#fff";
  context.fillRect(0, 0, size, size);
  const box = frameOf(simulation);
  const margin = 0.06;
  const span = Math.max(box.right - box.left, box.top - box.bottom) + 2 * margin;
  const scale = size / span;
  const left = (box.left + box.right - span) / 2;
  const x = simulation.positions[step];
  const at = (node: number): [number, number] => [
    (x[2 * node] - left) * scale,
    size - (x[2 * node + 1] - box.bottom + margin) * scale,
  ];
  const { mesh } = simulation.result;
  const { cells, clamped } = mesh;
  context.fillStyle = "#dce9f2"; // the void, as in the figures of the book
  context.beginPath();
  for (const [first, ...others] of cavityLines(mesh)) {
    context.moveTo(...at(first));
    for (const node of others) context.lineTo(...at(node));
  }
  context.fill();
  const values = simulation[quantity][step];
  const { rest } = QUANTITIES[quantity];
  const most = largest(simulation, quantity);
  context.lineJoin = "round";
  for (let e = 0; e < values.length; e++) {
    context.fillStyle = context.strokeStyle = colour((values[e] - rest) / (most - rest));
    if (size >= MESH) context.strokeStyle = "rgb(255 255 255 / 60%)";
    context.beginPath();
    for (let a = 0; a < 4; a++) context.lineTo(...at(cells[4 * e + a]));
    context.closePath();
    context.fill();
    context.stroke();
  }
  // What is held, what holds together in one node, and walls that cross.
  context.fillStyle = "#222";
  clamped.forEach((held, node) => {
    if (held) context.fillRect(at(node)[0] - 2, at(node)[1] - 2, 4, 4);
  });
  context.strokeStyle = "#d55e00";
  context.lineWidth = Math.max(2, size / 120);
  for (const node of simulation.joints) {
    context.beginPath();
    context.arc(...at(node), size / 40, 0, 2 * Math.PI);
    context.stroke();
  }
  context.strokeStyle = "#cc0066";
  for (const [i, j, k, l] of simulation.crossing[step]) {
    context.beginPath();
    context.moveTo(...at(i));
    context.lineTo(...at(j));
    context.moveTo(...at(k));
    context.lineTo(...at(l));
    context.stroke();
  }
  context.lineWidth = 1;
}

/** The colours with the values at their ends, and what they show. */
export function legend(): { element: HTMLElement; tell: (simulation: Simulation, quantity: Quantity) => void } {
  const [low, words, high] = ["", "", ""].map((text) => make("span", {}, text));
  const bar = make("div", { class: "lab-bar" });
  bar.style.background = `linear-gradient(to right, ${RAMP.map((_, k) => colour(k / (RAMP.length - 1))).join(", ")})`;
  const element = make("div", { class: "lab-legend" }, bar, make("div", { class: "lab-ends" }, low, words, high));
  const tell = (simulation: Simulation, quantity: Quantity) => {
    low.textContent = QUANTITIES[quantity].rest.toFixed(1);
    words.textContent = QUANTITIES[quantity].words;
    high.textContent = largest(simulation, quantity).toFixed(2);
  };
  return { element, tell };
}
