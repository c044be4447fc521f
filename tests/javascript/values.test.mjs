// The values of the console: JSON that a person writes, and JSON that the history keeps.

import assert from "node:assert/strict";
import test from "node:test";
import { parsed, restored, stored, textOf } from "./values.js";

test("integers beyond 2^53 stay exact at any depth, and all else is as JSON has it", () => {
  const text = '{"a": [18446744073709551615, {"b": -9007199254740993}], "c": 1.5e300, "9007199254740993": 7}';
  assert.deepEqual(parsed(text),
    { a: [2n ** 64n - 1n, { b: -9007199254740993n }], c: 1.5e300, "9007199254740993": 7 });
});

test("digits in a text stay text, with any character before them", () => {
  assert.deepEqual(parsed('["12", "\\u000012", "9007199254740993", "a \\"9007199254740993\\""]'),
    ["12", "\x0012", "9007199254740993", 'a "9007199254740993"']);
});

test("what is no JSON is an error", () => {
  for (const text of ["", "{", "[1,]", "01", "-09007199254740993", "NaN", "9007199254740993x"]) {
    assert.throws(() => parsed(text), SyntaxError, text);
  }
});

test("values that are stored come back as they were", () => {
  const value = { large: [2n ** 63n], bytes: Uint8Array.of(0, 255), text: "x", none: null };
  assert.deepEqual(restored(stored(value)), value);
  assert.equal(textOf(2n ** 63n), "9223372036854775808");
});
