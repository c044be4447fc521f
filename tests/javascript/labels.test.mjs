// Labels on a map, and lists for people.

import assert from "node:assert/strict";
import test from "node:test";
import { listed } from "./goal_text.js";
import { placeOfLabel } from "./plane.js";

const pen = { measureText: (text) => ({ width: 10 * text.length }) };
const area = { size: [400, 300] };

test("labels of robots at one place are below each other", () => {
  const labels = [];
  const places = ["arm1", "arm2", "arm3"].map((label) => placeOfLabel(pen, label, [100, 50], area, labels));
  assert.deepEqual(places.map(([left]) => left), [109, 109, 109]);
  assert.deepEqual(places.map(([, top]) => top), [43, 56, 69]);
  assert.deepEqual(placeOfLabel(pen, "far", [200, 50], area, labels), [209, 43]);
});

test("a label at the right edge is left of its robot", () => {
  const [left] = placeOfLabel(pen, "a long name", [400, 50], area, []);
  assert.equal(left, 400 - 9 - 110);
});

test("a long list is cut", () => {
  assert.equal(listed(["a", "b"]), "a, b");
  assert.equal(listed([..."abcdefgh"]), "a, b, c, d, e, f and 2 more");
});
