/** Sampling: the schedule, the steps, and a network that knows the answer leads to it. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { fromHalf, told } from "../src/model.ts";
import { checkReach } from "../src/reach.ts";
import { cosineSchedule, denoise, normals, timesteps } from "../src/sampling.ts";
import { checkTargets } from "../src/targets.ts";

test("the cosine schedule goes from all signal to none", () => {
  const alphaBars = cosineSchedule(1000);
  assert.ok(alphaBars[0] > 0.9999 && alphaBars[999] < 1e-8 && alphaBars[999] > 0);
  assert.ok(alphaBars.every((value, t) => t === 0 || value < alphaBars[t - 1]));
});

test("time steps go down from the last, no two alike", () => {
  assert.deepEqual(timesteps(1000, 5), [999, 799, 599, 399, 199]);
  assert.deepEqual(timesteps(4, 4, 3), [3, 2, 1, 0]);
  assert.throws(() => timesteps(10, 11), { name: "Refusal" });
});

test("a network that knows the clean image leads every sampler to it", async () => {
  const alphaBars = cosineSchedule(1000);
  const clean = Float32Array.of(-1, 1, 0.25, -0.5);
  for (const sampler of ["ddim", "dpm-solver++"] as const) {
    for (const eta of [0, 1]) {
      const normal = normals(1, 2);
      const noise = () => new Float32Array(clean.length).map(normal);
      const predict = (x: Float32Array, t: number) =>
        x.map((value, i) => (Math.sqrt(alphaBars[t]) * value - clean[i]) / Math.sqrt(1 - alphaBars[t])); // the velocity
      let last: Float32Array = new Float32Array();
      for await (const x of denoise(predict, alphaBars, noise, "v", { sampler, steps: 8, eta, guidance: 1 })) last = x;
      assert.ok(
        last.every((value, i) => Math.abs(value - clean[i]) < 1e-4),
        `${sampler}, eta ${eta}`,
      );
    }
  }
});

test("noise is standard normal, and another for each structure and seed", () => {
  const normal = normals(0, 0);
  const values = Array.from({ length: 20_000 }, normal);
  const mean = values.reduce((a, b) => a + b, 0) / values.length;
  const variance = values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / values.length;
  assert.ok(Math.abs(mean) < 0.03 && Math.abs(variance - 1) < 0.04);
  const firsts = [normals(0, 0)(), normals(0, 1)(), normals(1, 0)()];
  assert.equal(new Set(firsts).size, 3);
  assert.equal(normals(0, 0)(), firsts[0]);
});

test("16-bit floats are read as they are", () => {
  assert.deepEqual(Array.from(fromHalf(Uint16Array.of(0x3c00, 0xc000, 0x3555, 1, 0x8000))), [
    1,
    -2,
    0.333251953125,
    2 ** -24,
    -0,
  ]);
});

test("a calibrated model is told what its answer is inverted from", () => {
  // g(z) = b(o + S z), with b(x) = 2 x above 0 and x below it.
  const calibration = {
    mean: [1],
    directions: [[1]],
    offset: [0.1],
    slope: [[0.5]],
    bends: [
      [
        [-1, 0, 1],
        [-1, 0, 2],
      ],
    ] as [number[], number[]][],
  };
  const [high] = told(calibration, [1.4]); // b⁻¹(0.4) = 0.2, so z = (0.2 − 0.1) / 0.5
  const [low] = told(calibration, [0.7]); // b⁻¹(−0.3) = −0.3, so z = −0.8
  assert.ok(Math.abs(high - 1.2) < 1e-12 && Math.abs(low - 0.2) < 1e-12);
});

test("targets out of reach, or at odds with one another, are refused with what can be reached", () => {
  const table = new Map([
    ["height", [Float64Array.of(0.8, 1, 1.2)]],
    ["width", [Float64Array.of(0.7, 0.9, 0.8)]],
    ["area", [Float64Array.of(0.5, 0.8, 0.9)]],
    ["outline", Array.from({ length: 32 }, () => Float64Array.of(0.4, 0.5, 0.6))],
  ]);
  checkReach({ height: 1.05 }, table);
  const refused = (targets: object, message: RegExp) =>
    assert.throws(() => checkReach(targets, table), { name: "Refusal", message });
  refused({ height: 3 }, /^height 3 is out of reach\. The 3 .* reach height 0\.800 to 1\.200; .* is height 1\.200\.$/);
  refused(
    { height: 1, width: 0.8, area: 0.85 },
    /area 0\.85 contradicts height 1 and width 0\.8, with which it is at most 0\.8/,
  );
  checkReach({ outline: new Array(32).fill(0.5) }, table);
  refused(
    { outline: new Array(32).fill(0.79) },
    /^the outline cannot be reached: .* misses by 12%\. .* height 0\.800 to 1\.200, width/,
  );
  refused({ height: 1.1, outline: new Array(32).fill(0.5) }, /height 1\.1 contradicts the outline, with which it is 1/);
  refused({ height: 0.8, width: 0.9 }, /cannot be reached together: the closest of all structures misses by/);
});

test("what is no target is refused", () => {
  const refused = (targets: object, message: RegExp) =>
    assert.throws(() => checkTargets(targets), { name: "Refusal", message });
  refused({}, /nothing is asked for/);
  refused({ height: -1 }, /height must be a positive number/);
  refused({ height: Number.NaN }, /height/);
  refused({ axis: [[0, 0]] }, /axis must be 30 points/);
  refused({ outline: [1, 2, 3] }, /outline must be the corners of a polygon, or 32 numbers/);
  refused({ heigth: 1 }, /the model takes height, .*, not 'heigth'/);
});

test("targets are put in the order in which the model takes them, corners become a support function", () => {
  const { outline, ...others } = checkTargets({
    outline: [
      [2, 1],
      [3, 1],
      [3, 2],
      [2, 2],
    ],
    width: 1,
    height: 1,
  });
  assert.deepEqual(Object.keys(others), ["height", "width"]);
  const supports = outline as number[];
  assert.deepEqual(
    [0, 8, 16, 24].map((k) => supports[k]),
    [0.5, 1, 0.5, 0],
  );
});
