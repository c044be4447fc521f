// The part of an axis that a chart shows, without a browser.

import assert from "node:assert/strict";
import test from "node:test";
import { labelled, ticksOf } from "./chart.js";
import { Zoom } from "./zoom.js";

const ALL = [0, 100];

/** Return a zoom after these changes. */
function zoomed(...changes) {
  const zoom = new Zoom();
  changes.forEach(([change, ...given]) => zoom[change](...given));
  return zoom;
}

test("at first the whole is shown, and again after a reset", () => {
  assert.deepEqual(zoomed().of(ALL), ALL);
  assert.deepEqual(zoomed(["select", 20, 40, ALL], ["reset"]).of(ALL), ALL);
});

test("a part is selected in both directions, and only as far as there is something", () => {
  assert.deepEqual(zoomed(["select", 20, 40, ALL]).of(ALL), [20, 40]);
  assert.deepEqual(zoomed(["select", 40, 20, ALL]).of(ALL), [20, 40]);
  assert.deepEqual(zoomed(["select", -30, 140, ALL]).of(ALL), ALL);
});

test("no part is smaller than a thousandth", () => {
  assert.deepEqual(zoomed(["select", 20, 20.05, ALL]).of(ALL), ALL);
  const zoom = zoomed();
  for (let times = 0; times < 100; times += 1) zoom.by(0.5, ALL);
  const [low, high] = zoom.of(ALL);
  assert.ok(high - low >= 0.1 && low < 50 && high > 50);
});

test("a zoom in and out keeps its center, and ends with the whole", () => {
  assert.deepEqual(zoomed(["by", 0.5, ALL]).of(ALL), [25, 75]);
  assert.deepEqual(zoomed(["by", 0.5, ALL, 10]).of(ALL), [5, 55]);
  assert.equal(zoomed(["by", 0.5, ALL], ["by", 2, ALL]).part, null);
  assert.equal(zoomed(["by", 2, ALL]).part, null);
  assert.equal(zoomed(["by", 1 / 1.5, [0.05, 0.6]], ["move", -1, [0.05, 0.6]], ["by", 1.5, [0.05, 0.6]]).part, null);
  assert.deepEqual(zoomed(["select", 0, 40, ALL], ["by", 1.5, ALL]).of(ALL), [0, 60]);
  assert.deepEqual(zoomed(["select", 60, 100, ALL], ["by", 1.5, ALL]).of(ALL), [40, 100]);
});

test("a part moves to the ends and no further, and the whole does not move", () => {
  assert.deepEqual(zoomed(["select", 20, 40, ALL], ["move", 0.25, ALL]).of(ALL), [25, 45]);
  assert.deepEqual(zoomed(["select", 20, 40, ALL], ["move", 9, ALL]).of(ALL), [80, 100]);
  assert.deepEqual(zoomed(["select", 20, 40, ALL], ["move", -9, ALL]).of(ALL), [0, 20]);
  assert.equal(zoomed(["move", 0.25, ALL]).part, null);
});

test("a part stays where it is while the axis grows, and one that is gone is the whole", () => {
  const zoom = zoomed(["select", 20, 40, ALL]);
  assert.deepEqual(zoom.of([0, 500]), [20, 40]);
  assert.deepEqual(zoom.of([0, 10]), [0, 10]);
});

test("ticks have as many digits as tell them apart", () => {
  const texts = (low, high) => labelled(ticksOf(low, high)).map(([, text]) => text);
  assert.deepEqual(texts(0, 40), ["0", "10", "20", "30", "40"]);
  assert.deepEqual(texts(1234.5, 1234.6), ["1234.50", "1234.55", "1234.60"]);
  assert.deepEqual(texts(0, 4e7)[1], "1.00e+7");
  assert.deepEqual(labelled([3]).map(([, text]) => text), ["3"]);
});
