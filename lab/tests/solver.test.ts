/** The solver finds what `inflate_lib` finds (reference.json, written by write_reference.py), and what is known anyway. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { flipChanges, sensitivities } from "../src/adjoint.ts";
import { findFlaw } from "../src/buildable.ts";
import { crossings, selfContact } from "../src/contact.ts";
import { describe, describeNodes, deviation, gradient, largestMiss, outlineGradient } from "../src/descriptors.ts";
import { blockNumber, eliminate, factorise, solve } from "../src/factor.ts";
import { deformed, type Inflation, inflate } from "../src/inflation.ts";
import { FRAME, labelImage, labelled, pointJoints, turned, VOID, WALL } from "../src/labels.ts";
import { boundaryLoops, buildMesh, cavityLines } from "../src/mesh.ts";
import { crumbs, refine } from "../src/refine.ts";
import { convexHull, medialAxis, outlineCorners, polygonArea, supportFunction } from "../src/shape.ts";
import { general } from "../src/words.ts";

const reference = JSON.parse(readFileSync(new URL("../tests/reference.json", import.meta.url), "utf8"));
const bytes = (text: string) => new Uint8Array(Buffer.from(text, "base64"));

function near(found: ArrayLike<number>, wanted: ArrayLike<number>, tolerance: number, what: string) {
  assert.equal(found.length, wanted.length, what);
  const worst = Math.max(...Array.from(wanted, (value, k) => Math.abs(value - found[k])));
  assert.ok(worst <= tolerance, `${what}: off by ${worst}`);
}

for (const wanted of reference.cases) {
  test(`${wanted.name} ${JSON.stringify(wanted.options)}`, () => {
    const { image, options, refusal } = wanted;
    const labelOptions = { clamped: options.clamped ?? "bottom" };
    if (refusal) {
      assert.throws(() => inflate(labelImage(bytes(image), labelOptions), options), {
        name: "Refusal",
        message: refusal,
      });
      return;
    }
    const { label, note } = labelled(bytes(image), labelOptions);
    assert.deepEqual(
      Array.from(label, (value) => 2 * value),
      Array.from(bytes(wanted.label)),
    );
    assert.equal(note, wanted.note);
    const result = inflate(label, options);
    assert.equal(result.reason, wanted.reason);
    assert.equal(findFlaw(result), wanted.flaw);
    if (!wanted.converged) return;
    near(result.displacement[result.displacement.length - 1], wanted.displacement, 1e-8, "displacement");
    near(
      result.displacement.map((step) => Math.max(...step.map(Math.abs))),
      wanted.largest,
      1e-8,
      "load steps",
    );
    const { axis, outline, ...numbers } = describe(result);
    for (const [name, value] of Object.entries(numbers)) near([value], [wanted.descriptors[name]], 1e-8, name);
    near(axis.flat(), wanted.descriptors.axis.flat(), 1e-8, "axis");
    near(outline, wanted.descriptors.outline, 1e-8, "outline");
    assert.equal(selfContact(result), wanted.self_contact);
  });
}

test("the outline's deviation changes as its gradient says", () => {
  const { displacement, mesh } = inflate(labelImage(bytes(reference.adjoint.image)));
  const nodes = mesh.nodes.map((value, k) => value + displacement[displacement.length - 1][k]);
  const target = describeNodes(nodes).outline.map((value, k) => value + 0.05 * Math.cos(k) + 0.01);
  const away = (x: Float64Array) => deviation("outline", { ...describeNodes(x), stress: 0, stretch: 0 }, target);
  const moves = nodes.map((_, k) => (mesh.clamped[k >> 1] ? 0 : Math.sin(7 * k + 1)));
  const h = 1e-6;
  const [ahead, behind] = [h, -h].map((step) => away(nodes.map((value, k) => value + step * moves[k])));
  const expected = outlineGradient(nodes, target).reduce((sum, value, k) => sum + value * moves[k], 0);
  near([(ahead - behind) / (2 * h)], [expected], 1e-8, "derivative");
});

test("an outline's corners have its support function", () => {
  const supports = supportFunction([
    [0, 0],
    [2, 0],
    [2.5, 1],
    [1, 2],
  ]);
  near(supportFunction(outlineCorners(supports)), supports, 1e-12, "supports");
});

test("sensitivities are those of the library", () => {
  const label = labelImage(bytes(reference.adjoint.image));
  const result = inflate(label);
  for (const name of ["height", "width", "area"] as const) {
    const load = gradient(name, deformed(result));
    assert.ok(load);
    const sensitivity = sensitivities(result, load);
    near(sensitivity, reference.adjoint[name].sensitivity, 1e-7, name);
    const changes = flipChanges(label, sensitivity).filter((_, k) => label[k] === VOID);
    near(changes, reference.adjoint[name].cavity, 1e-6, `flips for ${name}`);
  }
});

test("a factor solves its system, and an indefinite matrix has none", () => {
  const cells = Int32Array.from([0, 1, 2, 3, 2, 3, 4, 5, -1, 5, 0, 4]);
  const pattern = eliminate(6, cells);
  const number = pattern.order.reduce((all, node, j) => all.set(node, j), new Map<number, number>());
  const n = 12;
  const dense = Array.from({ length: n }, () => new Float64Array(n));
  const blocks = new Float64Array(4 * (pattern.rows.length + 6));
  const at = (i: number, j: number, value: number) => {
    const [row, column] = [number.get(i >> 1) ?? 0, number.get(j >> 1) ?? 0];
    if (row < column) return;
    dense[i][j] = dense[j][i] = value;
    const block = 4 * blockNumber(pattern, row, column);
    blocks[block + 2 * (i & 1) + (j & 1)] = value;
    if (row === column) blocks[block + 2 * (j & 1) + (i & 1)] = value;
  };
  for (let e = 0; e < 3; e++) {
    const nodes = [...cells.subarray(4 * e, 4 * e + 4)].filter((node) => node >= 0);
    for (const a of nodes)
      for (const b of nodes)
        for (let k = 0; k < 4; k++) {
          const [i, j] = [2 * a + (k >> 1), 2 * b + (k & 1)];
          at(i, j, i === j ? 20 + i : Math.sin(1 + i * j + i + j));
        }
  }
  const indefinite = blocks.slice();
  const x = Float64Array.from({ length: n }, (_, i) => Math.cos(i));
  const rhs = new Float64Array(n);
  for (let i = 0; i < n; i++) {
    const place = 2 * (number.get(i >> 1) ?? 0) + (i & 1);
    rhs[place] = dense[i].reduce((sum, value, j) => sum + value * x[j], 0);
  }
  const inverses = new Float64Array(24);
  assert.ok(factorise(pattern, blocks, inverses));
  solve(pattern, blocks, inverses, rhs);
  near(
    Float64Array.from(x, (_, i) => rhs[2 * (number.get(i >> 1) ?? 0) + (i & 1)]),
    x,
    1e-13,
    "solution",
  );
  indefinite[4 * pattern.rows.length + 3] = -1;
  assert.ok(!factorise(pattern, indefinite, inverses));
});

test("a mirrored structure inflates to the mirror image, a turned one to the turned", () => {
  const label = labelImage(bytes(reference.cases[0].image));
  const mirrored = label.map((_, k) => label[k - (k % FRAME) + FRAME - 1 - (k % FRAME)]);
  const [one, other] = [describe(inflate(label)), describe(inflate(mirrored))];
  near(
    [one.height, one.width, one.area, one.stress],
    [other.height, other.width, other.area, other.stress],
    1e-9,
    "sizes",
  );
  near(
    one.axis.map(([x]) => -x),
    other.axis.map(([x]) => x),
    1e-9,
    "axis",
  );
  const lying = describe(inflate(turned(label, 1), { clamped: "right" }));
  near([lying.width, lying.height], [one.height, one.width], 1e-9, "turned");
});

test("what lies within the loops is wall and void", () => {
  for (const { image, refusal } of reference.cases.slice(0, 12)) {
    if (refusal) continue;
    const label = labelImage(bytes(image));
    const mesh = buildMesh(label);
    const area = boundaryLoops(mesh.cells)
      .map((loop) => polygonArea(loop.map((node) => [mesh.nodes[2 * node], mesh.nodes[2 * node + 1]])))
      .reduce((sum, value) => sum + value, 0);
    assert.ok(Math.abs(area * FRAME ** 2 - label.filter((value) => value === WALL).length) < 1e-9);
  }
});

test("the lines around the void enclose as much as it has pixels", () => {
  const label = labelImage(bytes(reference.cases[0].image));
  const mesh = buildMesh(label);
  const areas = cavityLines(mesh).map((line) =>
    polygonArea(line.map((i) => [mesh.nodes[2 * i], mesh.nodes[2 * i + 1]])),
  );
  near([areas.reduce((a, b) => a + b)], [label.filter((value) => value === VOID).length / FRAME ** 2], 1e-12, "area");
});

test("joints of one node are found where they are", () => {
  const label = new Float64Array(16);
  label[0] = label[5] = label[2] = WALL;
  assert.deepEqual(pointJoints(label), [6, 7]);
});

test("edges that cross are told from those that touch", () => {
  const x = Float64Array.from([0, 0, 2, 2, 0, 2, 2, 0, 1, 1, 3, 1]);
  assert.deepEqual(crossings(x, Int32Array.from([0, 1, 2, 3])), [[0, 1, 2, 3]]);
  assert.deepEqual(crossings(x, Int32Array.from([0, 1, 4, 5])), []);
});

test("a square is its own hull, and its axis rises in its middle", () => {
  const nodes = Float64Array.from([0, 0, 1, 0, 1, 1, 0, 1, 0.5, 0, 0.5, 0.5, 1, 0.25]);
  const hull = convexHull(nodes).map((i) => [nodes[2 * i], nodes[2 * i + 1]]);
  assert.equal(hull.length, 4);
  assert.equal(polygonArea(hull), 1);
  const axis = medialAxis(hull);
  near(
    axis.map(([x]) => x),
    new Array(30).fill(0),
    1e-15,
    "x",
  );
  near(
    axis.map(([, y]) => y),
    axis.map((_, k) => k / 30),
    1e-15,
    "y",
  );
});

test("the largest miss counts, as a share of its target", () => {
  const found = describe(inflate(labelImage(bytes(reference.cases[0].image))));
  assert.ok(Math.abs(largestMiss({ height: found.height / 1.1, width: found.width }, found) - 0.1) < 1e-12);
  assert.equal(largestMiss({ axis: found.axis }, found), 0);
});

test("single pixels that stick out are crumbs, and what they uncover", () => {
  const cavity = new Float64Array(FRAME ** 2);
  const at = (row: number, column: number) => row * FRAME + column;
  for (let k = 0; k < 64; k++) cavity[at(8 + (k >> 3), 8 + (k & 7))] = 1;
  assert.deepEqual(crumbs(cavity), []);
  for (const column of [16, 17, 18]) cavity[at(10, column)] = 1; // a line of three
  cavity[at(15, 12)] = 0; // a dent
  assert.deepEqual(crumbs(cavity), [at(10, 16), at(10, 17), at(10, 18), at(15, 12)]);
});

test("refinement brings a structure nearer and leaves no crumb", () => {
  let [changed, rough] = [0, 0];
  for (const { image } of reference.cases.slice(0, 12)) {
    const label = labelImage(bytes(image));
    if (findFlaw(inflate(label))) continue;
    const height = 0.985 * describe(inflate(label)).height;
    const found = refine(
      label.map((value) => Number(value === VOID)),
      { height },
      {},
      2e-3,
      6,
    );
    assert.ok(Math.abs(describe(inflate(found.label)).height / height - 1) - found.miss < 1e-9);
    if (!found.flipped.length) continue;
    assert.ok(found.miss < 1 / 0.985 - 1);
    const cavity = (some: Float64Array) => some.map((value) => Number(value === VOID));
    assert.deepEqual(crumbs(cavity(found.label)), []);
    changed++;
    rough += Number(crumbs(cavity(label)).length > 0);
  }
  assert.ok(changed >= 3 && rough >= 1, `${changed} changed, ${rough} with crumbs`);
});

test("options out of range are refused", () => {
  const label = labelImage(bytes(reference.cases[0].image));
  const refused = (options: object, message: RegExp) =>
    assert.throws(() => inflate(label, options), { name: "Refusal", message });
  refused({ steps: 0 }, /steps/);
  refused({ steps: 2.5 }, /steps/);
  refused({ pressure: Number.NaN }, /pressure/);
  refused({ lame: [0, 1] }, /lame/);
  refused({ element: "q2" }, /element/);
  refused({ clamped: "middle" }, /clamped/);
  refused({ timeLimit: -1 }, /timeLimit/);
  assert.throws(() => describe({} as Inflation), { name: "Refusal", message: /what inflate gives/ });
  assert.throws(() => labelImage([[0, 1]]), /shape \(1, 2\)/);
  assert.throws(() => labelImage(new Float64Array(784).fill(2)), /values from 2 to 2/);
  assert.throws(() => labelImage("seven"), /not an array/);
  assert.throws(() => labelImage(new Float64Array(784), { wall: 0 }), /wall/);
});

test("numbers are written as Python writes them", () => {
  const written = [
    general(0.0001234),
    general(123456789),
    general(0.00001),
    general(0.5),
    general(0.0123456, 4),
    general(1e6),
  ];
  assert.deepEqual(written, ["0.0001234", "1.23457e+08", "1e-05", "0.5", "0.01235", "1e+06"]);
});
