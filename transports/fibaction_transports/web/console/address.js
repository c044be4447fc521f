/** The address of the page: the server, the token in the fragment, and the goal that is shown. */

const TOKEN = "fibaction:token";

/** Return the address of the server that the page came from. */
export function serverAddress() {
  const url = new URL("./", window.location.href);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  url.hash = url.search = "";
  return url.href;
}

/**
 * Return the token of `#token=...`, and remove it from the address, so that it is not shown or
 * copied. It lasts as long as the tab.
 */
export function takeToken() {
  const found = /^#token=([^&]*)&?(.*)$/.exec(window.location.hash);
  if (found) {
    keepToken(decodeURIComponent(found[1]));
    window.history.replaceState(null, "", `#${found[2] || "/"}`);
  }
  try {
    return sessionStorage.getItem(TOKEN) ?? "";
  } catch {
    return found ? decodeURIComponent(found[1]) : "";
  }
}

/** Keep a token for as long as the tab lasts. */
export function keepToken(token) {
  try {
    sessionStorage.setItem(TOKEN, token);
  } catch {
    // The browser keeps nothing: the token is asked for again.
  }
}

/**
 * Return the action and the goal in the fragment, and the choice of goals: `#/arm/drive/5fda41e0`,
 * or `#/arm/drive?client=ann`. An action may have the name of what looks like a goal, so the known
 * names count first.
 */
export function shownIn(fragment, actions) {
  const [, address, query] = /^#?\/?([^?]*)(.*)$/.exec(fragment);
  const path = address.split("/").map(decodeURIComponent).join("/");
  const found = !actions.has(path) && /^(.*)\/([0-9a-f]{8,32})$/.exec(path);
  return found ? { action: found[1], goal: found[2], query } : { action: path, goal: "", query };
}
