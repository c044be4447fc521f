/** The places of a goal from above: where it is to go, where it was, and the paths, to scale. */

import { cleared, drawThrough, labelled, shortNumber, ticksOf } from "./chart.js";
import { announce, arrange, button, h, setText, show } from "./dom.js";
import { valueAt } from "./feedback_parts.js";
import { counted } from "./goal_text.js";
import { PlaneZoom, listenToPlane } from "./plane_zoom.js";

const HEIGHT = 280;
const LARGE = 520;
const MARGIN = { left: 58, right: 14, top: 12, bottom: 24 };
const [LABEL_GAP, LABEL_HEIGHT] = [9, 13]; // pixels
const PARTS = ["feedback", "goal", "result"];
const LEAST = { plane: 1, map: 2e-4 }; // what is shown of the axes at least
const METERS = 111_320; // of one degree of latitude
const ARROW = 15;

/** One place in the plane, as it is now. */
export class Layer {
  constructor(part, place, index) {
    this.index = index;
    this.part = part;
    this.place = place;
    this.name = [part === "feedback" ? "" : part, place.name].filter(Boolean).join(" ") || "position";
    this.color = `--line-${index % 6}`;
    this.value = h("b");
    this.key = h("span", { class: `key line-${index % 6}` }, `${this.name} `, this.value);
  }

  /** Take the points of a goal, and those of its trail. */
  take(record) {
    const { place } = this;
    const trail = this.part === "feedback" ? record.trails.find((one) => one.place === place) : null;
    const message = record[this.part];
    this.frame = (place.frame && valueAt(message, place.frame)) || "";
    const latest = trail?.latest;
    this.points = trail ? [...trail.points, ...(latest ? [latest] : [])] : place.pointsOf(message);
  }

  /** Tell what is drawn, or that it is not since it is in another frame. */
  tell(frame) {
    const { points, place } = this;
    show(this.key, points.length > 0);
    this.isDrawn = !this.frame || this.frame === frame;
    const [x, y, heading] = points[points.length - 1] ?? [];
    const turned = heading === undefined ? "" : `, ${Math.round((heading * 180) / Math.PI)}°`;
    const at = place.axes === "map" ? `${y?.toFixed(6)}, ${x?.toFixed(6)}` : `${shortNumber(x)}, ${shortNumber(y)}`;
    const told = place.isPath ? counted(points.length, "point") : at + turned;
    setText(this.value, this.isDrawn ? told : `${told}, not drawn: in the frame ${this.frame}`);
  }
}

/** The layers of the same axes and unit, perhaps with a ground below them. */
export class Plane {
  constructor(axes, unit, { ground = null, isLarge = false } = {}) {
    Object.assign(this, { ground, isLarge, height: isLarge ? LARGE : HEIGHT });
    this.axes = axes;
    this.layers = [];
    this.drawn = [];
    const title = axes === "map" ? "Map" : "From above";
    this.title = unit ? `${title} (${unit})` : title;
    this.canvas = h("canvas", { role: "img", tabindex: 0, "aria-keyshortcuts": "+ - ArrowLeft ArrowRight ArrowUp ArrowDown 0" });
    this.zoom = new PlaneZoom();
    this.area = null;
    listenToPlane(this.canvas, this.zoom, { area: () => this.area, onzoom: () => this.tellZoom() });
    const press = (key) => () => this.area && this.zoom.press(key, this.area) && this.tellZoom();
    const named = (text, key, name) => button(text, press(key), { "aria-label": `${name}: ${this.title}` });
    this.whole = button("Show all", () => this.showWhole(), { hidden: true });
    const zooms = h("div", { class: "zooms" }, this.whole, named("−", "-", "Zoom out"), named("+", "+", "Zoom in"));
    this.frame = h("span", {});
    this.keys = h("span", { class: "keys-of-plane" });
    const caption = h("figcaption", {}, h("strong", {}, this.title), this.frame, this.keys, zooms);
    this.element = h("figure", { class: `chart plane ${isLarge ? "large" : ""}`, hidden: true }, caption, this.canvas);
  }

  /** Draw the part of the zoom, and tell it to a screen reader. */
  tellZoom() {
    this.draw();
    const { low, high } = this.area;
    const part = [0, 1].map((axis) => `${shortNumber(low[axis])} to ${shortNumber(high[axis])}`).join(", ");
    announce(`${this.title}: ${this.zoom.part ? part : "all"}`);
  }

  showWhole() {
    this.zoom.reset();
    this.canvas.focus();
    this.tellZoom();
  }

  update(record) {
    this.layers.forEach((layer) => layer.take(record));
    const frame = this.layers.find((layer) => layer.frame)?.frame ?? "";
    this.layers.forEach((layer) => layer.tell(frame));
    setText(this.frame, frame ? `frame ${frame}` : "");
    if (!this.isLarge) {
      arrange(this.keys, this.layers.map((layer) => layer.key));
    }
    const drawn = this.layers.filter((layer) => layer.isDrawn && layer.points.length);
    show(this.element, drawn.reduce((sum, layer) => sum + layer.points.length, 0) > (this.isLarge ? 0 : 1));
    const names = drawn.map((layer) => `${layer.name} ${layer.value.textContent}`).join("; ");
    this.canvas.setAttribute("aria-label", `${this.title}: ${names}`);
    this.drawn = drawn;
    this.draw();
  }

  draw() {
    const layers = this.drawn;
    const width = this.canvas.clientWidth;
    if (!width || this.element.hidden) {
      return;
    }
    const [pen, style] = cleared(this.canvas, this.height);
    const points = [...layers.flatMap((layer) => layer.points), ...(this.ground?.corners ?? [])];
    const area = areaOf(points, width, this.axes, this.zoom, this.height);
    const newest = layers[0]?.points.slice(-1)[0]; // such as where a robot is
    const isShown = newest && [0, 1].every((axis) => area.low[axis] <= newest[axis] && newest[axis] <= area.high[axis]);
    this.area = { ...area, focus: isShown ? newest.slice(0, 2) : null };
    show(this.whole, Boolean(this.zoom.part));
    this.element.classList.toggle("zoomed", Boolean(this.zoom.part));
    this.clip(pen, area, () => this.ground?.draw(pen, area));
    drawGrid(pen, area, width);
    if (this.axes === "map") {
      drawScale(pen, area, style, width);
    }
    const labels = [];
    this.clip(pen, area, () => layers.forEach((layer) => drawLayer(pen, layer, area, style, labels)));
  }

  /** Draw within the axes. */
  clip(pen, area, draw) {
    pen.save();
    pen.beginPath();
    pen.rect(MARGIN.left, MARGIN.top, ...area.size);
    pen.clip();
    draw();
    pen.restore();
  }
}

/** All planes of one goal. */
export class Planes {
  /** Make planes for the places of its goal, feedback and result. */
  constructor(places) {
    const planes = new Map();
    let index = 0;
    for (const part of PARTS) {
      for (const place of places[part]) {
        const key = `${place.axes} ${place.unit}`;
        const plane = planes.get(key) ?? new Plane(place.axes, place.unit);
        plane.layers.push(new Layer(part, place, index));
        planes.set(key, plane);
        index += 1;
      }
    }
    this.planes = [...planes.values()];
    this.element = h("div", { class: "charts" }, ...this.planes.map((plane) => plane.element));
  }

  update(record) {
    this.planes.forEach((plane) => plane.update(record));
  }
}

/**
 * Return the scales, which are the same in both directions: all points are inside, unless a zoom
 * shows a part. A degree of longitude is shorter than one of latitude.
 */
export function areaOf(points, width, axes, zoom = new PlaneZoom(), height = HEIGHT) {
  const bounds = [0, 1].map((axis) => [
    points.reduce((least, point) => Math.min(least, point[axis]), Infinity),
    points.reduce((most, point) => Math.max(most, point[axis]), -Infinity),
  ]);
  const center = bounds.map(([low, high]) => (low + high) / 2);
  const squeeze = axes === "map" ? Math.max(Math.cos((center[1] * Math.PI) / 180), 0.01) : 1;
  const room = [width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom];
  const [sizeX, sizeY] = bounds.map(([low, high]) => high - low);
  const most = 0.9 * Math.min(room[0] / Math.max(sizeX * squeeze, LEAST[axes]), room[1] / Math.max(sizeY, LEAST[axes]));
  const whole = { middle: center, scaleY: most, low: bounds.map(([low]) => low), high: bounds.map(([, high]) => high) };
  const { middle, scaleY } = zoom.of(whole);
  const scaleX = scaleY * squeeze;
  const [left, top] = [MARGIN.left + room[0] / 2, MARGIN.top + room[1] / 2];
  const at = (x, y) => [left + (x - middle[0]) * scaleX, top - (y - middle[1]) * scaleY];
  const pointAt = (x, y) => [middle[0] + (x - left) / scaleX, middle[1] - (y - top) / scaleY];
  const halves = [room[0] / scaleX / 2, room[1] / scaleY / 2];
  const [low, high] = [-1, 1].map((side) => middle.map((one, axis) => one + side * halves[axis]));
  return { at, pointAt, scaleX, scaleY, middle, whole, height, size: room, low, high };
}

function drawGrid(pen, area, width) {
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (const [tick, text] of labelled(ticksOf(area.low[1], area.high[1]))) {
    const [, y] = area.at(0, tick);
    drawThrough(pen, [MARGIN.left, y], [width - MARGIN.right, y]);
    pen.fillText(text, MARGIN.left - 6, y);
  }
  pen.textAlign = "center";
  pen.textBaseline = "alphabetic";
  for (const [tick, text] of labelled(ticksOf(area.low[0], area.high[0], Math.max(2, width / 110)))) {
    const [x] = area.at(tick, 0);
    drawThrough(pen, [x, MARGIN.top], [x, area.height - MARGIN.bottom]);
    pen.fillText(text, Math.min(x, width - 20), area.height - 8);
  }
}

/** Draw a bar that is a round number of meters long. */
function drawScale(pen, { scaleY }, style, width) {
  const perMeter = scaleY / METERS;
  const power = 10 ** Math.floor(Math.log10(width / 4 / perMeter));
  const meters = power * [5, 2, 1].find((factor) => factor * power * perMeter <= width / 4);
  const [right, y] = [width - MARGIN.right - 8, MARGIN.top + 14];
  pen.fillStyle = style.getPropertyValue("--text");
  pen.fillRect(right - meters * perMeter, y, meters * perMeter, 2);
  pen.textAlign = "right";
  pen.fillText(meters >= 1000 ? `${meters / 1000} km` : `${shortNumber(meters)} m`, right, y - 4);
}

/**
 * Return a place for a label: right of a point, or left of it at the edge, and below the labels that
 * were drawn there before.
 */
export function placeOfLabel(pen, label, [x, y], { size }, labels) {
  const { width } = pen.measureText(label);
  const left = x + LABEL_GAP + width > MARGIN.left + size[0] ? x - LABEL_GAP - width : x + LABEL_GAP;
  let top = y - 7;
  const isFree = () => labels.every((one) => Math.abs(one.top - top) >= LABEL_HEIGHT || left >= one.left + one.width || one.left >= left + width);
  while (!isFree()) {
    top += LABEL_HEIGHT;
  }
  labels.push({ left, top, width });
  return [left, top];
}

function drawLayer(pen, { points, place, part, label, color }, area, style, labels) {
  const { at } = area;
  pen.strokeStyle = pen.fillStyle = style.getPropertyValue(color);
  pen.lineWidth = 1.8;
  pen.lineJoin = "round";
  pen.setLineDash(part === "goal" ? [6, 4] : []);
  drawThrough(pen, ...points.map(([x, y]) => at(x, y)));
  pen.setLineDash([]);
  const marked = place.isPath && points.length <= 50 ? points : points.slice(-1);
  for (const [x, y, heading] of marked) {
    drawMarker(pen, at(x, y), place.isPath ? undefined : heading, part === "goal");
  }
  if (label) {
    pen.fillStyle = style.getPropertyValue("--text");
    pen.textAlign = "left";
    pen.fillText(label, ...placeOfLabel(pen, label, at(...points[points.length - 1]), area, labels));
  }
}

/** Draw a place: filled where it is, a ring where it is to be; with an arrow if it has a heading. */
function drawMarker(pen, [x, y], heading, isRing) {
  pen.beginPath();
  pen.arc(x, y, isRing ? 6 : 4.5, 0, 2 * Math.PI);
  if (isRing) {
    pen.stroke();
  } else {
    pen.fill();
  }
  if (heading !== undefined) {
    drawThrough(pen, [x, y], [x + ARROW * Math.cos(heading), y - ARROW * Math.sin(heading)]);
  }
}
