/** The list of servers, of the workers of fleets, and of schedules: state, room, goals and limits. */

import { arrange, h, setText, show } from "./dom.js";
import { counted, durationOf, linkTo, timeOf } from "./goal_text.js";

/** One row of a table, whose cells keep their places. */
class Row {
  constructor(name, href, count) {
    this.name = href ? h("a", { href }, name) : h("span", {}, name);
    this.badge = h("span", { class: "badge" });
    this.cells = Array.from({ length: count }, () => h("td"));
    this.element = h("tr", {}, h("th", { scope: "row" }, this.name), h("td", {}, this.badge), ...this.cells);
  }

  update(state, className, ...texts) {
    this.badge.className = `badge ${className}`;
    setText(this.badge, state);
    this.cells.forEach((cell, index) => setText(cell, texts[index]));
  }
}

function tableOf(caption, names) {
  const body = h("tbody");
  const head = h("thead", {}, h("tr", {}, ...names.map((name) => h("th", { scope: "col" }, name))));
  return [h("table", { class: "servers cards" }, h("caption", { class: "hidden-text" }, caption), head, body), body];
}

export class ServersPage {
  constructor(store) {
    this.store = store;
    this.rows = new Map();
    const [table, body] = tableOf("Servers", ["Server", "State", "Address", "Goals", "Actions", "Version"]);
    const [fleet, workers] = tableOf("Workers", ["Worker", "Room", "Server", "Goals", "Joined", "Version", "Actions"]);
    const [schedules, limits] = tableOf("Schedules", ["Action", "State", "Schedule"]);
    Object.assign(this, { body, workers, limits });
    this.schedules = h("section", { class: "card", "aria-label": "Schedules" }, h("h2", {}, "Schedules"), schedules);
    this.fleet = h("section", { class: "card", "aria-label": "Workers" }, h("h2", {}, "Workers"), fleet);
    const servers = h("section", { class: "card", "aria-label": "Servers" }, table);
    this.element = h("div", { class: "page" }, h("div", { class: "title" }, h("h1", {}, "Servers")), servers, this.fleet, this.schedules);
  }

  update() {
    const { servers } = this.store;
    arrange(this.body, servers.map((server) => this.serverRow(server)));
    const workers = servers.flatMap((server) => server.workers.map((worker) => this.workerRow(server, worker)));
    show(this.fleet, workers.length > 0);
    arrange(this.workers, workers);
    show(this.schedules, this.store.schedules.size > 0);
    arrange(this.limits, [...this.store.schedules].map((told) => this.scheduleRow(...told)));
  }

  row(key, ...how) {
    const row = this.rows.get(key) ?? new Row(...how);
    this.rows.set(key, row);
    return row;
  }

  serverRow({ name, url, actions, away, version }) {
    const row = this.row(name, name || url, name ? linkTo(name) + "/" : "#/", 4);
    const active = [...this.store.goals.values()].filter((goal) => goal.isActive && actions.includes(goal.action));
    const own = this.store.ownAway; // then nothing tells what has become of the servers
    const state = own ? `not known since ${timeOf(own.since)}` : away ? `away since ${timeOf(away.since * 1000)}` : "connected";
    row.update(state, own || away ? "away" : "succeeded", url, counted(active.length, "active goal"), counted(actions.length, "action"), version ?? "");
    row.element.title = (own ?? away)?.reason ?? "";
    return row.element;
  }

  workerRow(server, { name, actions, since, goals, has_room: hasRoom, version }) {
    const row = this.row(`${server.name}/${name}`, name, "", 5);
    const joined = `${durationOf((Date.now() - since / 1e6) / 1000)} ago`;
    const [state, className] = this.store.ownAway || server.away ? ["not known", "away"] : hasRoom ? ["has room", "succeeded"] : ["full", "accepted"];
    row.update(state, className, server.name || server.url, counted(goals, "goal"), joined, version, [...actions].sort().join(", "));
    return row.element;
  }

  scheduleRow(name, text) {
    const row = this.row(`#${name}`, name, linkTo(name), 1);
    const mode = this.store.intakes.get(name)?.mode;
    const state = this.store.awayOf(name) ? "away" : mode ? (mode === "drain" ? "drains" : "paused") : "takes goals";
    row.update(state, state === "away" ? "away" : mode ? "accepted" : "succeeded", text);
    return row.element;
  }

  tellMissing() {}
}
