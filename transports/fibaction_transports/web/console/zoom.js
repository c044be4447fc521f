/** The part of an axis that a chart shows, and the gestures and keys that change it. */

const MOST_TIMES = 1000; // that a part is smaller than the whole
const ALMOST_ALL = 0.999;
const STEP = 1.5;
const LEAST_DRAG = 5; // pixels; less is a click
const KEYS = {
  "+": (zoom, extent) => zoom.by(1 / STEP, extent),
  "=": (zoom, extent) => zoom.by(1 / STEP, extent),
  "-": (zoom, extent) => zoom.by(STEP, extent),
  ArrowLeft: (zoom, extent) => zoom.move(-0.25, extent),
  ArrowRight: (zoom, extent) => zoom.move(0.25, extent),
  0: (zoom) => zoom.reset(),
  Escape: (zoom) => zoom.reset(),
};

/** A part of an axis; null for the whole. The extent of an axis is its lowest and highest value. */
export class Zoom {
  constructor() {
    this.part = null;
  }

  /** Return what is shown of an axis of this extent, which may have changed. */
  of(extent) {
    const isThere = this.part && this.part[0] <= extent[1] && this.part[1] >= extent[0];
    return isThere ? this.part : extent;
  }

  /** Show the part between two values in any order. */
  select(one, other, [low, high]) {
    const [from, to] = [Math.max(Math.min(one, other), low), Math.min(Math.max(one, other), high)];
    if ((to - from) * MOST_TIMES >= high - low) {
      this.part = [from, to];
    }
  }

  /** Show a part that is so many times as large, around a value that stays where it is. */
  by(factor, extent, center = undefined) {
    const [low, high] = this.of(extent);
    const size = (high - low) * factor;
    if (size > (extent[1] - extent[0]) * ALMOST_ALL) {
      this.reset();
      return;
    }
    const fixed = center ?? (low + high) / 2;
    const from = Math.max(Math.min(fixed - (fixed - low) * factor, extent[1] - size), extent[0]);
    this.select(from, from + size, extent);
  }

  /** Move by a share of what is shown, as far as there is something. */
  move(share, [low, high]) {
    if (this.part) {
      const [from, to] = this.part;
      const step = Math.max(Math.min((to - from) * share, high - to), low - from);
      this.part = [from + step, to + step];
    }
  }

  /** Show the whole. */
  reset() {
    this.part = null;
  }
}

/**
 * Let gestures and keys at a canvas change a zoom. `axis()` returns the `extent` of the axis and a
 * function `valueAt` of pixels, or null while nothing is drawn; `ondrag` gets the pixels of what is
 * being selected, and null afterwards; `onzoom` is called after each change.
 */
export function listen(canvas, zoom, { axis, ondrag, onzoom }) {
  let begin = null;
  const change = (event, how) => {
    const found = axis();
    if (found) {
      event.preventDefault();
      how(found);
      onzoom();
    }
  };
  const end = () => {
    begin = null;
    ondrag(null);
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button === 0 && axis()) {
      begin = event.offsetX;
      canvas.setPointerCapture(event.pointerId);
    }
  });
  canvas.addEventListener("pointermove", (event) => begin !== null && ondrag([begin, event.offsetX]));
  canvas.addEventListener("pointerup", (event) => {
    const from = begin;
    end();
    if (from !== null && Math.abs(event.offsetX - from) >= LEAST_DRAG) {
      change(event, ({ extent, valueAt }) => zoom.select(valueAt(from), valueAt(event.offsetX), extent));
    }
  });
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("dblclick", (event) => change(event, () => zoom.reset()));
  canvas.addEventListener("wheel", (event) => {
    if (event.ctrlKey || event.metaKey) { // which a pinch on a touchpad has; else the page scrolls
      const factor = event.deltaY < 0 ? 1 / STEP : STEP;
      change(event, ({ extent, valueAt }) => zoom.by(factor, extent, valueAt(event.offsetX)));
    }
  });
  canvas.addEventListener("keydown", (event) => {
    const isPlain = !(event.ctrlKey || event.metaKey || event.altKey);
    if (isPlain && Object.hasOwn(KEYS, event.key) && (zoom.part || event.key !== "Escape")) {
      event.stopPropagation();
      change(event, ({ extent }) => KEYS[event.key](zoom, extent));
    }
  });
}
