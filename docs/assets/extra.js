// Two helps for readers: buttons copy the commands of a session, and pictures open at full size.
"use strict";

/** Return the commands of a shell session, without prompts and without output. */
function commandsOf(session) {
  const commands = [];
  for (const line of session.split("\n")) {
    const begun = commands.at(-1)?.endsWith("\\");
    if (line.startsWith("$ ")) commands.push(line.slice(2));
    else if (begun) commands.push(line);
  }
  return commands.join("\n");
}

document.addEventListener("DOMContentLoaded", () => {
  for (const code of document.querySelectorAll(".language-console code")) {
    code.dataset.copy = commandsOf(code.textContent);
  }
  for (const picture of document.querySelectorAll("article img")) {
    if (picture.closest("a")) continue;
    const link = document.createElement("a");
    link.className = "picture";
    link.href = picture.src;
    link.title = "Open the picture at its full size";
    picture.replaceWith(link);
    link.append(picture);
  }
});
