// An imitation of React, as far as the hook of the page needs it: one component that renders again
// when its state has changed.

let rendered;

function slot(make) {
  const { slots } = rendered;
  rendered.at += 1;
  return (slots[rendered.at] ??= make(rendered));
}

export const useRef = (value) => slot(() => ({ current: value }));

export function useState(value) {
  const state = slot((root) => ({
    value,
    set: (next) => {
      state.value = next;
      root.schedule();
    },
  }));
  return [state.value, state.set];
}

export function useEffect(effect, needs) {
  const kept = slot(() => ({}));
  if (kept.needs?.every((one, index) => one === needs[index])) return;
  rendered.effects.push(() => {
    kept.clean?.();
    kept.clean = effect();
  });
  kept.needs = needs;
}

export const jsx = (type, props) => ({ type, props });
export const jsxs = jsx;
export const Fragment = "fragment";

/** A component on the screen. */
export class Root {
  slots = [];
  waiting = [];
  renders = 0;

  constructor(component, props) {
    Object.assign(this, { component, props });
    this.render();
  }

  render() {
    rendered = this;
    this.at = -1;
    this.effects = [];
    this.tree = this.component(this.props);
    this.effects.forEach((effect) => effect());
    this.renders += 1;
    this.waiting.splice(0).forEach((resolve) => resolve());
  }

  schedule() {
    if (this.isScheduled || this.isRemoved) return;
    this.isScheduled = true;
    queueMicrotask(() => {
      this.isScheduled = false;
      if (!this.isRemoved) this.render();
    });
  }

  remove() {
    this.isRemoved = true;
    this.slots.forEach(({ clean }) => clean?.());
  }

  /** Wait until a condition holds after a render. */
  async until(condition) {
    while (!condition()) await new Promise((resolve) => this.waiting.push(resolve));
  }

  /** Return the text of all elements of a type. */
  text(type, node = this.tree) {
    const children = [node?.props?.children].flat();
    const isInside = node?.type === type;
    const texts = children.map((one) => (one?.type ? this.text(type, one) : isInside ? one ?? "" : ""));
    return texts.join("");
  }

  /** Press the button with a text. */
  press(text, node = this.tree) {
    if (node?.type === "button" && node.props.children === text) node.props.onClick();
    [node?.props?.children].flat().forEach((one) => one?.type && this.press(text, one));
  }
}
