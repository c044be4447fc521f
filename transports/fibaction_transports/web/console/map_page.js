/** All robots on one map: where each of them was when its newest goal or its topic told. */

import { arrange, h, setText, show } from "./dom.js";
import { linkTo, stateOf, timeOf } from "./goal_text.js";
import { Ground } from "./ground.js";
import { Layer, Plane } from "./plane.js";
import { Topics } from "./topics.js";

/** One robot, by one place that it tells. */
class Robot extends Layer {
  constructor(record, trail, index) {
    super("feedback", trail.place, index);
    this.record = record;
    this.label = record.action;
    this.link = h("a", { href: record.id ? linkTo(record.action, record.id) : null }, record.action);
    this.badge = h("span", {});
    this.time = h("td");
    this.key = h("tr", {}, h("th", { scope: "row" }, h("span", { class: `key line-${index % 6}` }), this.link), h("td", {}, this.value), h("td", {}, this.badge), this.time);
  }

  take(_) {
    super.take(this.record);
    const { record } = this;
    setText(this.badge, record.id ? stateOf(record) : "topic");
    const [last] = record.lines.at(-1) ?? [record.endedAt || record.sentAt];
    setText(this.time, timeOf(last));
  }
}

export class MapPage {
  constructor(store) {
    this.store = store;
    this.robots = new Map();
    this.planes = new Map();
    this.ground = new Ground(() => this.store.change());
    this.topics = new Topics(store, { name: "#map", goal: {} });
    this.search = h("input", { type: "search", placeholder: "Search robots", "aria-label": "Search robots", oninput: () => this.update() });
    this.place = h("div", { class: "charts maps" });
    this.body = h("tbody");
    this.none = h("p", { class: "note" }, "No goal and no topic here has told a position.");
    const head = h("thead", {}, h("tr", {}, ...["Robot", "Position", "State", "Told at"].map((name) => h("th", { scope: "col" }, name))));
    const table = h("table", { class: "servers cards" }, h("caption", { class: "hidden-text" }, "Robots"), head, this.body);
    const map = h("section", { class: "card", "aria-label": "Map" }, h("div", { class: "tools" }, this.search), this.place, this.none, this.ground.element);
    this.element = h("div", { class: "page" }, h("div", { class: "title" }, h("h1", {}, "Map")), map, h("section", { class: "card", "aria-label": "Robots" }, table, this.topics.element));
  }

  update() {
    const words = this.search.value.toLowerCase();
    const newest = new Map();
    for (const record of [...this.topics.records, ...this.store.goalsOf("")]) {
      for (const trail of record.trails.filter(({ latest }) => latest)) {
        const key = `${record.action} ${trail.place.name}`;
        if (!newest.has(key) && record.action.toLowerCase().includes(words)) {
          newest.set(key, this.robotOf(key, record, trail));
        }
      }
    }
    this.draw([...newest.values()].sort((one, other) => one.label.localeCompare(other.label)));
  }

  robotOf(key, record, trail) {
    const known = this.robots.get(key);
    const robot = known?.record === record && known.place === trail.place ? known : new Robot(record, trail, known?.index ?? this.robots.size);
    this.robots.set(key, robot);
    return robot;
  }

  draw(robots) {
    for (const plane of this.planes.values()) {
      plane.layers = [];
    }
    for (const robot of robots) {
      const { axes, unit } = robot.place;
      const key = `${axes} ${unit}`;
      const plane = this.planes.get(key) ?? new Plane(axes, unit, { ground: axes === "plane" ? this.ground : null, isLarge: true });
      this.planes.set(key, plane);
      plane.layers.push(robot);
    }
    arrange(this.place, [...this.planes.values()].map((plane) => plane.element));
    this.planes.forEach((plane) => plane.update(null));
    arrange(this.body, robots.map((robot) => robot.key));
    show(this.none, robots.length === 0);
  }

  tellMissing() {}
}
