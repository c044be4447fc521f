/** One goal: what was sent beside its result, its feedback as charts and text, and its cancel. */

import { shapeOf } from "./action_shape.js";
import { Comparison } from "./comparison.js";
import { button, h, setProgress, setText, show } from "./dom.js";
import { FeedbackView } from "./feedback_view.js";
import { GoalFamily } from "./goal_family.js";
import { labelsOf } from "./goal_filter.js";
import { GoalLog } from "./goal_log.js";
import { Images } from "./images.js";
import { counted, durationOf, shortId, showBadge, timeOf } from "./goal_text.js";
import { Topics } from "./topics.js";
import { textOf } from "./values.js";

const A_LINE = 24;

export class GoalView {
  constructor(record, { store, oncancel, onagain, onretry, onrerun, onlabel }) {
    this.store = store;
    this.mayUseAgain = Boolean(onagain);
    this.family = new GoalFamily(store);
    this.badge = h("span", { class: "badge" });
    this.facts = h("p", { class: "facts" });
    this.reason = h("p", { class: "reason" });
    this.bar = h("progress", { max: 1, "aria-label": "Progress" });
    this.goal = h("pre", { tabindex: 0, "aria-label": "Goal" });
    this.result = h("pre", { tabindex: 0, "aria-label": "Result" });
    this.latest = h("pre", { tabindex: 0, "aria-label": "Latest feedback" });
    this.text = h("pre", { tabindex: 0, "aria-label": "Text of the feedback", class: "text" });
    this.lines = h("pre", { tabindex: 0, "aria-label": "Feedback messages", class: "lines" });
    const redraw = () => this.updateFeedback(this.record);
    this.log = h("details", { ontoggle: redraw }, h("summary", {}, "Messages"), this.lines);
    this.feedbackTitle = h("h3", {}, "Feedback");
    this.shown = h("div", {});
    this.lineLog = new GoalLog(store);
    this.checkpoint = h("pre", { tabindex: 0, "aria-label": "Checkpoint" });
    this.kept = h("div", {}, h("h3", {}, "Checkpoint"), this.checkpoint);
    this.goalImages = h("div", {});
    this.resultImages = h("div", {});
    this.cancel = button("Cancel goal", () => oncancel(this.record), { class: "danger" });
    this.again = button("Use as new goal", () => onagain(this.record), { class: "quiet" });
    this.retry = button("Send again", () => onretry(this.record), { class: "quiet" });
    this.rerun = button("Run again from its checkpoint", () => onrerun(this.record), { class: "quiet" });
    this.compare = button("Compare", () => this.setBasis(this.record.key), { class: "quiet" });
    this.find = button("Find in a recording", () => document.getElementById("open").click(), { class: "quiet", hidden: store.isRecording });
    this.comparison = new Comparison({ onstop: () => this.setBasis("") });
    this.labels = h("p", { class: "labels" });
    this.onlabel = onlabel;
    this.feedback = h("div", { class: "feedback" }, this.feedbackTitle, this.shown, this.text, this.latest, this.log);
    this.element = h(
      "section",
      { class: "card goal", "aria-label": "Goal" },
      h("header", {}, h("h2", {}, "Goal ", h("code", {}, shortId(record.id))), this.badge, h("span", { class: "space" }), this.cancel),
      this.facts,
      this.labels,
      h("div", { class: "links" }, this.again, this.compare, this.find, this.retry, this.rerun),
      this.comparison.element,
      this.family.element,
      this.bar,
      this.reason,
      h("div", { class: "pair" }, h("div", {}, h("h3", {}, "Goal"), this.goal, this.goalImages), h("div", {}, h("h3", {}, "Result"), this.result, this.resultImages)),
      this.kept,
      this.feedback,
      this.lineLog.element,
      new Topics(store, record.info).element,
    );
    this.take(record);
  }

  take(record) {
    this.record = record;
    this.view = new FeedbackView(record);
    this.shown.replaceChildren(this.view.element);
    const { images } = shapeOf(record.info);
    this.images = [["goal", this.goalImages], ["result", this.resultImages]].map(([of, place]) => {
      const views = new Images(images[of], of);
      place.replaceChildren(views.element);
      return [of, views];
    });
  }

  /** Compare with a goal from now on; with none if the key is empty. */
  setBasis(key) {
    this.store.basis = key;
    this.store.change();
    this.compare.focus();
  }

  /** Show the labels, as buttons that list the goals of each. */
  updateLabels(record) {
    const labels = labelsOf(record);
    show(this.labels, labels.length > 0);
    if (labels.join() !== this.shownLabels) {
      this.shownLabels = labels.join();
      this.labels.replaceChildren("Labels: ", ...labels.map((label) => button(label, () => this.onlabel(label), { class: "quiet", title: "List the goals of this label" })));
    }
  }

  /** Show the goal as it is now. */
  update(record) {
    if (record.series !== this.view.series) {
      this.take(record);
    }
    this.record = record;
    showBadge(this.badge, record);
    setText(this.facts, factsOf(record));
    this.updateLabels(record);
    this.comparison.update(this.store.goals.get(this.store.basis), record);
    this.family.update(record);
    this.lineLog.update(record);
    setText(this.reason, record.reason);
    show(this.reason, Boolean(record.reason));
    show(this.bar, record.progress !== null);
    setProgress(this.bar, record.status === "SUCCEEDED" ? 1 : (record.progress ?? 0));
    setText(this.goal, record.goal === undefined ? "not known" : textOf(record.goal));
    setText(this.result, resultOf(record));
    show(this.cancel, record.isActive && record.status !== "CANCELING");
    const isKnown = this.mayUseAgain && record.goal !== undefined;
    show(this.again, isKnown);
    show(this.retry, isKnown && !record.isActive && Boolean(record.info));
    this.updateCheckpoint(record);
    this.images.forEach(([of, images]) => images.show(record[of]));
    this.updateFeedback(record);
  }

  /** Show the checkpoint of a goal that was given up, and let it run again from there. */
  updateCheckpoint(record) {
    if (this.mayUseAgain && record.status === "ABORTED") {
      this.store.askCheckpoint(record);
    }
    const isGivenUp = this.mayUseAgain && record.checkpoint !== undefined;
    show(this.rerun, isGivenUp);
    show(this.kept, isGivenUp);
    setText(this.checkpoint, isGivenUp ? (record.checkpoint === null ? "none: it begins anew" : textOf(record.checkpoint)) : "");
  }

  /** Show the text that the feedback is, and stay at its end unless the person has scrolled. */
  updateText({ text }) {
    show(this.text, text.pieces.length > 0);
    if (this.text.hidden) {
      return;
    }
    const isAtEnd = this.text.scrollHeight - this.text.scrollTop - this.text.clientHeight < A_LINE;
    setText(this.text, text.text);
    if (isAtEnd) {
      this.text.scrollTop = this.text.scrollHeight;
    }
  }

  updateFeedback(record) {
    const dropped = record.feedbackDropped ? `, ${record.feedbackDropped} dropped` : "";
    const kept = record.isListed ? ", not in the history" : "";
    setText(this.feedbackTitle, `Feedback: ${counted(record.feedbackCount, "message")}${dropped}${kept}`);
    this.updateText(record);
    show(this.latest, record.feedback !== undefined && !(record.text.path?.length === 0 && record.text.pieces.length));
    setText(this.latest, textOf(record.feedback));
    show(this.log, record.lines.length > 0);
    if (this.log.open) {
      const lines = record.lines.map(([time, value]) => `${((time - record.sentAt) / 1000).toFixed(3)} s  ${textOf(value).replace(/\s+/g, " ")}`);
      setText(this.lines, lines.reverse().join("\n"));
    }
    this.view.update(record);
  }
}

function resultOf(record) {
  if (record.result !== undefined) {
    return textOf(record.result);
  }
  return record.isActive ? "not there yet" : "none";
}

function factsOf(record) {
  const sender = record.isMine ? "this page" : record.client || "an unknown client";
  const facts = [record.action, `sent ${timeOf(record.sentAt)} by ${sender}`, durationOf(record.seconds()), record.worker && `worker ${record.worker}`, record.id];
  return facts.filter(Boolean).join(" · ");
}
