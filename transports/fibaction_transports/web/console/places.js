/** Positions, poses and paths in goals, feedback and results, found by their schemas. */

import { valueAt } from "./feedback_parts.js";
import { kindOf, resolverOf, unitOf } from "./schema.js";
import { Thinner } from "./series.js";

const MOST_PLACES = 8;
const MOST_LEVELS = 8;
const LATITUDES = ["latitude", "lat"];
const LONGITUDES = ["longitude", "lon", "lng"];
const HEADINGS = ["theta", "yaw"];
const NOT_A_PLACE = ["w", "width", "height"]; // in a quaternion, and in a box of pixels
const DIRECTIONS = ["Vector3", "Vector3Stamped", "Twist", "Wrench", "Accel"]; // types of ROS
const QUATERNION = ["x", "y", "z", "w"];

/**
 * Return the places in values of a schema: their `name` and `path`; the `axes`, plane or map; the
 * `unit`; the path of their `frame`, as ROS has it, or null; and `pointsOf`, which reads them from
 * a value. One that `isPath` is a list of points. A point is x, y, and the heading if there is one.
 */
export function placesOf(root) {
  const resolve = resolverOf(root);
  const found = [];
  const visit = (given, path, frame) => {
    if (found.length === MOST_PLACES || path.length > MOST_LEVELS) {
      return;
    }
    const schema = bare(given, resolve);
    const fields = schema.properties ?? {};
    const hasFrame = fields.header && resolve(fields.header).properties?.frame_id;
    const within = hasFrame ? [...path, "header", "frame_id"] : frame;
    const point = pointOf(schema, resolve);
    if (point) {
      found.push(placeOf(point, path, within, false));
    } else if (kindOf(schema, resolve).kind === "array") {
      const inner = pointWithin(schema.items, resolve);
      if (inner) {
        found.push(placeOf(inner, path, within, true));
      }
    } else if (!DIRECTIONS.includes(schema.title)) {
      Object.entries(fields).forEach(([name, one]) => visit(one, [...path, name], within));
    }
  };
  visit(root, [], null);
  return found;
}

/** Return a schema without its null. */
function bare(given, resolve) {
  const schema = resolve(given);
  const { kind, inner } = kindOf(schema, resolve);
  return kind === "nullable" ? resolve(inner) : schema;
}

function placeOf({ axes, unit, read }, path, frame, isPath) {
  const points = isPath ? (list) => (Array.isArray(list) ? list : []).map(read) : (one) => [read(one)];
  const isWhole = (point) => point && point.slice(0, 2).every(Number.isFinite);
  const pointsOf = (value) => points(valueAt(value, path)).filter(isWhole);
  return { name: path.join("."), path, frame, axes, unit, isPath, pointsOf };
}

/** Return how to read a point in the values of a schema; null if they are not points. */
function pointOf(schema, resolve) {
  const fields = schema.properties ?? {};
  const isNumber = (name) => ["integer", "number"].includes(fields[name] && resolve(fields[name]).type);
  const [north, east] = [LATITUDES.find(isNumber), LONGITUDES.find(isNumber)];
  if (north && east) {
    return { axes: "map", unit: "", read: (value) => value && [Number(value[east]), Number(value[north])] };
  }
  const position = fields.position && pointOf(bare(fields.position, resolve), resolve);
  if (position && QUATERNION.every((name) => name in (bare(fields.orientation, resolve).properties ?? {}))) {
    return { ...position, read: (value) => value && withHeading(position.read(value.position), value.orientation) };
  }
  if (!isNumber("x") || !isNumber("y") || NOT_A_PLACE.some((name) => name in fields) || DIRECTIONS.includes(schema.title)) {
    return null;
  }
  const heading = HEADINGS.find(isNumber);
  const turn = ["°", "deg"].includes(heading && unitOf(resolve(fields[heading]))) ? Math.PI / 180 : 1;
  const read = (value) => value && [Number(value.x), Number(value.y), ...(heading ? [Number(value[heading]) * turn] : [])];
  return { axes: "plane", unit: unitOf(resolve(fields.x)), read };
}

/** Return how to read the point of an item, such as the pose of one with a header. */
function pointWithin(given, resolve) {
  const schema = bare(given, resolve);
  const own = pointOf(schema, resolve);
  if (own || !schema.properties?.pose) {
    return own;
  }
  const inner = pointOf(bare(schema.properties.pose, resolve), resolve);
  return inner && { ...inner, read: (value) => inner.read(value?.pose) };
}

function withHeading(point, turned) {
  const [x, y, z, w] = QUATERNION.map((name) => Number(turned?.[name]));
  const isTurned = x * x + y * y + z * z + w * w > 0.5; // one of zeros is not set
  return point && isTurned ? [point[0], point[1], Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))] : point;
}

/** The way of one place in the feedback. */
export class Trail {
  constructor(place) {
    this.place = place;
    this.points = [];
    this.latest = null;
    this.thinner = new Thinner();
  }

  add(feedback) {
    const [point] = this.place.pointsOf(feedback);
    if (!point || (this.latest && point.every((one, index) => one === this.latest[index]))) {
      return;
    }
    this.latest = point;
    [this.points] = this.thinner.add([this.points], [point]);
  }

  /** Return at most so many points, and the latest one. */
  kept(most) {
    const step = Math.ceil(this.points.length / most) || 1;
    const points = this.points.filter((_, index) => index % step === 0);
    return [...points, ...(this.latest ? [this.latest] : [])].map((point) => point.map((one) => Number(one.toPrecision(9))));
  }

  /** Take points that `kept` has returned. */
  restore(points) {
    this.points = points;
    this.latest = points[points.length - 1] ?? null;
  }
}
