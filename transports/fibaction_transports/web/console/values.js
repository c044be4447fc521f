/** Values of goals, feedback and results: as text, and as JSON that can be stored. */

const MOST_ITEMS = 100;
const MOST_BYTES = 48;

/** Return a value as indented text. Long lists and bytes are shortened, unless `whole`. */
export function textOf(value, { whole = false } = {}) {
  return write(value, "", whole);
}

function write(value, indent, whole) {
  if (value === undefined) {
    return "";
  }
  if (typeof value === "bigint") {
    return value.toString();
  }
  if (value instanceof Uint8Array) {
    const isShort = whole || value.length <= MOST_BYTES;
    return isShort ? `"${base64Of(value)}"` : `"${base64Of(value.subarray(0, MOST_BYTES))}…" (${value.length} bytes)`;
  }
  if (Array.isArray(value)) {
    return writeList(value, indent, whole);
  }
  if (value !== null && typeof value === "object") {
    const deeper = `${indent}  `;
    const lines = Object.entries(value).map(
      ([name, item]) => `${deeper}${JSON.stringify(name)}: ${write(item, deeper, whole)}`,
    );
    return lines.length ? `{\n${lines.join(",\n")}\n${indent}}` : "{}";
  }
  return JSON.stringify(value) ?? String(value);
}

function writeList(list, indent, whole) {
  const shown = whole ? list : list.slice(0, MOST_ITEMS);
  const isFlat = shown.every((item) => item === null || typeof item !== "object");
  const deeper = isFlat ? "" : `${indent}  `;
  const items = shown.map((item) => deeper + write(item, deeper, whole));
  if (shown.length < list.length) {
    items.push(`${deeper}… ${list.length - shown.length} more`);
  }
  return isFlat ? `[${items.join(", ")}]` : `[\n${items.join(",\n")}\n${indent}]`;
}

/** Return a value in one short line. */
export function summaryOf(value, length = 80) {
  if (value === undefined) {
    return "";
  }
  const text = textOf(value).replace(/\s+/g, " ").replace(/^\{ | \}$/g, "").replaceAll('"', "");
  return text.length > length ? `${text.slice(0, length)}…` : text;
}

const STRING_OR_NUMBER = /"(?:[^"\\]|\\.)*"|-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?/g;
const INTEGER = /^-?(?:0|[1-9]\d*)$/;

/** Read JSON in which integers beyond 2^53 stay exact: they become `BigInt`. */
export function parsed(text) {
  const mark = crypto.getRandomValues(new Uint32Array(4)).join(); // which no text begins with
  const marked = text.replace(STRING_OR_NUMBER, (part) =>
    INTEGER.test(part) && !Number.isSafeInteger(Number(part)) ? `"${mark}${part}"` : part);
  return JSON.parse(marked, (_, item) =>
    typeof item === "string" && item.startsWith(mark) ? BigInt(item.slice(mark.length)) : item);
}

/** Return JSON that `restored` reads again: large numbers and bytes stay what they are. */
export function stored(value) {
  return JSON.stringify(value, (_, item) => {
    if (typeof item === "bigint") {
      return { $number: item.toString() };
    }
    return item instanceof Uint8Array ? { $bytes: base64Of(item) } : item;
  });
}

/** Return the value of a JSON text that `stored` has made. */
export function restored(text) {
  return JSON.parse(text, (_, item) => {
    if (typeof item?.$number === "string") {
      return BigInt(item.$number);
    }
    return typeof item?.$bytes === "string" ? bytesOf(item.$bytes) : item;
  });
}

/** Return the bytes that a text in base64 stands for; an error if it is not base64. */
export function bytesOf(text) {
  let letters;
  try {
    letters = atob(text);
  } catch {
    throw new SyntaxError(`${JSON.stringify(text.slice(0, MOST_BYTES))} is not base64`);
  }
  return Uint8Array.from(letters, (letter) => letter.charCodeAt(0));
}

/** Return bytes as text in base64. */
export function base64Of(bytes) {
  let text = "";
  for (const byte of bytes) {
    text += String.fromCharCode(byte);
  }
  return btoa(text);
}
