// Keyboard shortcuts of the page; those of the two panes are in hands.js.

const $ = (id) => document.getElementById(id);
const TOOLS = { v: "move", p: "pin", c: "corner", s: "seam", e: "erase", x: "forbid", t: "stitch", d: "draw" };
// Fields in which keys write text.
const TEXT = "input:not([type=radio], [type=checkbox], [type=file]), textarea, [contenteditable]";

export function listenForKeys(panel) {
  const { page } = panel;
  document.addEventListener("keydown", (event) => {
    if (event.target.closest?.(TEXT) || $("keys").open) return;
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey) {
      if (key === "z") page.send({ do: event.shiftKey ? "redo" : "undo" });
      else if (key === "y") page.send({ do: "redo" });
      else if (key === "s") page.send({ do: "save" });
      else if (key === "o") $("open").click();
      else return;
    } else if (event.altKey || event.target.closest?.("select")) return;
    else if (event.key === "?") $("keys").showModal();
    else if (TOOLS[key]) panel.tool(TOOLS[key]);
    else if (key === "u") panel.unwrap();
    else return;
    event.preventDefault();
  });
}
