/** A chart of numbers on a canvas, with its legend as text. */

import { h, setText } from "./dom.js";

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

/** One chart of a goal. */
export class Chart {
  constructor(chart) {
    this.chart = chart;
    this.canvas = h("canvas", { role: "img", "aria-label": `Chart of ${chart.title}` });
    this.values = chart.lines.map(() => h("b"));
    const names = chart.lines.map((line, index) =>
      h("span", { class: `key line-${index % 6}` }, `${shortName(line, chart)} `, this.values[index]),
    );
    const title = chart.unit ? `${chart.title} (${chart.unit})` : chart.title;
    this.element = h(
      "figure",
      { class: "chart" },
      h("figcaption", {}, h("strong", {}, title), " ", ...names),
      this.canvas,
    );
    this.pointer = null;
    this.canvas.addEventListener("pointermove", (event) => this.point(event.offsetX));
    this.canvas.addEventListener("pointerleave", () => this.point(null));
  }

  point(x) {
    this.pointer = x;
    this.draw();
  }

  /** Draw what there is now. */
  draw() {
    const width = this.canvas.clientWidth;
    if (!width) {
      return;
    }
    const scale = window.devicePixelRatio || 1;
    if (this.canvas.width !== Math.round(width * scale)) {
      this.canvas.width = Math.round(width * scale);
      this.canvas.height = Math.round(HEIGHT * scale);
    }
    const pen = this.canvas.getContext("2d");
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, HEIGHT);
    const style = getComputedStyle(this.canvas);
    const area = areaOf(this.chart.lines, width);
    if (area) {
      drawAxes(pen, area, style, width, this.chart.isCurve ? "" : " s");
      this.chart.lines.forEach((line, index) => {
        drawLine(pen, line, area, style.getPropertyValue(`--line-${index % 6}`));
      });
    }
    this.tell(area);
  }

  /** Write the newest values into the legend, or those at the pointer. */
  tell(area) {
    this.chart.lines.forEach((line, index) => {
      let value = line.latest;
      if (this.pointer !== null && area) {
        const time = area.low + (this.pointer - MARGIN.left) / area.scaleX;
        const at = line.times.findIndex((one) => one >= time);
        value = line.values[at] ?? value;
      }
      setText(this.values[index], shortNumber(value));
    });
  }
}

function shortName(line, chart) {
  return line.name.startsWith(`${chart.title}.`) ? line.name.slice(chart.title.length + 1) : line.name;
}

/** Return the scales of a chart; null if it is empty. */
function areaOf(lines, width) {
  let [low, high, bottom, top] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const { times, values } of lines) {
    if (times.length) {
      low = Math.min(low, times[0]);
      high = Math.max(high, times[times.length - 1]);
      for (const value of values) {
        bottom = value < bottom ? value : bottom;
        top = value > top ? value : top;
      }
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
  return { low, high, bottom, top, scaleX, scaleY };
}

function drawAxes(pen, area, style, width, unit) {
  pen.font = "11px system-ui, sans-serif";
  pen.fillStyle = style.getPropertyValue("--faint");
  pen.strokeStyle = style.getPropertyValue("--grid");
  pen.lineWidth = 1;
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (const tick of ticksOf(area.bottom, area.top)) {
    const y = Math.round(HEIGHT - MARGIN.bottom - (tick - area.bottom) * area.scaleY) + 0.5;
    pen.beginPath();
    pen.moveTo(MARGIN.left, y);
    pen.lineTo(width - MARGIN.right, y);
    pen.stroke();
    pen.fillText(shortNumber(tick), MARGIN.left - 6, y);
  }
  pen.textAlign = "center";
  pen.textBaseline = "alphabetic";
  for (const tick of ticksOf(area.low, area.high, Math.max(3, width / 90))) {
    const x = MARGIN.left + (tick - area.low) * area.scaleX;
    pen.fillText(`${shortNumber(tick)}${unit}`, Math.min(x, width - 16), HEIGHT - 6);
  }
}

function drawLine(pen, { times, values }, area, color) {
  pen.strokeStyle = color;
  pen.lineWidth = 1.8;
  pen.lineJoin = "round";
  pen.beginPath();
  for (let index = 0; index < times.length; index += 1) {
    const x = MARGIN.left + (times[index] - area.low) * area.scaleX;
    const y = HEIGHT - MARGIN.bottom - (values[index] - area.bottom) * area.scaleY;
    pen.lineTo(x, y);
  }
  pen.stroke();
  if (times.length === 1) {
    pen.fillStyle = color;
    const y = HEIGHT - MARGIN.bottom - (values[0] - area.bottom) * area.scaleY;
    pen.fillRect(MARGIN.left - 2, y - 2, 5, 5);
  }
}
