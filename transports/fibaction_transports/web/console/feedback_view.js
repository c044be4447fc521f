/** The numbers, places and images in the feedback of one goal, or in the messages of a topic. */

import { shapeOf } from "./action_shape.js";
import { Chart, Cursor } from "./chart.js";
import { h, show } from "./dom.js";
import { Images } from "./images.js";
import { Planes } from "./plane.js";

export class FeedbackView {
  constructor(record, of = "feedback") {
    const { places, images } = shapeOf(record.info);
    this.record = record;
    this.series = record.series;
    this.cursor = new Cursor(() => this.moveCursor());
    this.charts = record.series.charts.map((chart) => new Chart(chart, this.cursor));
    this.planes = new Planes(places);
    this.images = new Images(images.feedback, of);
    let charts = h("div", { class: "charts" }, ...this.charts.map((chart) => chart.element));
    if (of === "topic" && (places.feedback.length || images.feedback.length)) { // which say more
      charts = h("details", { ontoggle: () => this.update(this.record) }, h("summary", {}, "Charts"), charts);
    }
    this.element = h("div", {}, this.planes.element, h("div", { class: "beside" }, charts, this.images.element));
  }

  /** Show what there is now. */
  update(record) {
    this.record = record;
    this.planes.update(record);
    for (const chart of this.charts) {
      show(chart.element, chart.chart.lines.some((line) => line.times.length));
      chart.draw();
    }
    this.showImages();
  }

  moveCursor() {
    this.charts.forEach((chart) => chart.draw());
    this.showImages();
  }

  /** Show the images as they were at the cursor of the charts. */
  showImages() {
    const { record, cursor } = this;
    const isThere = ([time]) => cursor.at !== null && (time - record.sentAt) / 1000 <= cursor.at;
    this.images.show(record.lines.findLast(isThere)?.[1] ?? record.feedback);
  }
}
