// Text and images in the console, found by the schema; and the limits that the form tells.

import assert from "node:assert/strict";
import test from "node:test";
import { TextFeed, imagesOf, mediaTypeOf, pixelsOf, textPathOf } from "./feedback_parts.js";
import { GoalRecord } from "./goal_record.js";
import { chartsOf, rangeOf, resolverOf, withBytes } from "./schema.js";
import { textOf } from "./values.js";

const BYTES = { type: "string", contentEncoding: "base64" };
const object = (properties) => ({ type: "object", properties });

/** Return the text of pieces that come one after another. */
function textOfPieces(...pieces) {
  const feed = new TextFeed([]);
  pieces.forEach((piece, index) => feed.add(piece, index + 1, 1));
  return feed.text;
}

test("feedback that is text, or that has a field for the next piece, is text", () => {
  assert.deepEqual(textPathOf({ type: "string" }), []);
  const reference = { $ref: "#/$defs/Token", $defs: { Token: object({ token: { type: "string" } }) } };
  assert.deepEqual(textPathOf(reference), ["token"]);
  const others = [{ type: "string", format: "date-time" }, BYTES, { enum: ["a", "b"] }, {}, true,
    object({ text: { type: "string" }, token: { type: "integer" } })];
  others.forEach((schema) => assert.equal(textPathOf(schema), null, JSON.stringify(schema)));
});

test("tokens continue each other, and sentences are lines", () => {
  assert.equal(textOfPieces("Hel", "lo", " you", "\n!"), "Hello you\n!");
  assert.equal(textOfPieces("drive to the shelf", "pick the cup"), "drive to the shelf\npick the cup");
});

test("a piece that comes again counts once, a missing one is marked, another attempt begins anew", () => {
  const feed = new TextFeed(["token"]);
  for (const [token, number] of [["a ", 1], ["b ", 2], ["a ", 1], ["b ", 2], ["d", 4]]) {
    feed.add({ token }, number, 1);
  }
  assert.equal(feed.text, "a b …d");
  feed.add({ token: 7 }, 5, 1);
  feed.add(null, 6, 1);
  assert.equal(feed.text, "a b …d");
  feed.add({ token: "x" }, 1, 2);
  assert.equal(feed.text, "x");
});

test("a long text loses its beginning, and the history keeps its end", () => {
  const feed = new TextFeed([]);
  for (let number = 1; number <= 30_000; number += 1) feed.add(`${number} `, number, 1);
  assert.match(feed.text, /^…\d+ /);
  assert.match(feed.text, /29999 30000 $/);
  assert.ok(feed.text.length <= 20_001 && feed.pieces.length < 5000);
  const again = new TextFeed([]);
  again.restore(feed.kept());
  assert.match(again.text, /29999 30000 $/);
  assert.ok(again.text.length <= 4000);
  again.restore(undefined);
  assert.equal(again.text, "");
  assert.ok(textOfPieces("x".repeat(50_000)).length <= 20_001);
});

test("a goal keeps its text with its feedback, and few messages that may be images", () => {
  const info = (feedback) => ({ name: "a", goal: {}, feedback, result: {} });
  const record = new GoalRecord("a", "01", info({ type: "string" }));
  record.addFeedback("one ", 1, 1);
  record.addFeedback("two", 2, 1);
  assert.equal(GoalRecord.of(record.kept(), record.info).text.text, "one two");
  const seen = new GoalRecord("a", "02", info(BYTES));
  for (let number = 1; number <= 100; number += 1) seen.addFeedback(new Uint8Array(9), number, 1);
  assert.equal(seen.lines.length, 10);
  assert.ok(seen.recent.length <= 20);
});

test("images are bytes and images of ROS, at most four", () => {
  const image = object({ width: {}, height: {}, encoding: {}, step: {}, data: BYTES });
  const found = imagesOf(object({ header: object({ stamp: {} }), left: image,
    photo: { ...BYTES, contentMediaType: "image/png" }, more: { anyOf: [BYTES, { type: "null" }] },
    none: object({ width: {}, height: {}, data: BYTES }), fifth: BYTES }));
  assert.deepEqual(found.map(({ name, isRaw }) => [name, Boolean(isRaw)]),
    [["left", true], ["photo", false], ["more", false], ["none.data", false]]);
  assert.equal(found[1].mediaType, "image/png");
  assert.deepEqual(imagesOf(BYTES).map(({ name }) => name), ["image"]);
  const tree = { $ref: "#/$defs/Tree", $defs: { Tree: object({ inner: { $ref: "#/$defs/Tree" } }) } };
  assert.deepEqual(imagesOf(tree), []);
  const seen = object({ image: object({ width: { type: "integer" }, height: {}, encoding: {}, step: {}, data: BYTES }),
    width: { type: "integer" } });
  assert.deepEqual(chartsOf(seen).map(({ title }) => title), ["width"]);
});

test("bytes are an image by their beginning or by their declared type", () => {
  const bytes = (text) => Uint8Array.from(Buffer.from(text, "latin1"));
  assert.equal(mediaTypeOf(bytes("\x89PNG\r\n\x1a\n..."), "image/jpeg"), "image/png");
  assert.equal(mediaTypeOf(bytes("\xff\xd8\xff\xe0")), "image/jpeg");
  assert.equal(mediaTypeOf(bytes("RIFF....WEBP")), "image/webp");
  assert.equal(mediaTypeOf(bytes("BM"), "image/bmp"), "image/bmp");
  for (const one of [bytes(""), bytes("text"), "text", undefined, null]) assert.equal(mediaTypeOf(one), "");
  assert.equal(mediaTypeOf(bytes("text"), "text/plain"), "");
});

test("an image of ROS becomes pixels, row by row", () => {
  const of = (encoding, data, more = {}) => {
    const found = pixelsOf({ width: 2, height: 1, step: data.length, encoding, data: Uint8Array.from(data), ...more });
    return found && [...found.rgba];
  };
  assert.deepEqual(of("rgb8", [1, 2, 3, 4, 5, 6]), [1, 2, 3, 255, 4, 5, 6, 255]);
  assert.deepEqual(of("bgr8", [1, 2, 3, 4, 5, 6]), [3, 2, 1, 255, 6, 5, 4, 255]);
  assert.deepEqual(of("bgra8", [1, 2, 3, 9, 4, 5, 6, 8]), [3, 2, 1, 9, 6, 5, 4, 8]);
  assert.deepEqual(of("mono8", [7, 9, 0, 0]), [7, 7, 7, 255, 9, 9, 9, 255]);
  assert.deepEqual(of("16UC1", [100, 0, 200, 0]), [128, 128, 128, 255, 255, 255, 255, 255]);
  assert.deepEqual(of("mono16", [0, 100, 0, 200], { is_bigendian: 1 }), [128, 128, 128, 255, 255, 255, 255, 255]);
  const floats = new Uint8Array(Float32Array.of(NaN, 2).buffer);
  assert.deepEqual(of("32FC1", [...floats]), [0, 0, 0, 255, 255, 255, 255, 255]);
  assert.deepEqual(of("mono8", [7, 0, 9, 0], { width: 1, height: 2, step: 2 }), [7, 7, 7, 255, 9, 9, 9, 255]);
  for (const [encoding, data, more] of [["yuv422", [1, 2, 3, 4, 5, 6]], ["rgb8", [1, 2, 3]],
    ["rgb8", [1, 2, 3, 4, 5, 6], { step: 3 }], ["mono8", [1, 2], { width: 2n ** 30n, step: 2n ** 30n }],
    ["mono8", [1, 2], { data: "text" }], ["mono8", [1], { width: 0 }]]) {
    assert.equal(of(encoding, data, more), null, encoding);
  }
  assert.equal(pixelsOf(undefined), null);
});

test("the limits of a number are told, but for those of its type", () => {
  assert.equal(rangeOf({ minimum: 0, maximum: 2.5 }), "0 to 2.5");
  assert.equal(rangeOf({ exclusiveMinimum: 0, maximum: 2 }), "more than 0, at most 2");
  assert.equal(rangeOf({ minimum: -1 }), "at least -1");
  assert.equal(rangeOf({ exclusiveMaximum: 1 }), "less than 1");
  assert.equal(rangeOf({ minimum: -(2 ** 31), maximum: 2 ** 31 - 1 }), "");
  assert.equal(rangeOf({ minimum: 0, maximum: 2n ** 64n - 1n }), "at least 0");
  assert.equal(rangeOf({ minimum: -3.4e38, maximum: 3.4e38 }), "");
  assert.equal(rangeOf({}), "");
});

test("base64 of JSON becomes bytes where the schema has them, at any place", () => {
  const part = { properties: { kind: { const: "photo" }, data: BYTES }, required: ["kind", "data"] };
  const root = { ...object({ note: { type: "string" }, raw: BYTES, none: { anyOf: [BYTES, { type: "null" }] },
    list: { type: "array", items: BYTES }, pair: { type: "array", prefixItems: [{ type: "string" }, BYTES], items: false },
    all: { type: "object", additionalProperties: BYTES },
    one: { anyOf: [{ type: "string" }, { $ref: "#/$defs/Part" }] } }), $defs: { Part: { type: "object", ...part } } };
  const resolve = resolverOf(root);
  const bytes = Uint8Array.of(0, 1, 2);
  assert.deepEqual(withBytes({ note: "AAEC", raw: "AAEC", none: null, list: ["AAEC"], pair: ["AAEC", "AAEC"],
    all: { AAEC: "AAEC" }, one: { kind: "photo", data: "AAEC" }, unknown: "AAEC" }, root, resolve),
  { note: "AAEC", raw: bytes, none: null, list: [bytes], pair: ["AAEC", bytes],
    all: { AAEC: bytes }, one: { kind: "photo", data: bytes }, unknown: "AAEC" });
  assert.deepEqual(withBytes({ none: "AAEC", one: "AAEC", raw: 7, all: 2n ** 60n }, root, resolve),
    { none: bytes, one: "AAEC", raw: 7, all: 2n ** 60n });
  assert.equal(withBytes(null, true, resolve), null);
  assert.throws(() => withBytes({ raw: "b%" }, root, resolve), /"b%" is not base64/);
});

test("long bytes are shortened where they are shown, and whole where they are edited", () => {
  const bytes = new Uint8Array(1000);
  assert.equal(textOf(bytes), `"${"A".repeat(64)}…" (1000 bytes)`);
  assert.equal(textOf(bytes, { whole: true }).length, 2 + 1336);
  assert.equal(textOf(Uint8Array.of(0, 1, 2)), '"AAEC"');
});
