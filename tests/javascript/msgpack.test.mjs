// Msgpack: the bytes of every message of the protocol, and each form of each type.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { ProtocolError, decode, encode } from "./fibaction.js";

const fromHex = (hex) => Uint8Array.from(Buffer.from(hex, "hex"));
const toHex = (bytes) => Buffer.from(bytes).toString("hex");

function revived(value) {
  if (Array.isArray(value)) return value.map(revived);
  if (value === null || typeof value !== "object") return value;
  if ("hex" in value) return fromHex(value.hex);
  if ("bigint" in value) return BigInt(value.bigint);
  const pairs = revived(value.pairs);
  const isText = pairs.every(([key]) => typeof key === "string");
  return isText ? Object.fromEntries(pairs) : new Map(pairs);
}

test("all messages and values are as msgspec has them", () => {
  const cases = JSON.parse(readFileSync("cases.json", "utf-8"));
  assert.ok(cases.length > 90);
  for (const [hex, json] of cases) {
    const value = revived(json);
    assert.deepEqual(decode(fromHex(hex)), value);
    assert.deepEqual(decode(encode(value)), value);
    if (!hasWholeFloat(value, hex)) assert.equal(toHex(encode(value)), hex);
  }
});

// JavaScript has no 1.0 beside 1. The protocol takes integers for numbers.
function hasWholeFloat(value, hex) {
  return Array.isArray(value) && hex.includes("cb") && [16, 17, 32].includes(value[0]);
}

test("values of JavaScript alone have a form, too", () => {
  assert.equal(toHex(encode({ a: undefined, b: null })), "81a162c0");
  assert.equal(toHex(encode(-0)), "cb8000000000000000");
  assert.equal(toHex(encode(2 ** 53)), "cb4340000000000000");
  assert.equal(toHex(encode(5n)), "05");
  assert.equal(toHex(encode(new Float64Array([1, 0.5]))), "9201cb3fe0000000000000");
  assert.equal(decode(encode(new Date(0))), "1970-01-01T00:00:00.000Z");
  assert.equal(Number.isNaN(decode(encode(NaN))), true);
  assert.equal(decode(fromHex("ca3f000000")), 0.5);
  assert.equal(decode(fromHex("d3ffffffffffffffff")), -1);
});

test("what cannot be sent is an error", () => {
  assert.throws(() => encode(2n ** 64n), RangeError);
  assert.throws(() => encode(-(2n ** 63n) - 1n), RangeError);
  assert.throws(() => encode(Symbol("a")), TypeError);
});

test("invalid bytes are a ProtocolError", () => {
  for (const hex of ["", "c1", "a5", "c405ff", "c70305010203", "d6ff00000001", "dd00ffffff", "a1ff", "92", "cf00",
    "91".repeat(100_000)]) {
    assert.throws(() => decode(fromHex(hex)), ProtocolError, hex.slice(0, 20));
  }
});
