/** A field for bytes: base64 that a person enters, or a file. */

import { h, setText } from "./dom.js";
import { FieldError, labelled } from "./field_parts.js";
import { counted } from "./goal_text.js";
import { base64Of, bytesOf } from "./values.js";

const MOST_SHOWN = 2000; // bytes that are written into the input

export function bytesField({ schema, name, value }) {
  let held = null; // bytes of a file, or bytes that are too many for the input
  let isReading = false;
  const note = h("small", { role: "status" });
  const input = h("input", { type: "text", placeholder: "base64", autocomplete: "off", oninput: () => hold(null) });
  const file = h("input", { type: "file", accept: schema.contentMediaType, "aria-label": `File for ${name}`, onchange: () => take(file.files[0]) });
  const hold = (bytes) => {
    held = bytes;
    setText(note, bytes ? counted(bytes.length, "byte") : "");
    if (bytes) {
      input.value = "";
    } else {
      file.value = "";
    }
  };
  const take = async (chosen) => {
    isReading = true;
    try {
      hold(chosen ? new Uint8Array(await chosen.arrayBuffer()) : null);
    } catch (error) {
      hold(null);
      setText(note, `the file cannot be read: ${error.message}`);
    } finally {
      isReading = false;
    }
  };
  const set = (one) => {
    const isLarge = one instanceof Uint8Array && one.length > MOST_SHOWN;
    file.value = "";
    hold(isLarge ? one : null);
    if (!isLarge) {
      input.value = one instanceof Uint8Array ? base64Of(one) : String(one ?? "");
    }
  };
  set(value);
  const fail = (text) => {
    throw new FieldError(`${name}: ${text}`, input);
  };
  const read = () => {
    if (isReading) {
      fail("the file is still being read");
    }
    try {
      return held ?? bytesOf(input.value.trim());
    } catch (error) {
      return fail(error.message);
    }
  };
  return { element: labelled(schema, name, input, file, note), read, set };
}
