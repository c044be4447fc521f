/** One operation of the interface: its parameters, its answers, and the way to send it. */
import { announce, h } from "../console/dom.js";
import { defaultOf, resolverOf } from "../console/schema.js";
import { schemaText, target } from "./schema.js";

const MOST_SHOWN = 100_000; // characters of an answer

/** Return an element that shows an operation, and builds the rest of itself when it is opened. */
export function operationView(operation, description, access) {
  const { method, path, summary = "" } = operation;
  const place = h("div");
  const head = h(
    "summary", {},
    h("span", { class: `method ${method}` }, method.toUpperCase()),
    h("code", {}, path),
    h("span", { class: "summary" }, summary),
  );
  const opened = () => {
    if (view.open && !place.hasChildNodes()) place.append(...parts(operation, description, access));
  };
  const view = h("details", { class: "operation", ontoggle: opened }, head, place);
  return view;
}

function parts(operation, description, access) {
  const given = (operation.parameters ?? []).map((one) => target(one, description));
  const fields = given.map((one, number) => field(one, operation, number, description));
  const media = target(operation.requestBody, description).content?.["application/json"];
  const body = media && bodyField(operation, media, description);
  const made = [];
  if (operation.description) made.push(h("p", {}, operation.description));
  if (fields.length) made.push(h("h3", {}, "Parameters"), ...fields.map((one) => one.view));
  if (body) made.push(h("h3", {}, "Body"), body.view, text(schemaText(media.schema, description)));
  made.push(...sender(operation, fields, body, access));
  made.push(h("h3", {}, "Answers"), answers(operation, description));
  return made;
}

function field(parameter, operation, number, description) {
  const id = `${operation.operationId ?? operation.path}.${operation.method}.${number}`;
  const input = h("input", { id, type: "text", autocomplete: "off", spellcheck: "false" });
  const mark = parameter.required ? h("span", { class: "required", title: "required" }, " *") : null;
  const kind = schemaText(parameter.schema ?? {}, description);
  const note = [parameter.in, kind, parameter.description].filter(Boolean).join(" · ");
  const view = h("div", { class: "field" },
    h("label", { for: id }, parameter.name, mark), input, h("small", {}, note));
  return { parameter, input, view };
}

function bodyField(operation, { schema, example }, description) {
  const label = `Body of ${operation.method.toUpperCase()} ${operation.path}`;
  const view = h("textarea", { "aria-label": label, spellcheck: "false" });
  const start = example ?? defaultOf(schema, resolverOf(description));
  view.value = JSON.stringify(start, null, 2);
  return { view };
}

function answers(operation, description) {
  const list = Object.entries(operation.responses ?? {}).map(([status, one]) => {
    const answer = target(one, description);
    const content = Object.entries(answer.content ?? {}).map(([kind, { schema = {} } = {}]) =>
      h("details", {}, h("summary", {}, kind), text(schemaText(schema, description))));
    return h("li", {}, h("b", {}, status), ` ${answer.description ?? ""}`, ...content);
  });
  return h("ul", { class: "answers" }, ...list);
}

function text(content) {
  return h("pre", { tabindex: "0" }, content);
}

// To send

function sender(operation, fields, body, access) {
  const send = h("button", { class: "main", type: "button", onclick: () => start() }, "Send");
  const stop = h("button", { type: "button", hidden: true, onclick: () => ended?.abort() }, "Stop");
  const command = text("");
  const status = h("p", { class: "note", role: "status" });
  const answer = h("pre", { class: "body", tabindex: "0", "aria-label": "Answer" });
  const shown = h("div", { hidden: true }, h("h3", {}, "With curl"), command,
    h("h3", {}, "Answer"), status, answer);
  let ended = null;

  async function start() {
    const request = requestOf(operation, fields, body, access);
    shown.hidden = false;
    answer.textContent = "";
    command.textContent = curlOf(request);
    if (request.problem) {
      status.textContent = request.problem;
      return;
    }
    ended = new AbortController();
    send.disabled = true;
    stop.hidden = false;
    status.textContent = "sent";
    try {
      await tell(request, access, ended.signal, status, answer);
    } catch (error) {
      status.textContent = ended.signal.aborted ? `${status.textContent}, stopped` : String(error);
    }
    announce(status.textContent);
    send.disabled = false;
    stop.hidden = true;
  }

  return [h("div", { class: "buttons" }, send, stop), shown];
}

async function tell(request, access, signal, status, answer) {
  const headers = { ...request.headers, ...access.headers() };
  const { method, body } = request;
  const response = await fetch(request.url, { method, headers, body, signal });
  const place = response.headers.get("location");
  status.textContent = [`${response.status} ${response.statusText}`.trim(), place].filter(Boolean)
    .join(" · ");
  const decoder = new TextDecoder();
  let all = "";
  for (const reader = response.body?.getReader(); reader; ) {
    const { done, value } = await reader.read();
    if (done) break;
    all = (all + decoder.decode(value, { stream: true })).slice(-MOST_SHOWN);
    answer.textContent = all;
  }
  answer.textContent = pretty(all);
}

function pretty(all) {
  try {
    return JSON.stringify(JSON.parse(all), null, 2);
  } catch {
    return all; // not JSON, or only the end of it
  }
}

/** Return the request that the fields make; with a `problem` if one of them is missing. */
export function requestOf(operation, fields, body, access) {
  let { path } = operation;
  const query = new URLSearchParams();
  const headers = {};
  let problem = "";
  for (const { parameter, input } of fields) {
    const value = input.value.trim();
    if (value === "") {
      if (parameter.required) problem = `${parameter.name} is missing`;
    } else if (parameter.in === "path") {
      path = path.replaceAll(`{${parameter.name}}`, encodeURIComponent(value));
    } else if (parameter.in === "query") {
      query.set(parameter.name, value);
    } else if (parameter.in === "header") {
      headers[parameter.name] = value;
    }
  }
  if (body) {
    headers["Content-Type"] = "application/json";
    problem ||= jsonProblem(body.view.value);
  }
  const address = [...query].length ? `${path}?${query}` : path;
  return {
    method: operation.method.toUpperCase(), url: access.root + address, headers,
    body: body?.view.value, problem, hasToken: access.hasToken(),
  };
}

function jsonProblem(content) {
  try {
    JSON.parse(content);
    return "";
  } catch (error) {
    return `the body is not JSON: ${error.message}`;
  }
}

/** Return the request as a command for a shell; the token is a variable there. */
export function curlOf({ method, url, headers, body, hasToken }) {
  const quoted = (value) => `'${String(value).replaceAll("'", "'\\''")}'`;
  const words = ["curl", "-X", method, quoted(url)];
  if (hasToken) words.push("-H", '"Authorization: Bearer $TOKEN"');
  for (const [name, value] of Object.entries(headers)) words.push("-H", quoted(`${name}: ${value}`));
  if (body !== undefined) words.push("-d", quoted(body));
  return words.join(" ");
}
