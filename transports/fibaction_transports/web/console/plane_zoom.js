/** The part of a view from above that is shown, and the gestures and keys that change it. */

const STEP = 1.5;
const MOST_TIMES = 1000; // that a part is smaller than the whole
const ALMOST_ALL = 1.001;
const SHARE = 0.2; // of the view, by which a key moves it
const MOVES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/**
 * A part of a plane: its middle, and the pixels of one unit upwards. An area, as `areaOf` returns
 * it, has the whole of the plane, and where pixels are in it.
 */
export class PlaneZoom {
  constructor() {
    this.part = null;
  }

  /** Return what is shown of a plane whose whole has this middle and this scale. */
  of(whole) {
    return this.part ?? whole;
  }

  /**
   * Show a part that is so many times as large in pixels, around a point that stays where it is:
   * that of a pixel, or else the `focus` of the area, or its middle.
   */
  by(factor, { whole, scaleY, middle, pointAt, focus }, pixel = null) {
    const scale = Math.min(scaleY * factor, whole.scaleY * MOST_TIMES);
    if (scale <= whole.scaleY * ALMOST_ALL) {
      this.reset();
      return;
    }
    const fixed = pixel ? pointAt(...pixel) : (focus ?? middle);
    const share = scaleY / scale;
    this.show(fixed.map((one, axis) => one - (one - middle[axis]) * share), scale, whole);
  }

  /** Move what is shown by pixels to the right and down, as far as its middle has something. */
  move(right, down, { whole, scaleX, scaleY, middle }) {
    if (this.part) {
      this.show([middle[0] + right / scaleX, middle[1] - down / scaleY], scaleY, whole);
    }
  }

  show(middle, scaleY, { low, high }) {
    this.part = { middle: middle.map((one, axis) => Math.min(Math.max(one, low[axis]), high[axis])), scaleY };
  }

  /** Show the whole. */
  reset() {
    this.part = null;
  }

  /** Do what a key means, and return whether it means something now. */
  press(key, area) {
    const step = { "+": STEP, "=": STEP, "-": 1 / STEP }[key];
    if (step) {
      this.by(step, area);
    } else if (this.part && MOVES[key]) {
      this.move(...MOVES[key].map((way, axis) => way * SHARE * area.size[axis]), area);
    } else if (key === "0" || (this.part && key === "Escape")) {
      this.reset();
    } else {
      return false;
    }
    return true;
  }
}

/**
 * Let gestures and keys at a canvas change a zoom: the wheel with Ctrl, two fingers, a drag, a
 * double click. `area()` returns what is drawn, or null; `onzoom` is called after each change.
 */
export function listenToPlane(canvas, zoom, { area, onzoom }) {
  const pointers = new Map();
  const change = (event, how) => {
    const found = area();
    if (found && how(found) !== false) {
      event.preventDefault();
      onzoom();
    }
  };
  const drop = (event) => pointers.delete(event.pointerId);
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button === 0) {
      pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
      canvas.setPointerCapture(event.pointerId);
    }
  });
  canvas.addEventListener("pointermove", (event) => {
    const from = pointers.get(event.pointerId);
    if (!from) {
      return;
    }
    const to = [event.offsetX, event.offsetY];
    const other = [...pointers].find(([id]) => id !== event.pointerId)?.[1];
    pointers.set(event.pointerId, to);
    if (other) {
      const distance = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
      change(event, (found) => zoom.by(distance(to) / distance(from), found, other));
    } else if (zoom.part) {
      change(event, (found) => zoom.move(from[0] - to[0], from[1] - to[1], found));
    }
  });
  canvas.addEventListener("pointerup", drop);
  canvas.addEventListener("pointercancel", drop);
  canvas.addEventListener("dblclick", (event) => change(event, () => zoom.reset()));
  canvas.addEventListener("wheel", (event) => {
    if (event.ctrlKey || event.metaKey) { // which a pinch on a touchpad has; else the page scrolls
      const factor = event.deltaY < 0 ? STEP : 1 / STEP;
      change(event, (found) => zoom.by(factor, found, [event.offsetX, event.offsetY]));
    }
  });
  canvas.addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey || event.altKey)) {
      change(event, (found) => zoom.press(event.key, found));
      if (event.defaultPrevented) {
        event.stopPropagation();
      }
    }
  });
}
