/** The numbers in the feedback of one goal, in bounded memory. */

const MOST_POINTS = 2000;

/** Keeps lists bounded. When they are full, every second item goes, and later ones are rarer. */
export class Thinner {
  constructor() {
    this.stride = 1;
    this.skipped = 0;
  }

  /** Add an item to each of the lists, unless it is skipped, and return them. */
  add(lists, items) {
    this.skipped += 1;
    if (this.skipped < this.stride) {
      return lists;
    }
    this.skipped = 0;
    lists.forEach((list, index) => list.push(items[index]));
    if (lists[0].length <= MOST_POINTS) {
      return lists;
    }
    this.stride *= 2;
    return lists.map((list) => list.filter((_, index) => index % 2 === 0));
  }
}

/** One number over time. */
class Line {
  constructor(name, path) {
    this.name = name;
    this.path = path;
    this.times = [];
    this.values = [];
    this.latest = null;
    this.thinner = new Thinner();
  }

  add(time, value) {
    this.latest = value;
    [this.times, this.values] = this.thinner.add([this.times, this.values], [time, value]);
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
