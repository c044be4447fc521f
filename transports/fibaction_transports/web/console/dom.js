/** Helpers to build the page. Text always becomes text, and never HTML. */

const STEPS_OF_PROGRESS = 200;

/** Return a new element; `on...` are listeners, the other properties are attributes. */
export function h(tag, properties = {}, ...children) {
  return fill(document.createElement(tag), properties, children);
}

/** Return a new element of SVG. */
export function svg(tag, properties = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", tag), properties, children);
}

function fill(element, properties, children) {
  for (const [name, value] of Object.entries(properties)) {
    if (typeof value === "function") {
      element.addEventListener(name.slice(2), value);
    } else if (value === true) {
      element.setAttribute(name, "");
    } else if (value !== false && value !== null && value !== undefined) {
      element.setAttribute(name, value);
    }
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

/** Return a new button. */
export function button(text, onclick, properties = {}) {
  return h("button", { type: "button", onclick, ...properties }, text);
}

/** Return a place for the text of an error, which `tellError` tells. */
export function errorPlace() {
  return h("p", { class: "error", role: "alert", hidden: true });
}

/** Tell an error, or none any more if the text is empty. */
export function tellError(place, text) {
  place.textContent = text;
  show(place, Boolean(text));
}

/** Mark a link as the one to what is shown, or as another. */
export function markCurrent(link, isCurrent, how = "true") {
  if (link.getAttribute("aria-current") !== (isCurrent ? how : null)) {
    if (isCurrent) {
      link.setAttribute("aria-current", how);
    } else {
      link.removeAttribute("aria-current");
    }
  }
}

/** Replace the text of an element, if it is another one. */
export function setText(element, text) {
  if (element.textContent !== text) {
    element.textContent = text;
  }
}

/** Show or hide an element. */
export function show(element, isShown) {
  if (element.hidden === isShown) {
    element.hidden = !isShown;
  }
}

/** Let a bar show a progress, in steps that can be seen: each makes the browser lay out its parts. */
export function setProgress(bar, progress) {
  const value = Math.round(progress * STEPS_OF_PROGRESS) / STEPS_OF_PROGRESS;
  if (bar.value !== value) {
    bar.value = value;
  }
}

/** Put these elements into a parent, in this order, and move only those that are elsewhere. */
export function arrange(parent, elements) {
  elements.forEach((element, index) => {
    if (parent.children[index] !== element) {
      parent.insertBefore(element, parent.children[index] ?? null);
    }
  });
  while (parent.children.length > elements.length) {
    parent.lastElementChild.remove();
  }
}

/** Tell a screen reader what has happened. */
export function announce(text) {
  document.getElementById("announcer").textContent = text;
}
