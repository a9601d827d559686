/**
 * Sparse LDLᵀ of symmetric matrices with one 2 × 2 block for each pair of nodes that share an element.
 *
 * Eliminating a node couples all its neighbours: its elements grow together into one. So the elements say where the
 * factor fills in (George and Liu's quotient graph), and the node to eliminate next is the one with the fewest
 * neighbours left (minimum degree). Port of the first half of `inflate_lib.mechanics._kernels`.
 *
 * A matrix is an array (blocks, 4): the blocks of L, column after column, then those of the diagonal.
 */

/** Where the factor has blocks; nodes are numbered in the order of elimination. */
export interface Pattern {
  n: number;
  order: Int32Array; // (n,) order[j] is the node that is eliminated j-th
  columnStart: Int32Array; // (n + 1,)
  rows: Int32Array; // (b,) increasing in each column
  rowStart: Int32Array; // (n + 1,)
  columns: Int32Array; // (b,) the columns of each row, increasing
}

/** Order of elimination and pattern; cells (m, 4) of nodes that couple, entries < 0 are ignored. */
export function eliminate(n: number, cells: Int32Array): Pattern {
  const m = cells.length / 4;
  const members: number[][] = []; // nodes of each element; that of the j-th eliminated node has the number m + j
  const elements: number[][] = Array.from({ length: n }, () => []);
  for (let e = 0; e < m; e++) {
    const nodes = [...cells.subarray(4 * e, 4 * e + 4)].filter((node) => node >= 0);
    members.push(nodes);
    for (const node of nodes) elements[node].push(e);
  }
  const counted = new Int32Array(n);
  let stamp = 0;
  const count = (list: number[]): number => {
    let found = 0;
    for (const node of list) {
      if (counted[node] < stamp) {
        counted[node] = stamp;
        found++;
      }
    }
    return found;
  };
  const degree = new Float64Array(n);
  for (let node = 0; node < n; node++) {
    stamp++;
    degree[node] = -1; // itself
    for (const e of elements[node]) degree[node] += count(members[e]);
  }
  const order = new Int32Array(n);
  const seen = new Int32Array(n).fill(-1);
  const merged = new Uint8Array(m + n);
  for (let j = 0; j < n; j++) {
    let pivot = 0;
    for (let node = 1; node < n; node++) if (degree[node] < degree[pivot]) pivot = node;
    order[j] = pivot;
    degree[pivot] = Number.POSITIVE_INFINITY;
    seen[pivot] = j;
    const grown: number[] = [];
    for (const e of elements[pivot]) {
      merged[e] = 1;
      for (const node of members[e]) {
        if (seen[node] < j) {
          seen[node] = j;
          grown.push(node);
        }
      }
    }
    members.push(grown);
    for (const node of members[m + j]) {
      stamp++;
      let neighbours = count(members[m + j]) - 1;
      const kept = elements[node].filter((e) => !merged[e]);
      for (const e of kept) neighbours += count(members[e]);
      elements[node] = [...kept, m + j];
      degree[node] = neighbours;
    }
  }
  return sorted(n, order, members.slice(m));
}

/** The rows of each column, sorted by counting: columns into rows, and rows back into columns. */
function sorted(n: number, order: Int32Array, below: number[][]): Pattern {
  const number = new Int32Array(n);
  order.forEach((node, j) => {
    number[node] = j;
  });
  const columnStart = new Int32Array(n + 1);
  const rowStart = new Int32Array(n + 1);
  below.forEach((nodes, j) => {
    columnStart[j + 1] = columnStart[j] + nodes.length;
    for (const node of nodes) rowStart[number[node] + 1]++;
  });
  for (let row = 0; row < n; row++) rowStart[row + 1] += rowStart[row];
  const [rows, columns] = [new Int32Array(columnStart[n]), new Int32Array(columnStart[n])];
  const [endOfRow, endOfColumn] = [rowStart.slice(), columnStart.slice()];
  below.forEach((nodes, j) => {
    for (const node of nodes) columns[endOfRow[number[node]]++] = j;
  });
  for (let row = 0; row < n; row++) {
    for (let k = rowStart[row]; k < rowStart[row + 1]; k++) rows[endOfColumn[columns[k]]++] = row;
  }
  return { n, order, columnStart, rows, rowStart, columns };
}

/** Number of the block of two nodes in the order of elimination, row >= column. */
export function blockNumber(pattern: Pattern, row: number, column: number): number {
  if (row === column) return pattern.rows.length + row;
  let low = pattern.columnStart[column];
  let high = pattern.columnStart[column + 1];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (pattern.rows[middle] < row) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Multiplications (and as many additions) of one factorisation, apart from the inverses of the pivots. */
export function multiplications(pattern: Pattern): number {
  let sum = 0;
  for (let j = 0; j < pattern.n; j++) {
    const below = pattern.columnStart[j + 1] - pattern.columnStart[j];
    sum += 4 * below * (below - 1) + 14 * below;
  }
  return sum;
}

/**
 * Overwrite a matrix in `blocks` with L of A = L D Lᵀ, and `inverses` (n, 4) with the inverses of D's 2 × 2 blocks.
 *
 * Row i of L D solves a triangular system with the rows above it. Returns whether all pivots are positive definite.
 */
export function factorise(pattern: Pattern, blocks: Float64Array, inverses: Float64Array): boolean {
  const { n, columnStart: start, rows, rowStart, columns } = pattern;
  const diagonal = 4 * rows.length;
  const done = start.slice(0, n); // end of the part of each column that is finished
  const w = new Float64Array(4 * n); // the row at hand
  for (let i = 0; i < n; i++) {
    const [first, last] = [rowStart[i], rowStart[i + 1]];
    for (let r = first; r < last; r++) {
      const [j4, k4] = [4 * columns[r], 4 * done[columns[r]]];
      w[j4] = blocks[k4];
      w[j4 + 1] = blocks[k4 + 1];
      w[j4 + 2] = blocks[k4 + 2];
      w[j4 + 3] = blocks[k4 + 3];
    }
    let d00 = blocks[diagonal + 4 * i];
    let d10 = blocks[diagonal + 4 * i + 2];
    let d11 = blocks[diagonal + 4 * i + 3];
    for (let r = first; r < last; r++) {
      const j = columns[r];
      const [x00, x01, x10, x11] = [w[4 * j], w[4 * j + 1], w[4 * j + 2], w[4 * j + 3]];
      const end = done[j];
      for (let k = start[j]; k < end; k++) {
        const t = 4 * rows[k];
        const b = 4 * k;
        const l00 = blocks[b];
        const l01 = blocks[b + 1];
        const l10 = blocks[b + 2];
        const l11 = blocks[b + 3];
        w[t] -= x00 * l00 + x01 * l01;
        w[t + 1] -= x00 * l10 + x01 * l11;
        w[t + 2] -= x10 * l00 + x11 * l01;
        w[t + 3] -= x10 * l10 + x11 * l11;
      }
      const [v00, v01, v11] = [inverses[4 * j], inverses[4 * j + 1], inverses[4 * j + 3]];
      const l00 = x00 * v00 + x01 * v01;
      const l01 = x00 * v01 + x01 * v11;
      const l10 = x10 * v00 + x11 * v01;
      const l11 = x10 * v01 + x11 * v11;
      d00 -= l00 * x00 + l01 * x01;
      d10 -= l10 * x00 + l11 * x01;
      d11 -= l10 * x10 + l11 * x11;
      const b = 4 * end;
      blocks[b] = l00;
      blocks[b + 1] = l01;
      blocks[b + 2] = l10;
      blocks[b + 3] = l11;
      done[j] = end + 1;
    }
    const determinant = d00 * d11 - d10 * d10;
    if (!(d00 > 0 && determinant > 0)) return false;
    inverses[4 * i] = d11 / determinant;
    inverses[4 * i + 1] = inverses[4 * i + 2] = -d10 / determinant;
    inverses[4 * i + 3] = d00 / determinant;
  }
  return true;
}

/** Overwrite the right-hand side `x` (2 n) with the solution of L D Lᵀ x = b, given what `factorise` left. */
export function solve(pattern: Pattern, blocks: Float64Array, inverses: Float64Array, x: Float64Array): void {
  const { n, columnStart: start, rows } = pattern;
  for (let j = 0; j < n; j++) {
    const x0 = x[2 * j];
    const x1 = x[2 * j + 1];
    for (let k = start[j]; k < start[j + 1]; k++) {
      const i = 2 * rows[k];
      x[i] -= blocks[4 * k] * x0 + blocks[4 * k + 1] * x1;
      x[i + 1] -= blocks[4 * k + 2] * x0 + blocks[4 * k + 3] * x1;
    }
  }
  for (let j = n - 1; j >= 0; j--) {
    const x0 = x[2 * j];
    const x1 = x[2 * j + 1];
    let y0 = inverses[4 * j] * x0 + inverses[4 * j + 1] * x1;
    let y1 = inverses[4 * j + 2] * x0 + inverses[4 * j + 3] * x1;
    for (let k = start[j]; k < start[j + 1]; k++) {
      const i = 2 * rows[k];
      y0 -= blocks[4 * k] * x[i] + blocks[4 * k + 2] * x[i + 1];
      y1 -= blocks[4 * k + 1] * x[i] + blocks[4 * k + 3] * x[i + 1];
    }
    x[2 * j] = y0;
    x[2 * j + 1] = y1;
  }
}
