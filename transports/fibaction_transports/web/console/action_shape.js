/** What the schemas of an action say about how its goals are shown, read once for each action. */

import { imagesOf, textPathOf } from "./feedback_parts.js";
import { chartsOf, progressFieldsOf } from "./schema.js";

const PARTS = ["goal", "feedback", "result"];
const NOTHING = { text: null, charts: [], progress: {}, images: { goal: [], feedback: [], result: [] } };

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
    images: Object.fromEntries(PARTS.map((part) => [part, imagesOf(schemas[part])])),
  };
}
