// The part of a view from above that is shown, without a browser.

import assert from "node:assert/strict";
import test from "node:test";
import { areaOf } from "./plane.js";
import { PlaneZoom } from "./plane_zoom.js";

const POINTS = [[0, 0], [10, 4]];

function area(zoom, axes = "plane") {
  return areaOf(POINTS, 500, axes, zoom);
}

function isNear(found, wanted) {
  assert.ok(Math.hypot(found[0] - wanted[0], found[1] - wanted[1]) < 1e-6, `${found} is not ${wanted}`);
}

test("pixels and points are each other's inverse, on a map as well", () => {
  for (const axes of ["plane", "map"]) {
    const { at, pointAt } = area(undefined, axes);
    isNear(pointAt(...at(3, 1)), [3, 1]);
  }
});

test("a zoom keeps the point at the pointer, and its own middle without one", () => {
  const zoom = new PlaneZoom();
  const before = area(zoom);
  const pixel = before.at(2, 3);
  zoom.by(2, before, pixel);
  isNear(area(zoom).at(2, 3), pixel);
  assert.equal(area(zoom).scaleY, 2 * before.scaleY);
  const { middle } = area(zoom);
  zoom.by(2, area(zoom));
  isNear(area(zoom).middle, middle);
});

test("without a pointer a zoom keeps what is in the focus", () => {
  const zoom = new PlaneZoom();
  const before = area(zoom).at(10, 4);
  zoom.by(2, { ...area(zoom), focus: [10, 4] });
  isNear(area(zoom).at(10, 4), before);
});

test("zooming out ends with the whole, and zooming in at a thousandth", () => {
  const zoom = new PlaneZoom();
  const whole = area(zoom).scaleY;
  zoom.by(0.5, area(zoom));
  assert.equal(zoom.part, null);
  zoom.by(3, area(zoom));
  zoom.by(1 / 3, area(zoom));
  assert.equal(zoom.part, null);
  for (let times = 0; times < 100; times += 1) zoom.by(2, area(zoom));
  assert.equal(area(zoom).scaleY, 1000 * whole);
});

test("what is shown moves by pixels, and its middle stays where there is something", () => {
  const zoom = new PlaneZoom();
  zoom.move(50, 0, area(zoom));
  assert.equal(zoom.part, null);
  zoom.by(4, area(zoom));
  const before = area(zoom).at(5, 2);
  zoom.move(10, -20, area(zoom));
  isNear(area(zoom).at(5, 2), [before[0] - 10, before[1] + 20]);
  zoom.move(1e6, 1e6, area(zoom));
  isNear(area(zoom).middle, [10, 0]);
});

test("keys zoom, move and reset, and others mean nothing", () => {
  const zoom = new PlaneZoom();
  assert.equal(zoom.press("ArrowUp", area(zoom)), false);
  assert.equal(zoom.press("Escape", area(zoom)), false);
  assert.equal(zoom.press("x", area(zoom)), false);
  assert.ok(zoom.press("+", area(zoom)) && zoom.press("=", area(zoom)));
  const { middle } = area(zoom);
  assert.ok(zoom.press("ArrowUp", area(zoom)) && area(zoom).middle[1] > middle[1]);
  assert.ok(zoom.press("ArrowRight", area(zoom)) && area(zoom).middle[0] > middle[0]);
  assert.ok(zoom.press("-", area(zoom)) && zoom.part);
  assert.ok(zoom.press("0", area(zoom)) && !zoom.part);
});

test("the part stays when a robot drives out of the whole", () => {
  const zoom = new PlaneZoom();
  zoom.by(4, area(zoom));
  const { low, high } = area(zoom);
  const later = areaOf([...POINTS, [100, 100]], 500, "plane", zoom);
  isNear(later.low, low);
  isNear(later.high, high);
});
