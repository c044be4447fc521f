// The declarations of the imitation: those of React in short.

export function useState<T>(value: T): [T, (next: T | ((before: T) => T)) => void];
export function useRef<T>(value: T): { current: T };
export function useEffect(effect: () => void | (() => void), needs: readonly unknown[]): void;
export function jsx(type: unknown, props: unknown): JSX.Element;
export { jsx as jsxs };
export const Fragment: (props: { children?: unknown }) => JSX.Element;

export namespace JSX {
  interface Element {
    type: unknown;
    props: unknown;
  }
  interface ElementChildrenAttribute {
    children: unknown;
  }
  interface IntrinsicElements {
    button: { onClick: () => unknown; children: string };
    p: { children?: string | undefined };
    pre: { children?: string | undefined };
  }
}
