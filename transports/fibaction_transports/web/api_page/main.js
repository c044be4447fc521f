/** The page of the REST interface: all operations of openapi.json, to read and to send. */
import { announce, h, show } from "../console/dom.js";
import { setUpTheme } from "../console/theme.js";
import { operationView } from "./operation.js";

const METHODS = ["get", "post", "put", "delete"];
const content = document.getElementById("content");
const token = h("input", { id: "token", type: "password", autocomplete: "off" });
const access = {
  /** The address below which the paths are. */
  root: new URL(".", location.href).href.replace(/\/$/, ""),
  headers: () => (token.value ? { Authorization: `Bearer ${token.value}` } : {}),
  hasToken: () => token.value !== "",
};

async function load() {
  const response = await fetch("openapi.json", { headers: access.headers() });
  if (response.status === 401) {
    askForToken(token.value ? "The server rejected this token." : "");
    return;
  }
  if (!response.ok) throw new Error(`openapi.json: ${response.status} ${response.statusText}`);
  showAll(await response.json());
}

function askForToken(problem) {
  const submitted = (event) => {
    event.preventDefault();
    start();
  };
  const alert = problem ? h("p", { class: "error", role: "alert" }, problem) : null;
  const form = h("form", { class: "card", onsubmit: submitted },
    h("div", { class: "field" }, h("label", { for: "token" }, "Token"), token),
    h("p", { class: "note" }, "The server asks for a token. The page forgets it when you leave."),
    alert, h("div", { class: "buttons" }, h("button", { class: "main" }, "Continue")));
  content.replaceChildren(h("h1", {}, "REST interface"), form);
  token.focus();
}

function showAll(description) {
  const groups = new Map();
  for (const operation of operationsOf(description)) {
    const name = groupOf(operation);
    groups.set(name, [...(groups.get(name) ?? []), operation]);
  }
  const sections = [...groups].map(([name, operations]) => {
    const views = operations.map((one) => [one, operationView(one, description, access)]);
    const section = h("section", {}, h("h2", {}, name), ...views.map(([, view]) => view));
    return { section, views };
  });
  const filter = h("input", {
    type: "search", placeholder: "Filter by path or summary", "aria-label": "Filter operations",
    oninput: () => filterBy(filter.value.trim().toLowerCase(), sections),
  });
  const { title = "REST interface", version = "" } = description.info ?? {};
  content.replaceChildren(
    h("div", { class: "title" }, h("h1", {}, title), h("code", {}, `version ${version}`)),
    h("div", { class: "tools" }, filter),
    ...sections.map((one) => one.section),
  );
}

/** Return all operations, with their methods and paths, and the parameters of their paths. */
export function operationsOf(description) {
  return Object.entries(description.paths ?? {}).flatMap(([path, item]) =>
    METHODS.filter((method) => item[method]).map((method) => ({
      ...item[method], method, path,
      parameters: [...(item.parameters ?? []), ...(item[method].parameters ?? [])],
    })),
  );
}

function groupOf({ path }) {
  const found = /^\/actions\/(.+?)(?:\/goals(?:\/\{goal_id\}(?:\/events)?)?)?$/.exec(path);
  return found ? decodeURIComponent(found[1]) : "All actions";
}

function filterBy(words, sections) {
  let count = 0;
  for (const { section, views } of sections) {
    let found = 0;
    for (const [{ method, path, summary = "" }, view] of views) {
      const isFound = `${method} ${path} ${summary}`.toLowerCase().includes(words);
      show(view, isFound);
      found += isFound ? 1 : 0;
    }
    show(section, found > 0);
    count += found;
  }
  announce(`${count} operations`);
}

function start() {
  load().catch((error) => {
    content.replaceChildren(h("p", { class: "error", role: "alert" }, String(error)));
  });
}

setUpTheme(document.getElementById("theme"));
start();
