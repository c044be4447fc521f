/** The numbers in the feedback of one goal, in bounded memory. */

const MOST_POINTS = 2000;

/** One number over time. When it is full, every second point goes, and later ones are rarer. */
class Line {
  constructor(name, path) {
    this.name = name;
    this.path = path;
    this.times = [];
    this.values = [];
    this.latest = null;
    this.stride = 1;
    this.skipped = 0;
  }

  add(time, value) {
    this.latest = value;
    this.skipped += 1;
    if (this.skipped < this.stride) {
      return;
    }
    this.skipped = 0;
    this.times.push(time);
    this.values.push(value);
    if (this.times.length > MOST_POINTS) {
      this.times = this.times.filter((_, index) => index % 2 === 0);
      this.values = this.values.filter((_, index) => index % 2 === 0);
      this.stride *= 2;
    }
  }
}

/** A list of numbers, of which the newest one is drawn. */
class Curve {
  constructor(name, path) {
    this.name = name;
    this.path = path;
    this.times = [];
    this.values = [];
    this.latest = null;
  }

  add(_, list) {
    const rest = Math.max(0, list.length - MOST_POINTS);
    this.values = rest ? list.slice(rest) : list;
    this.times = this.values.map((_, index) => rest + index);
    this.latest = list.length ? list[list.length - 1] : null;
  }
}

/** The charts of one goal, as `chartsOf` its schema describes them. */
export class Series {
  constructor(charts) {
    this.charts = charts.map((chart) => ({
      ...chart,
      lines: chart.lines.map((line) =>
        line.isCurve ? new Curve(line.name, line.path) : new Line(line.name, line.path),
      ),
    }));
  }

  /** Take the numbers of one feedback message; the time is in seconds. */
  add(feedback, time) {
    for (const chart of this.charts) {
      for (const line of chart.lines) {
        let value = feedback;
        for (const name of line.path) {
          value = value?.[name];
        }
        if (chart.isCurve ? Array.isArray(value) : value !== null && isFinite(Number(value ?? NaN))) {
          line.add(time, chart.isCurve ? value.map(Number) : Number(value));
        }
      }
    }
  }

  /** Return the points as plain data, at most so many of each line. */
  kept(most) {
    return this.charts.map((chart) =>
      chart.lines.map(({ times, values, latest }) => {
        const step = Math.ceil(times.length / most) || 1;
        const isKept = (_, index) => index % step === 0 || index === times.length - 1;
        const rounded = (number) => Number(number.toPrecision(6));
        const kept = [times, values].map((list) => list.filter(isKept).map(rounded));
        return [...kept, latest];
      }),
    );
  }

  /** Take points that `kept` has returned. */
  restore(kept) {
    kept.forEach((lines, chart) =>
      lines.forEach(([times, values, latest], index) => {
        const line = this.charts[chart]?.lines[index];
        if (line) {
          Object.assign(line, { times, values, latest });
        }
      }),
    );
  }
}
