/** An image below the robots on a map, with its scale and its place, as maps of ROS have them. */

import { button, errorPlace, h, tellError } from "./dom.js";

const NAME = "fibaction:ground";
const MOST_PIXELS = 1600; // of an edge, as it is kept
const FIELDS = { resolution: ["Meters per pixel", 0.05], x: ["x of the lower left corner", 0], y: ["y of the lower left corner", 0] };

export class Ground {
  /** Make the fields; `onchange` is called when there is another ground. */
  constructor(onchange) {
    this.onchange = onchange;
    this.image = null;
    this.inputs = Object.fromEntries(Object.entries(FIELDS).map(([name, [, value]]) => [name, h("input", { type: "number", step: "any", value, oninput: () => this.keep() })]));
    this.file = h("input", { type: "file", accept: "image/*", onchange: () => this.open(this.file.files[0]) });
    this.error = errorPlace();
    const fields = Object.entries(FIELDS).map(([name, [text]]) => h("label", {}, text, this.inputs[name]));
    const remove = button("Remove the image", () => this.remove(), { class: "quiet" });
    this.element = h("details", { class: "more" }, h("summary", {}, "Image as the ground"), h("div", { class: "tools" }, h("label", {}, "Image", this.file), ...fields, remove), this.error);
    this.restore();
  }

  /** Return the corners, of the lower left and of the upper right; none if there is no image. */
  get corners() {
    const [resolution, x, y] = ["resolution", "x", "y"].map((name) => Number(this.inputs[name].value));
    const size = this.image && [this.image.width * this.pixel * resolution, this.image.height * this.pixel * resolution];
    return size && resolution > 0 ? [[x, y], [x + size[0], y + size[1]]] : [];
  }

  draw(pen, { at }) {
    const { corners } = this;
    if (corners.length) {
      const [[left, bottom], [right, top]] = corners.map((corner) => at(...corner));
      pen.globalAlpha = 0.6;
      pen.drawImage(this.image, left, top, right - left, bottom - top);
      pen.globalAlpha = 1;
    }
  }

  async open(file) {
    try {
      const source = await createImageBitmap(file);
      this.pixel = Math.max(source.width, source.height, MOST_PIXELS) / MOST_PIXELS; // of the file in one that is kept
      this.image = h("canvas", { width: Math.round(source.width / this.pixel), height: Math.round(source.height / this.pixel) });
      this.image.getContext("2d").drawImage(source, 0, 0, this.image.width, this.image.height);
      tellError(this.error, "");
      this.keep();
    } catch {
      tellError(this.error, `${file.name} is not an image that this browser can read, such as PNG or JPEG.`);
    }
  }

  remove() {
    this.image = null;
    this.file.value = "";
    this.keep();
  }

  /** Remember the ground, as far as the browser has room for it. */
  keep() {
    try {
      const values = Object.fromEntries(Object.entries(this.inputs).map(([name, input]) => [name, input.value]));
      localStorage.setItem(NAME, JSON.stringify({ values, pixel: this.pixel, image: this.image?.toDataURL("image/webp") }));
    } catch {
      // It lasts as long as the page.
    }
    this.onchange();
  }

  restore() {
    try {
      const { values, pixel, image } = JSON.parse(localStorage.getItem(NAME) ?? "{}");
      Object.entries(values ?? {}).forEach(([name, value]) => { this.inputs[name].value = value; });
      if (image) {
        const loaded = h("img", { src: image });
        loaded.addEventListener("load", () => {
          this.image = h("canvas", { width: loaded.width, height: loaded.height });
          this.image.getContext("2d").drawImage(loaded, 0, 0);
          this.pixel = pixel;
          this.onchange();
        });
      }
    } catch {
      // There is none.
    }
  }
}
