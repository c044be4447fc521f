/** What a page is about: all actions, those of a namespace such as `arm/`, or one action. */

/** Return whether an action is in a scope: the text is empty, a namespace with a slash, or a name. */
export function isWithin(name, scope) {
  return !scope || name === scope || (scope.endsWith("/") && bare(name).startsWith(bare(scope)));
}

/** Return the namespaces that a list shows: those of servers, and those of several actions. */
export function namespacesOf(names, servers) {
  const counts = new Map();
  for (const name of names) {
    const [first, ...rest] = bare(name).split("/");
    if (rest.length) {
      counts.set(first, (counts.get(first) ?? 0) + 1);
    }
  }
  const isServer = (name) => servers.some((server) => server.name === name);
  const found = [...counts].filter(([name, count]) => count > 1 || isServer(name)).map(([name]) => name);
  return [...new Set([...found, ...servers.map(({ name }) => name).filter(Boolean)])].sort().map((name) => `${name}/`);
}

/** Return a name as it is shown, without the slash that ROS has in front. */
function bare(name) {
  return name.startsWith("/") ? name.slice(1) : name;
}
