/** Parts of goals, feedback and results that are shown by themselves: text, and images. */

import { isRosImage, kindOf, resolverOf } from "./schema.js";

const PIECES = ["token", "delta", "chunk"]; // fields of feedback that continue a text
const MOST_LETTERS = 20_000;
const MOST_KEPT_LETTERS = 4000;
const MOST_IMAGES = 4;
const MOST_LEVELS = 8;
const MOST_PIXELS = 2 ** 24;
const COLORS = { rgb8: [0, 1, 2], bgr8: [2, 1, 0], rgba8: [0, 1, 2, 3], bgra8: [2, 1, 0, 3], "8UC3": [2, 1, 0], mono8: [0, 0, 0], "8UC1": [0, 0, 0] };
const WIDTHS = { rgba8: 4, bgra8: 4, mono8: 1, "8UC1": 1 };
const DEPTHS = { mono16: "getUint16", "16UC1": "getUint16", "32FC1": "getFloat32" };
const BEGINNINGS = [["image/png", "89504e470d0a1a0a"], ["image/jpeg", "ffd8ff"], ["image/gif", "47494638"], ["image/webp", "52494646........57454250"]];

/** Return the value at a path; undefined if there is none. */
export function valueAt(value, path) {
  return path.reduce((part, name) => part?.[name], value);
}

/** Return the path of the text that each feedback continues; null if there is none. */
export function textPathOf(root) {
  const resolve = resolverOf(root);
  const schema = resolve(root);
  const isText = (one) => kindOf(one, resolve).kind === "string" && !one.format;
  if (isText(schema)) {
    return [];
  }
  const name = PIECES.find((one) => schema.properties?.[one] && isText(resolve(schema.properties[one])));
  return name ? [name] : null;
}

/** Return the places where values of a schema may have images: bytes, or an image of ROS. */
export function imagesOf(root) {
  const resolve = resolverOf(root);
  const found = [];
  const visit = (given, path) => {
    let schema = resolve(given);
    const { kind, inner } = kindOf(schema, resolve);
    schema = kind === "nullable" ? resolve(inner) : schema;
    const fields = schema.properties ?? {};
    if (found.length === MOST_IMAGES || path.length > MOST_LEVELS) {
      return;
    }
    if (isRosImage(schema, resolve)) {
      found.push({ name: path.join(".") || "image", path, isRaw: true });
    } else if (kindOf(schema, resolve).kind === "bytes") {
      found.push({ name: path.join(".") || "image", path, mediaType: schema.contentMediaType });
    } else {
      Object.entries(fields).forEach(([name, one]) => visit(one, [...path, name]));
    }
  };
  visit(root, []);
  return found;
}

/** Return the media type of an image, declared or by its first bytes; empty if it is not an image. */
export function mediaTypeOf(bytes, declared = "") {
  if (!(bytes instanceof Uint8Array) || !bytes.length) {
    return "";
  }
  const head = Array.from(bytes.subarray(0, 12), (byte) => byte.toString(16).padStart(2, "0")).join("");
  const known = BEGINNINGS.find(([, beginning]) => new RegExp(`^${beginning}`).test(head));
  return known?.[0] ?? (declared.startsWith("image/") ? declared : "");
}

/** Return the pixels of an image of ROS as RGBA; null if its encoding is not known. */
export function pixelsOf(image) {
  const [width, height, step] = [image?.width, image?.height, image?.step].map(Number);
  const size = DEPTHS[image?.encoding] ? (image.encoding === "32FC1" ? 4 : 2) : (WIDTHS[image?.encoding] ?? 3);
  const isWhole = width > 0 && height > 0 && width * height <= MOST_PIXELS && step >= width * size;
  if (!isWhole || !(image.data instanceof Uint8Array) || image.data.length < step * (height - 1) + width * size) {
    return null;
  }
  if (DEPTHS[image.encoding]) {
    return { width, height, rgba: ofDepths(image, width, height, step, size) };
  }
  const colors = COLORS[image.encoding];
  return colors ? { width, height, rgba: ofColors(image.data, colors, width, height, step, size) } : null;
}

function ofColors(data, [red, green, blue, alpha], width, height, step, size) {
  const rgba = new Uint8ClampedArray(4 * width * height);
  for (let to = 0, y = 0; y < height; y += 1) {
    for (let x = 0, from = y * step; x < width; x += 1, from += size, to += 4) {
      rgba[to] = data[from + red];
      rgba[to + 1] = data[from + green];
      rgba[to + 2] = data[from + blue];
      rgba[to + 3] = alpha === undefined ? 255 : data[from + alpha];
    }
  }
  return rgba;
}

/** Return distances as grey, the largest one white; what is not measured is black. */
function ofDepths({ data, encoding, is_bigendian: isBig }, width, height, step, size) {
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  const at = (index) => view[DEPTHS[encoding]](Math.floor(index / width) * step + (index % width) * size, !isBig);
  const depths = Float32Array.from({ length: width * height }, (_, index) => at(index));
  const most = depths.reduce((largest, one) => (Number.isFinite(one) ? Math.max(largest, one) : largest), 0) || 1;
  const rgba = new Uint8ClampedArray(4 * depths.length).fill(255);
  depths.forEach((one, index) => rgba.fill(Number.isFinite(one) ? (255 * one) / most : 0, 4 * index, 4 * index + 3));
  return rgba;
}

/**
 * The text of one goal, whose pieces are its feedback. Pieces of which one begins or ends with a
 * space continue each other, as tokens do; others are lines.
 */
export class TextFeed {
  constructor(path) {
    this.path = path;
    this.clear(0);
  }

  clear(attempt) {
    Object.assign(this, { attempt, last: 0, pieces: [], letters: 0, isStream: false, isCut: false });
  }

  /** Take the piece in one feedback message; a message that was read before counts once. */
  add(feedback, number, attempt) {
    if (attempt !== this.attempt) {
      this.clear(attempt);
    }
    const piece = this.path && valueAt(feedback, this.path);
    if (typeof piece !== "string" || number <= this.last) {
      return;
    }
    if (number > this.last + 1) {
      this.push("…");
    }
    this.last = number;
    this.isStream ||= /^\s|\s$/.test(piece);
    this.push(piece);
  }

  push(piece) {
    this.pieces.push(piece);
    this.letters += piece.length + 1;
    this.shorten(MOST_LETTERS);
  }

  /** Forget the oldest pieces, so that at most so many letters are left. */
  shorten(most) {
    let count = 0;
    while (this.letters > most && count < this.pieces.length - 1) {
      this.letters -= this.pieces[count].length + 1;
      count += 1;
    }
    this.pieces.splice(0, count);
    this.isCut ||= count > 0;
  }

  get text() {
    const text = this.pieces.join(this.isStream ? "" : "\n").slice(-MOST_LETTERS);
    return this.isCut ? `…${text}` : text;
  }

  /** Return what the history keeps: the end of the text. */
  kept() {
    return this.text.slice(-MOST_KEPT_LETTERS);
  }

  /** Take a text that `kept` has returned. */
  restore(text) {
    this.clear(0);
    if (text) {
      this.push(text);
    }
  }
}
