// Positions, poses and paths in the console, found by the schema.

import assert from "node:assert/strict";
import test from "node:test";
import { GoalRecord } from "./goal_record.js";
import { Trail, placesOf } from "./places.js";
import { areaOf } from "./plane.js";

const NUMBER = { type: "number" };
const object = (properties, more = {}) => ({ type: "object", properties, ...more });
const numbers = (...names) => object(Object.fromEntries(names.map((name) => [name, NUMBER])));
const POINT = numbers("x", "y");
const HEADER = object({ frame_id: { type: "string" } });
const POSE = object({ position: numbers("x", "y", "z"), orientation: numbers("x", "y", "z", "w") });
const STAMPED = object({ header: HEADER, pose: POSE });
const turned = (degrees) => ({ x: 0, y: 0, z: Math.sin((degrees * Math.PI) / 360), w: Math.cos((degrees * Math.PI) / 360) });

/** Return the names of the places of a schema, with what they are. */
function found(schema) {
  return placesOf(schema).map(({ name, axes, isPath }) => `${name} ${axes}${isPath ? " path" : ""}`);
}

test("positions are found at any depth, with their unit", () => {
  assert.deepEqual(found(POINT), [" plane"]);
  assert.deepEqual(found(object({ robot: object({ at: POINT }), goal: { anyOf: [POINT, { type: "null" }] } })),
    ["robot.at plane", "goal plane"]);
  const reference = { $ref: "#/$defs/A", $defs: { A: object({ at: { $ref: "#/$defs/P" } }), P: POINT } };
  assert.deepEqual(found(reference), ["at plane"]);
  const meters = { type: "number", "x-unit": "m" };
  assert.equal(placesOf(object({ x: meters, y: meters }))[0].unit, "m");
});

test("what has x and y and is not a place is not found", () => {
  for (const schema of [{}, true, NUMBER, numbers("x"), numbers("x", "y", "z", "w"), numbers("x", "y", "width", "height"),
    { ...numbers("x", "y", "z"), title: "Vector3" }, object({ linear: POINT }, { title: "Twist" }),
    object({ x: { type: "string" }, y: NUMBER }), { type: "array", items: NUMBER }]) {
    assert.deepEqual(found(schema), [], JSON.stringify(schema));
  }
});

test("a tree ends, and so does a list of places", () => {
  assert.deepEqual(found({ $ref: "#/$defs/T", $defs: { T: object({ inner: { $ref: "#/$defs/T" } }) } }), []);
  const many = Object.fromEntries(Array.from({ length: 30 }, (_, index) => [`p${index}`, POINT]));
  assert.equal(found(object(many)).length, 8);
});

test("a pose has a heading, unless its orientation is not set", () => {
  const [place] = placesOf(object({ current_pose: STAMPED }));
  assert.deepEqual([place.name, place.frame], ["current_pose.pose", ["current_pose", "header", "frame_id"]]);
  const at = (orientation) => place.pointsOf({ current_pose: { pose: { position: { x: 1, y: 2n, z: 3 }, orientation } } });
  const [[x, y, heading]] = at(turned(90));
  assert.deepEqual([x, y, Math.round((heading * 180) / Math.PI)], [1, 2, 90]);
  assert.deepEqual(at({ x: 0, y: 0, z: 0, w: 0 }), [[1, 2]]);
  assert.deepEqual(at(undefined), [[1, 2]]);
});

test("a heading by name is in radians, or in the degrees that its unit tells", () => {
  const read = (schema, value) => placesOf(schema)[0].pointsOf(value)[0];
  assert.deepEqual(read(numbers("x", "y", "theta"), { x: 1, y: 2, theta: 3 }), [1, 2, 3]);
  const degrees = object({ x: NUMBER, y: NUMBER, yaw: { type: "number", "x-unit": "deg" } });
  assert.deepEqual(read(degrees, { x: 1, y: 2, yaw: 180 }), [1, 2, Math.PI]);
});

test("latitude and longitude are on a map", () => {
  const [place] = placesOf(object({ fix: numbers("latitude", "longitude", "altitude") }));
  assert.equal(place.axes, "map");
  assert.deepEqual(place.pointsOf({ fix: { latitude: 48.1, longitude: 11.5 } }), [[11.5, 48.1]]);
  assert.deepEqual(found({ type: "array", items: numbers("lat", "lon") }), [" map path"]);
});

test("a list of points or poses is a path", () => {
  const path = object({ plan: object({ header: HEADER, poses: { type: "array", items: STAMPED } }), stops: { type: "array", items: POINT } });
  assert.deepEqual(found(path), ["plan.poses plane path", "stops plane path"]);
  const [plan, stops] = placesOf(path);
  const value = { plan: { poses: [{ pose: { position: { x: 1, y: 2 }, orientation: turned(0) } }, null, { pose: null }] }, stops: [{ x: 0, y: "1" }, { x: "a", y: 1 }] };
  assert.deepEqual(plan.pointsOf(value), [[1, 2, 0]]);
  assert.deepEqual(stops.pointsOf(value), [[0, 1]]);
});

test("a value that is not as its schema says has no point", () => {
  const [place] = placesOf(object({ pose: POSE }));
  for (const value of [undefined, null, 7, {}, { pose: null }, { pose: { position: 3 } }, { pose: { position: { x: NaN, y: 1 } } }]) {
    assert.deepEqual(place.pointsOf(value), [], JSON.stringify(value));
  }
  assert.deepEqual(placesOf({ type: "array", items: POINT })[0].pointsOf({ x: 1 }), []);
});

test("a trail has the way in bounded memory, and not where nothing moves", () => {
  const trail = new Trail(placesOf(POINT)[0]);
  for (const x of [1, 1, 1, 2]) trail.add({ x, y: 0 });
  trail.add({ x: "?", y: 0 });
  assert.deepEqual(trail.points, [[1, 0], [2, 0]]);
  for (let x = 3; x <= 50_000; x += 1) trail.add({ x, y: 0 });
  assert.ok(trail.points.length <= 2000);
  const gaps = trail.points.slice(1).map(([x], index) => x - trail.points[index][0]);
  assert.ok(Math.max(...gaps) <= 2 * Math.min(...gaps));
  assert.deepEqual([trail.points[0], trail.latest], [[1, 0], [50_000, 0]]);
  const kept = trail.kept(100);
  assert.ok(kept.length <= 102);
  assert.deepEqual([kept[0], kept[kept.length - 1]], [[1, 0], [50_000, 0]]);
});

test("the history keeps trails and charts, also before the schema is known", () => {
  const info = { name: "a", goal: {}, feedback: object({ at: POINT }), result: {} };
  const record = new GoalRecord("a", "01", info);
  [1, 2, 3].forEach((x) => record.addFeedback({ at: { x, y: x * x } }, x, 1));
  const unknown = GoalRecord.of(record.kept(), undefined);
  assert.deepEqual(unknown.trails, []);
  const again = GoalRecord.of(unknown.kept(), info);
  assert.deepEqual(again.trails[0].points, [[1, 1], [2, 4], [3, 9], [3, 9]]);
  assert.deepEqual(again.trails[0].latest, [3, 9]);
  assert.deepEqual(again.series.charts[1].lines[0].values, [1, 4, 9]);
});

test("all points are inside of the view, which has one scale for both directions", () => {
  const points = [[-3, 1], [40, 2], [10, -7]];
  const { at, scaleX, scaleY, low, high } = areaOf(points, 500, "plane");
  assert.equal(scaleX, scaleY);
  for (const [x, y] of points) {
    const [left, top] = at(x, y);
    assert.ok(left > 58 && left < 486 && top > 12 && top < 256);
    assert.ok(low[0] < x && x < high[0] && low[1] < y && y < high[1]);
  }
  assert.ok(at(0, 5)[1] < at(0, 1)[1]); // up is up
  assert.ok(Number.isFinite(areaOf([[1, 1]], 500, "plane").scaleX));
});

test("a degree of longitude is as long as it is at that latitude", () => {
  const { scaleX, scaleY } = areaOf([[10, 60], [11, 60]], 500, "map");
  assert.ok(Math.abs(scaleX / scaleY - 0.5) < 1e-9);
});
