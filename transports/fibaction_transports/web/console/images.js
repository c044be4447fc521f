/** Images of goals, feedback and results, drawn on canvases. */

import { h, setText, show } from "./dom.js";
import { mediaTypeOf, pixelsOf, valueAt } from "./feedback_parts.js";

const MOST_WIDTH = 1280;
const SMALL = 128; // pixels that are shown as they are

/** One image, which changes with each message; while one is decoded, only the newest waits. */
class ImageView {
  constructor(image, of) {
    this.image = image;
    this.canvas = h("canvas", { role: "img", "aria-label": `Image ${image.name} of the ${of}` });
    this.size = h("span", {});
    this.element = h("figure", { class: "image", hidden: true }, h("figcaption", {}, h("strong", {}, image.name), this.size), this.canvas);
    this.wanted = this.drawn = undefined;
  }

  show(message) {
    this.wanted = valueAt(message, this.image.path);
    if (!this.isBusy) {
      this.drawAll();
    }
  }

  async drawAll() {
    this.isBusy = true;
    while (this.drawn !== this.wanted) {
      this.drawn = this.wanted;
      const source = await this.decode(this.drawn).catch(() => null);
      show(this.element, Boolean(source));
      if (source) {
        this.draw(source);
      }
    }
    this.isBusy = false;
  }

  /** Return what a canvas can draw; null if the value is not an image. */
  async decode(value) {
    if (this.image.isRaw) {
      const pixels = pixelsOf(value);
      return pixels && createImageBitmap(new ImageData(pixels.rgba, pixels.width, pixels.height));
    }
    const type = mediaTypeOf(value, this.image.mediaType);
    return type ? createImageBitmap(new Blob([value], { type })) : null;
  }

  draw(source) {
    const scale = Math.min(1, MOST_WIDTH / source.width);
    this.canvas.width = Math.round(source.width * scale);
    this.canvas.height = Math.round(source.height * scale);
    this.canvas.getContext("2d").drawImage(source, 0, 0, this.canvas.width, this.canvas.height);
    this.canvas.classList.toggle("small", source.width < SMALL);
    setText(this.size, `${source.width} × ${source.height}`);
    source.close();
  }
}

/** The images of a goal, of its feedback or of its result. */
export class Images {
  /** Make views of these images, as `imagesOf` the schema has found them. */
  constructor(images, of) {
    this.views = images.map((image) => new ImageView(image, of));
    this.element = h("div", { class: "images" }, ...this.views.map((view) => view.element));
  }

  show(message) {
    this.views.forEach((view) => view.show(message));
  }
}
