/** What is saved is what is opened again, and what is malformed is refused with a sentence. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { DEFAULTS, fromFragment, fromJson, type State, toFragment, toJson } from "../src/share.ts";

const image = Float64Array.from({ length: 784 }, (_, k) => Number((k * 7919) % 5 === 0));
const states: State[] = [
  { image, settings: { ...DEFAULTS }, targets: {} },
  {
    image: new Float64Array(784),
    settings: { pressure: 0.0005, lambda: 1.07, mu: 0.05, wall: 3, clamped: "left", element: "q1" },
    targets: {
      height: 1.05,
      stress: 0.1973,
      axis: Array.from({ length: 30 }, (_, k) => [k ? -k / 80 : 0, (1.07 * k) / 30]),
      outline: Array.from({ length: 32 }, (_, k) => Number((0.5 + 0.25 * Math.sin((Math.PI * k) / 16)).toFixed(4))),
    },
  },
];

for (const state of states) {
  test(`a state with ${Object.keys(state.targets).length} targets goes through a link and a file`, () => {
    assert.deepEqual(fromFragment(toFragment(state)), state);
    assert.deepEqual(fromJson(toJson(state)), state);
    assert.match(toFragment(state), /^#[\w=&.~*-]+$/); // survives being pasted anywhere
  });
}

test("an address without a structure says nothing", () => {
  assert.equal(fromFragment("#how-it-works"), null);
});

test("a malformed link is refused", () => {
  const [good] = states.map(toFragment);
  for (const [link, message] of [
    ["#lab=abc", /no drawing/],
    ["#lab=%%%", /no drawing/],
    [`${good}&pressure=1`, /pressure must be from 0 to 0.03, not 1/],
    [`${good}&pressure=`, /pressure/],
    [`${good}&wall=1.5`, /wall/],
    [`${good}&clamped=middle`, /clamped is "middle"/],
    [`${good}&constructor=1`, /constructor/],
    [`${good}&height=tall`, /height must be a positive number/],
    [`${good}&axis=1_0_0.1`, /axis must be 30 points/],
    [`${good}&axis=${new Array(31).fill(0).join("_")}`, /axis must be 30 points/],
    [`${good}&outline=1_2`, /outline must be/],
  ] as const) {
    assert.throws(() => fromFragment(link), { name: "Refusal", message });
    assert.throws(() => fromFragment(link), /^Refusal: the link is malformed/);
  }
});

test("a malformed file is refused", () => {
  const good = JSON.parse(toJson(states[1]));
  for (const [changes, message] of [
    [{ format: "other" }, /none of the laboratory's/],
    [{ image: ["01"] }, /28 rows of 28 digits/],
    [{ image: null }, /28 rows of 28 digits/],
    [{ settings: [] }, /settings is no object/],
    [{ settings: { pressure: null } }, /pressure must be from/],
    [{ settings: { pressure: true } }, /pressure must be from/],
    [{ targets: "height" }, /targets is no object/],
    [{ targets: { height: "1" } }, /height must be a positive number/],
    [{ targets: { axis: ["ab"] } }, /axis must be 30 points/],
    [{ targets: { beauty: 1 } }, /not 'beauty'/],
  ] as const) {
    assert.throws(() => fromJson(JSON.stringify({ ...good, ...changes })), { name: "Refusal", message });
  }
  for (const text of ["", "{", "null", "7", "[]"]) assert.throws(() => fromJson(text), { name: "Refusal" });
});
