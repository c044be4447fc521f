/** A chart of numbers on a canvas, with its legend as text. */

import { announce, button, h, setText, show } from "./dom.js";
import { Zoom, listen } from "./zoom.js";

const HEIGHT = 150;
const MARGIN = { left: 52, right: 10, top: 8, bottom: 22 };

/** Return round numbers between two others, some four of them. */
export function ticksOf(low, high, count = 4) {
  const rough = (high - low) / count || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const ticks = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high + step / 1e6; tick += step) {
    ticks.push(Math.abs(tick) < step / 1e6 ? 0 : tick);
  }
  return ticks;
}

/** Return a number as a person writes it. */
export function shortNumber(value) {
  if (value === null || value === undefined) {
    return "–";
  }
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e6 || size < 1e-3)) {
    return value.toExponential(2);
  }
  return String(Number(value.toPrecision(4)));
}

/** Return ticks, each with its text: with as many digits as tell them apart. */
export function labelled(ticks) {
  const step = ticks.length > 1 ? ticks[1] - ticks[0] : 0;
  const digits = Math.max(-Math.floor(Math.log10(step) + 1e-9), 0);
  const isPlain = step > 1e-9 && ticks.every((tick) => Math.abs(tick) < 1e6);
  return ticks.map((tick) => [tick, isPlain ? tick.toFixed(digits) : shortNumber(tick)]);
}

/** Clear a canvas. Return its pen, for pixels of the page and with the style of axes, and its style. */
export function cleared(canvas, height) {
  const scale = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * scale);
  if (canvas.width !== width) {
    [canvas.width, canvas.height] = [width, Math.round(height * scale)];
  }
  const [pen, style] = [canvas.getContext("2d"), getComputedStyle(canvas)];
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.clearRect(0, 0, canvas.clientWidth, height);
  pen.font = "11px system-ui, sans-serif";
  pen.fillStyle = style.getPropertyValue("--faint");
  pen.strokeStyle = style.getPropertyValue("--grid");
  pen.lineWidth = 1;
  return [pen, style];
}

/** Draw a line through points. */
export function drawThrough(pen, ...points) {
  pen.beginPath();
  points.forEach((point) => pen.lineTo(...point));
  pen.stroke();
}

/** The time at which a person looks; null if there is none. */
export class Cursor {
  constructor(onmove) {
    this.at = null;
    this.onmove = onmove;
  }

  move(at) {
    this.at = at;
    this.onmove();
  }
}

/** One chart of a goal. */
export class Chart {
  /** Draw a chart. All charts of a goal have one cursor, whose `at` is a time; `move` changes it. */
  constructor(chart, cursor) {
    this.chart = chart;
    this.cursor = chart.isCurve ? new Cursor(() => this.draw()) : cursor;
    this.canvas = h("canvas", { role: "img", tabindex: 0, "aria-label": `Chart of ${chart.title}`, "aria-keyshortcuts": "+ - ArrowLeft ArrowRight 0" });
    this.zoom = new Zoom();
    this.whole = button("Show all", () => this.showWhole(), { class: "quiet", hidden: true });
    this.values = chart.lines.map(() => h("b"));
    const names = chart.lines.map((line, index) =>
      h("span", { class: `key line-${index % 6}` }, `${shortName(line, chart)} `, this.values[index]),
    );
    const title = chart.unit ? `${chart.title} (${chart.unit})` : chart.title;
    this.element = h(
      "figure",
      { class: "chart" },
      h("figcaption", {}, h("strong", {}, title), " ", ...names, this.whole),
      this.canvas,
    );
    this.drag = this.area = null;
    listen(this.canvas, this.zoom, { axis: () => this.axis(), ondrag: (drag) => this.select(drag), onzoom: () => this.tellZoom() });
    this.canvas.addEventListener("pointermove", (event) => this.point(event.offsetX));
    this.canvas.addEventListener("pointerleave", () => this.point(null));
  }

  point(x) {
    this.cursor.move(x === null || !this.area ? null : this.axis().valueAt(x));
  }

  /** Return what a zoom needs to know of the axis of time; null if nothing is drawn. */
  axis() {
    const { area } = this;
    return area && { extent: area.extent, valueAt: (x) => area.low + (x - MARGIN.left) / area.scaleX };
  }

  select(drag) {
    this.drag = drag;
    this.draw();
  }

  /** Draw the part of the zoom, and tell it to a screen reader. */
  tellZoom() {
    const part = this.zoom.part?.map((value) => shortNumber(value) + this.unit).join(" to ");
    announce(`Chart of ${this.chart.title}: ${part ?? "all"}`);
    this.draw();
  }

  showWhole() {
    this.zoom.reset();
    this.canvas.focus();
    this.tellZoom();
  }

  /** The unit of the axis of time; a curve has indexes. */
  get unit() {
    return this.chart.isCurve ? "" : " s";
  }

  /** Draw what there is now. */
  draw() {
    const width = this.canvas.clientWidth;
    if (!width) {
      return;
    }
    const [pen, style] = cleared(this.canvas, HEIGHT);
    const area = areaOf(this.chart.lines, width, this.zoom);
    this.area = area;
    show(this.whole, Boolean(this.zoom.part));
    if (area) {
      drawAxes(pen, area, width, this.unit);
      pen.save();
      pen.beginPath();
      pen.rect(MARGIN.left - 2, 0, width - MARGIN.left - MARGIN.right + 4, HEIGHT - MARGIN.bottom + 3);
      pen.clip();
      this.chart.lines.forEach((line, index) => {
        drawLine(pen, line, area, style.getPropertyValue(`--line-${index % 6}`));
      });
      this.drawCursor(pen, area, style);
      this.drawDrag(pen, style);
      pen.restore();
    }
    this.tell(area);
  }

  drawCursor(pen, area, style) {
    if (this.cursor.at !== null) {
      const x = MARGIN.left + (this.cursor.at - area.low) * area.scaleX;
      pen.strokeStyle = style.getPropertyValue("--faint");
      pen.lineWidth = 1;
      drawThrough(pen, [x, 0], [x, HEIGHT]);
    }
  }

  drawDrag(pen, style) {
    if (this.drag) {
      const [from, to] = this.drag;
      pen.globalAlpha = 0.25;
      pen.fillStyle = style.getPropertyValue("--accent");
      pen.fillRect(from, 0, to - from, HEIGHT);
    }
  }

  /** Write the newest values into the legend, or those at the cursor. */
  tell(area) {
    this.chart.lines.forEach((line, index) => {
      let value = line.latest;
      if (this.cursor.at !== null && area) {
        const at = line.times.findIndex((one) => one >= this.cursor.at);
        value = line.values[at] ?? value;
      }
      setText(this.values[index], shortNumber(value));
    });
  }
}

function shortName(line, chart) {
  return line.name.startsWith(`${chart.title}.`) ? line.name.slice(chart.title.length + 1) : line.name;
}

/** Return the indexes of the points of a line between two times, with one more at each end. */
function visibleOf(times, low, high) {
  const [first, after] = [times.findIndex((time) => time >= low), times.findIndex((time) => time > high)];
  return [Math.max((first < 0 ? times.length : first) - 1, 0), after < 0 ? times.length : after + 1];
}

/** Return the scales of a chart; null if it is empty. */
function areaOf(lines, width, zoom) {
  const filled = lines.filter(({ times }) => times.length);
  const extent = [
    Math.min(...filled.map(({ times }) => times[0])),
    Math.max(...filled.map(({ times }) => times[times.length - 1])),
  ];
  let [low, high] = zoom.of(extent);
  let [bottom, top] = [Infinity, -Infinity];
  for (const { times, values } of filled) {
    const [first, end] = visibleOf(times, low, high);
    for (let index = first; index < end && index < values.length; index += 1) {
      bottom = values[index] < bottom ? values[index] : bottom;
      top = values[index] > top ? values[index] : top;
    }
  }
  if (!(high >= low && top >= bottom)) {
    return null;
  }
  const pad = (top - bottom) * 0.08 || Math.abs(top) * 0.1 || 1;
  [bottom, top] = [bottom - pad, top + pad];
  high = high === low ? low + 1 : high;
  const scaleX = (width - MARGIN.left - MARGIN.right) / (high - low);
  const scaleY = (HEIGHT - MARGIN.top - MARGIN.bottom) / (top - bottom);
  return { extent, low, high, bottom, top, scaleX, scaleY };
}

function drawAxes(pen, area, width, unit) {
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (const [tick, text] of labelled(ticksOf(area.bottom, area.top))) {
    const y = Math.round(HEIGHT - MARGIN.bottom - (tick - area.bottom) * area.scaleY) + 0.5;
    drawThrough(pen, [MARGIN.left, y], [width - MARGIN.right, y]);
    pen.fillText(text, MARGIN.left - 6, y);
  }
  pen.textAlign = "center";
  pen.textBaseline = "alphabetic";
  for (const [tick, text] of labelled(ticksOf(area.low, area.high, Math.max(3, width / 90)))) {
    const x = MARGIN.left + (tick - area.low) * area.scaleX;
    pen.fillText(`${text}${unit}`, Math.min(x, width - 16), HEIGHT - 6);
  }
}

function drawLine(pen, { times, values }, area, color) {
  const yOf = (value) => HEIGHT - MARGIN.bottom - (value - area.bottom) * area.scaleY;
  pen.strokeStyle = color;
  pen.lineWidth = 1.8;
  pen.lineJoin = "round";
  pen.beginPath();
  for (let index = 0; index < times.length; index += 1) {
    pen.lineTo(MARGIN.left + (times[index] - area.low) * area.scaleX, yOf(values[index]));
  }
  pen.stroke();
  if (times.length === 1) {
    pen.fillStyle = color;
    pen.fillRect(MARGIN.left - 2, yOf(values[0]) - 2, 5, 5);
  }
}
