/** The console: connects to the server that the page came from, and shows what the address says. */

import { Connection, decode } from "../fibaction.js";
import { ActionList } from "./action_list.js";
import { ActionPage } from "./action_page.js";
import { keepToken, serverAddress, shownIn, takeToken } from "./address.js";
import { askToken, showKeys } from "./dialogs.js";
import { h, setText, show } from "./dom.js";
import { linkTo } from "./goal_text.js";
import { History } from "./history.js";
import { MapPage } from "./map_page.js";
import { Notices } from "./notices.js";
import { RecordedStore } from "./recording.js";
import { Store } from "./store.js";
import { isWithin } from "./scope.js";
import { ServersPage } from "./servers_page.js";
import { showSettings } from "./settings.js";
import { setUpTheme } from "./theme.js";

const VIEWS = { "#servers": ServersPage, "#map": MapPage }; // in place of the page of an action
const TICK = 500;
const TICKS_OF_PLACES = 4;
const KEYS = [
  ["/", "Search actions"],
  ["Enter", "In a search: open the only match"],
  ["n", "Go to the form of a new goal"],
  ["Ctrl Enter", "Send the goal of the form"],
  ["j, k", "Next, previous goal"],
  ["c", "Cancel the goal that is shown"],
  ["+, −, ←, →, 0", "At a chart: zoom in, zoom out, move, show all"],
  ["+, −, ← → ↑ ↓, 0", "At a view from above: the same"],
  ["Esc", "Close the goal"],
  ["?", "Show these keys"],
];

class Console {
  constructor() {
    this.content = document.getElementById("content");
    this.status = document.getElementById("connection");
    const redraw = () => this.store.change();
    setUpTheme(document.getElementById("theme"), redraw);
    window.addEventListener("resize", redraw);
    document.getElementById("settings").addEventListener("click", () => showSettings(() => this.rewrite()));
    document.getElementById("help").addEventListener("click", () => showKeys(KEYS));
    document.getElementById("open").addEventListener("click", () => this.chooseRecording());
    window.addEventListener("dragover", (event) => event.preventDefault());
    window.addEventListener("drop", (event) => {
      event.preventDefault();
      this.openRecording(event.dataTransfer.files[0]);
    });
    document.querySelector(".skip").addEventListener("click", (event) => {
      event.preventDefault();
      this.content.focus();
    });
    this.page = null;
    this.notices = new Notices();
    this.query = "";
    this.ticks = 0;
    this.connect(takeToken());
    window.addEventListener("hashchange", () => this.update());
    window.addEventListener("keydown", (event) => this.press(event));
    setInterval(() => this.tick(), TICK);
  }

  /** Write all texts of the page again, such as times in another zone. */
  rewrite() {
    this.page = null;
    this.store.change();
  }

  connect(token) {
    const address = serverAddress();
    this.token = token;
    this.connection = new Connection(address, { token, onstate: (state) => this.takeState(state) });
    this.use(new Store(this.connection, new History(address), token));
  }

  /** Show what a store has from now on. */
  use(store) {
    if (this.store) {
      this.store.onchange = () => {};
    }
    this.page = null;
    this.store = store;
    this.store.onchange = () => this.update();
    this.actions = new ActionList(this.store);
    document.getElementById("actions").replaceChildren(...this.actions.elements);
    this.store.start();
    this.store.change();
  }

  /** Let a person choose the file of a recording; or close the one that is shown. */
  chooseRecording() {
    if (this.store.isRecording) {
      window.location.reload();
      return;
    }
    const input = h("input", { type: "file", accept: ".jsonl", onchange: () => this.openRecording(input.files[0]) });
    input.click();
  }

  /** Show a recording in place of the server. */
  openRecording(file, name = file?.name) {
    if (file) {
      this.store.state = "closed"; // it asks no more
      if (!this.store.shown.goal && file.name) { // else the goal is looked for in the recording
        window.location.hash = "#/";
      }
      setText(document.getElementById("open"), "Close");
      this.use(new RecordedStore(file, name, decode));
      this.connection.close(); // the end is not shown
    }
  }

  /** Show the recording that the server of the page has, if the address names it. */
  async openServed(name) {
    try {
      const answer = await this.store.ask("recording", null); // which may be large
      if (!answer.ok) {
        throw new Error(`the server answers with the status ${answer.status}`);
      }
      show(document.getElementById("open"), false);
      this.openRecording(await answer.blob(), name);
    } catch (error) {
      this.page.fail?.(`${name} cannot be read: ${error.message}`);
    }
  }

  takeState(state) {
    if (this.store.isRecording) {
      return;
    }
    const recording = new URLSearchParams(window.location.search).get("recording");
    if (state === "ready" && recording) {
      this.openServed(recording);
      return;
    }
    this.store.takeState(state);
    if (state === "closed") {
      this.connection.ready.catch((error) => this.takeEnd(error));
    }
  }

  /** Ask for another token if the server does not accept this one; else say why it is over. */
  async takeEnd(error) {
    if (error.name !== "AuthenticationFailed") {
      this.store.state = `disconnected: ${error.message}; reload the page`;
      this.store.change();
      return;
    }
    this.store.onchange = () => {};
    const token = await askToken(error.message);
    keepToken(token);
    this.connect(token);
  }

  /** Show the action and the goal in the address, or another view. */
  route() {
    const View = VIEWS[window.location.hash];
    this.store.view = View && window.location.hash;
    if (View) {
      if (!(this.page instanceof View)) {
        this.store.show("");
        this.place(new View(this.store), this.store.view.slice(1));
      }
      return;
    }
    const { action, goal, query } = shownIn(window.location.hash, this.store.actions);
    const record = goal && this.store.goalsOf(action).find((one) => one.id.startsWith(goal));
    const isSame = this.store.shown.action === action && this.store.shown.goal === (record?.key ?? "");
    if (!isSame) {
      this.store.show(action, record?.id);
    }
    if (goal && !record) {
      this.store.lookUp(action, goal);
    }
    const info = this.store.actions.get(action);
    const scope = info?.name ?? (action.endsWith("/") ? action : "");
    if (!this.page || this.page.info !== info || this.page.scope !== scope) {
      this.query = "";
      this.place(new ActionPage(this.store, info, scope, (chosen) => this.keepQuery(chosen)), scope);
    }
    if (query !== this.query) {
      this.query = query;
      this.page.list.filter.query = query;
    }
  }

  /** Show a page. */
  place(page, name) {
    this.page = page;
    this.content.replaceChildren(page.element);
    document.title = name ? `${name} · fibaction console` : "fibaction console";
    this.notices.mark();
  }

  /** Put the choice of goals into the address. */
  keepQuery(query) {
    this.query = query;
    window.history.replaceState(null, "", (window.location.hash.split("?")[0] || "#/") + query);
  }

  /** Return what the address names and the server does not have; empty if all is there. */
  missing() {
    const { action, goal } = shownIn(window.location.hash, this.store.actions);
    const { isDescribed, isRecording, state, actions, goals, shown } = this.store;
    if (!isDescribed && !isRecording) {
      return `There is no connection to ${window.location.host} yet. It is tried again.`;
    }
    if (!isDescribed || !(isRecording || state === "ready") || !action) {
      return "";
    }
    const where = isRecording ? "recording" : "server";
    if (action.endsWith("/") && [...actions.keys()].some((name) => isWithin(name, action))) {
      return "";
    }
    if (!actions.has(action)) {
      return `The ${where} has no action ${action}. The others are in the list.`;
    }
    if (!goal || goals.has(shown.goal)) {
      return "";
    }
    return isRecording ? `The recording has no goal ${goal} of ${action}.` : `The server knows no goal ${goal} of ${action}: it may have forgotten it.`;
  }

  update() {
    this.route();
    const words = { ready: "connected", lost: "connection lost, trying again" };
    const { state, away, silent } = this.store;
    const more = silent ? ", but the server does not answer" : away.size ? `, ${away.size === 1 ? "a server is" : "servers are"} away` : "";
    const isLess = state === "ready" && more;
    setText(this.status, (words[state] ?? state) + (isLess ? more : ""));
    const shown = isLess ? "lost" : state;
    if (this.status.dataset.state !== shown) {
      this.status.dataset.state = shown;
    }
    this.actions.update();
    this.page.update();
    this.page.tellMissing(this.missing());
    this.notices.update(this.store);
  }

  /** Let the times of active goals go on. */
  tick() {
    this.ticks += 1;
    if (!document.hidden && [...this.store.goals.values()].some((goal) => goal.isActive)) {
      if (this.ticks % TICKS_OF_PLACES === 0) {
        this.store.refreshPlaces();
      }
      this.store.change();
    }
  }

  press(event) {
    const isTyping = event.target.closest("input, textarea, select, dialog");
    if (event.key === "Escape" && isTyping && !event.target.closest("dialog")) {
      event.target.blur();
    }
    if (isTyping || event.ctrlKey || event.metaKey || event.altKey) {
      return;
    }
    const { action, goal } = this.store.shown;
    const record = this.store.goals.get(goal);
    const go = (address) => {
      window.location.hash = (address ?? "#/").slice(1);
    };
    const deeds = {
      "/": () => this.actions.search.focus(),
      n: () => this.page.focusForm?.(),
      j: () => go(this.page.list?.neighbour(1)),
      k: () => go(this.page.list?.neighbour(-1)),
      c: () => record?.isActive && this.page.cancel(record),
      "?": () => showKeys(KEYS),
      Escape: () => go((action ? linkTo(action) : "#/") + this.query),
    };
    if (deeds[event.key]) {
      event.preventDefault();
      deeds[event.key]();
    }
  }
}

new Console();
