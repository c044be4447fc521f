/** What the schemas of an action say about how its goals are shown, read once for each action. */

import { imagesOf, textPathOf } from "./feedback_parts.js";
import { placesOf } from "./places.js";
import { chartsOf, progressFieldsOf } from "./schema.js";

const PARTS = ["goal", "feedback", "result"];
const NOTHING = { text: null, charts: [], progress: {}, ...inParts(() => []) };

const shapes = new WeakMap();

/** Return the shape of an action by its description; one of nothing if it is not known yet. */
export function shapeOf(info) {
  if (!info) {
    return NOTHING;
  }
  if (!shapes.has(info)) {
    shapes.set(info, read(info));
  }
  return shapes.get(info);
}

function read({ goal, feedback, result }) {
  const schemas = { goal, feedback, result };
  return {
    text: textPathOf(feedback),
    charts: chartsOf(feedback),
    progress: progressFieldsOf(feedback),
    ...inParts((part, find) => find(schemas[part])),
  };
}

/** Return what is found in each part of an action: its images, and its places. */
function inParts(of) {
  const all = (find) => Object.fromEntries(PARTS.map((part) => [part, of(part, find)]));
  return { images: all(imagesOf), places: all(placesOf) };
}
