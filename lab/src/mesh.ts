/** From a label image to a finite-element mesh of the wall, as `inflate_lib.mechanics.mesh` does: one quad per pixel. */

import { components, type Edge, type Image, isOpen, OUTSIDE, turned, turnsToBottom, VOID, WALL } from "./labels.ts";
import { Refusal } from "./words.ts";

export interface Mesh {
  size: number; // pixels per side of the label image
  n: number; // nodes
  nodes: Float64Array; // (n, 2) undeformed coordinates in lengths of the unit square, y upwards
  cells: Int32Array; // (m, 4) node numbers, counter-clockwise from the lower left
  pressureEdges: Int32Array; // (k, 2) edges between wall and void, counter-clockwise around the cavity
  clamped: Uint8Array; // (n,) 1 where a node cannot move
  lattice: Int32Array; // (n,) lattice point of each node, row · (size + 1) + column from the upper left
}

/** Mesh the wall of a label image. Throws a Refusal where it cannot be inflated. */
export function buildMesh(label: Image, clamped: Edge = "bottom"): Mesh {
  checkLabel(label, clamped);
  const size = Math.sqrt(label.length);
  const points = size + 1; // lattice points per row
  const corners: number[] = [];
  label.forEach((value, k) => {
    if (value !== WALL) return;
    const corner = Math.floor(k / size) * points + (k % size);
    corners.push(corner + points, corner + points + 1, corner + 1, corner);
  });
  const edges = cavityEdges(label, size);

  const number = new Int32Array(points * points).fill(-1);
  for (const corner of corners) number[corner] = 0;
  const lattice: number[] = [];
  number.forEach((used, point) => {
    if (used === 0) number[point] = lattice.push(point) - 1;
  });
  const n = lattice.length;
  const nodes = new Float64Array(2 * n);
  const held = new Uint8Array(n);
  lattice.forEach((point, node) => {
    const [x, y] = [point % points, size - Math.floor(point / points)];
    nodes[2 * node] = x / size;
    nodes[2 * node + 1] = y / size;
    const onEdge = { bottom: y === 0, left: x === 0, top: y === size, right: x === size }[clamped];
    held[node] = onEdge ? 1 : 0;
  });
  const renumbered = (list: number[]) => Int32Array.from(list, (point) => number[point] ?? -1);
  return {
    size,
    n,
    nodes,
    cells: renumbered(corners),
    pressureEdges: renumbered(edges),
    clamped: held,
    lattice: Int32Array.from(lattice),
  };
}

function checkLabel(label: Image, clamped: Edge): void {
  const turns = turnsToBottom(clamped);
  const size = Math.sqrt(label.length);
  if (!Number.isInteger(size) || size === 0) {
    throw new Refusal(`label: a square image is needed, not an array of shape (${label.length},)`);
  }
  if (!label.every((value) => value === WALL || value === VOID || value === OUTSIDE)) {
    throw new Refusal("label: values must be 0 (outside), 0.5 (wall) or 1 (void); make them with label_image(image)");
  }
  if (!label.includes(WALL)) throw new Refusal("label: there is no wall (0.5)");
  if (!label.includes(VOID)) throw new Refusal("label: there is no void (1) to put under pressure");
  if (!turned(label, turns).subarray(-size).includes(WALL)) {
    throw new Refusal(`label: nothing is clamped, because no wall reaches the ${clamped} edge of the image`);
  }
  // Connected by edges: two pixels that share a corner only would make a hinge.
  const wall = label.map((value) => (value === WALL ? 1 : 0));
  const pieces = components(wall, size, false).sizes.length;
  if (pieces > 1) throw new Refusal(`label: the wall falls into ${pieces} pieces that share no edge`);
  if (isOpen(label, clamped)) {
    throw new Refusal("label: the cavity is open, because a void pixel (1) touches the outside (0) or the frame");
  }
}

/** Edges between void and wall as pairs of lattice points, counter-clockwise around the void. */
function cavityEdges(label: Image, size: number): number[] {
  const points = size + 1;
  const edges: number[] = [];
  const wall = (row: number, column: number) =>
    row >= 0 && column >= 0 && row < size && column < size && label[row * size + column] === WALL;
  const around = [
    { down: 1, across: 0, start: points, end: points + 1 },
    { down: 0, across: 1, start: points + 1, end: 1 },
    { down: -1, across: 0, start: 1, end: 0 },
    { down: 0, across: -1, start: 0, end: points },
  ];
  for (const { down, across, start, end } of around) {
    label.forEach((value, k) => {
      const [row, column] = [Math.floor(k / size), k % size];
      if (value !== VOID || !wall(row + down, column + across)) return;
      const corner = row * points + column;
      edges.push(corner + start, corner + end);
    });
  }
  return edges;
}

/** Lines around the void, from edge to edge between wall and void; closed ones, or from the ground to the ground. */
export function cavityLines({ pressureEdges }: Mesh): number[][] {
  const ways = new Map<number, number[]>();
  const entered = new Set<number>();
  for (let k = 0; k < pressureEdges.length; k += 2) {
    ways.set(pressureEdges[k], [...(ways.get(pressureEdges[k]) ?? []), pressureEdges[k + 1]]);
    entered.add(pressureEdges[k + 1]);
  }
  const starts = [...ways.keys()];
  starts.sort((a, b) => Number(entered.has(a)) - Number(entered.has(b))); // those on the ground first
  return starts.flatMap((start) => {
    const line: number[] = [];
    for (let at: number | undefined = start; at !== undefined; at = ways.get(at)?.pop()) line.push(at);
    return line.length > 1 ? [line] : [];
  });
}

/** (k, 2) edges that belong to one quadrilateral only, the smaller node first, in increasing order. */
export function boundaryEdges(cells: Int32Array): Int32Array {
  const seen = new Map<number, number>();
  const span = cells.reduce((most, node) => Math.max(most, node), 0) + 1;
  forEachSide(cells, (start, end) => {
    const code = Math.min(start, end) * span + Math.max(start, end);
    seen.set(code, (seen.get(code) ?? 0) + 1);
  });
  const once = [...seen].filter(([, count]) => count === 1).map(([code]) => code);
  once.sort((a, b) => a - b);
  return Int32Array.from(once.flatMap((code) => [Math.floor(code / span), code % span]));
}

/** Closed lines around quadrilaterals, which lie on their left: the outer border, and the border of each hole. */
export function boundaryLoops(cells: Int32Array): number[][] {
  const border = new Set<string>();
  const edges = boundaryEdges(cells);
  for (let k = 0; k < edges.length; k += 2) border.add(`${edges[k]},${edges[k + 1]}`);
  const cellOf = new Map<string, number>();
  const leaving = new Map<number, [number, number][]>();
  forEachSide(cells, (start, end, cell) => {
    if (!border.has(`${Math.min(start, end)},${Math.max(start, end)}`)) return;
    cellOf.set(`${start},${end}`, cell);
    leaving.set(start, [...(leaving.get(start) ?? []), [start, end]]);
  });
  const loops: number[][] = [];
  const left = new Set(cellOf.keys());
  for (const first of cellOf.keys()) {
    const loop: number[] = [];
    let edge = first;
    while (left.delete(edge)) {
      const [start = 0, end = 0] = edge.split(",").map(Number);
      loop.push(start);
      // Where two quadrilaterals meet at a corner only, the loop goes on along the other one.
      const ways = leaving.get(end) ?? [];
      const next = ways.find((way) => cellOf.get(`${way[0]},${way[1]}`) !== cellOf.get(edge)) ?? ways[0];
      if (!next) break;
      edge = `${next[0]},${next[1]}`;
    }
    if (loop.length) loops.push(loop);
  }
  return loops;
}

function forEachSide(cells: Int32Array, visit: (start: number, end: number, cell: number) => void): void {
  for (let k = 0; k < cells.length; k++) {
    const next = k % 4 === 3 ? k - 3 : k + 1;
    visit(cells[k], cells[next], k >> 2);
  }
}
