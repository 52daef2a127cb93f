// The view in a notebook cell: the user's actions go to the kernel as custom messages, and the kernel returns frames.

import { decodeFrame, encodeFrame } from "./frames.js";
import { createView } from "./view.js";

const TOOLS = { move: "Move", pin: "Pin", seam: "Seam", erase: "Erase" };
const ACTIONS = { unwrap: "Unwrap", flatten: "Flatten", pack: "Pack", undo: "Undo", redo: "Redo" };
const COLOURINGS = { checker: "Checker", stretch: "Stretch", image: "Image" };
const TONES = { error: "var(--jp-error-color0, #b00020)", good: "inherit" };
// The colours of the notebook, for the view.
const COLOURS = {
  ink: "var(--jp-ui-font-color1, #1b2333)",
  paper: "var(--jp-layout-color0, #ffffff)",
  line: "var(--jp-border-color2, #d3d8e3)",
  grid: "var(--jp-border-color2, #dde1ea)",
  accent: "var(--jp-brand-color1, #1a56c4)",
};
const CONTROL = {
  minHeight: "32px",
  padding: "2px 10px",
  font: "13px sans-serif",
  color: COLOURS.ink,
  background: COLOURS.paper,
  border: `1px solid ${COLOURS.line}`,
  borderRadius: "4px",
  cursor: "pointer",
};

/** Called by anywidget for every cell that shows the widget; the returned function is called when the cell is gone. */
export function render({ model, el }) {
  const element = (tag, style = {}, attributes = {}) => {
    const one = Object.assign(document.createElement(tag), attributes);
    Object.assign(one.style, style);
    return one;
  };
  const box = element("div", { height: `${model.get("height")}px`, background: COLOURS.paper, border: `1px solid ${COLOURS.line}` });
  for (const [name, value] of Object.entries(COLOURS)) box.style.setProperty(`--${name}`, value);
  const line = element("div", { minHeight: "1.5em", font: "13px sans-serif", color: COLOURS.ink });
  line.setAttribute("role", "status");
  const bar = element("div", { display: "flex", flexWrap: "wrap", gap: "4px", padding: "4px 0" });
  const islands = element("div", { display: "flex", flexWrap: "wrap", gap: "4px", padding: "4px 0", maxHeight: "110px", overflowY: "auto" });
  islands.setAttribute("role", "group");
  islands.setAttribute("aria-label", "Islands");
  el.append(bar, box, line, islands);

  let saves = false; // whether this view asked for files
  let selected = [];
  let listed = "";
  let verdict = ["", "good"]; // on the map that is shown
  const send = (message, arrays) => model.send({}, undefined, [encodeFrame(message, arrays)]);
  const view = createView(box, { send, pictured: (picture) => picture && colour("image") });
  // In JupyterLab, keys in the view would also insert and delete cells.
  for (const pane of view.hands.panes) pane.dataset.lmSuppressShortcuts = "true";
  const say = (text, tone) => {
    line.textContent = text;
    line.style.color = TONES[tone];
  };

  function button(text, act, parent = bar) {
    const one = element("button", CONTROL, { textContent: text, type: "button" });
    one.addEventListener("click", act);
    parent.append(one);
    return one;
  }

  function press(one, pressed) {
    one.setAttribute("aria-pressed", pressed);
    one.style.borderColor = pressed ? COLOURS.accent : COLOURS.line;
    one.style.boxShadow = pressed ? `inset 0 0 0 1px ${COLOURS.accent}` : "none";
  }

  const tools = Object.entries(TOOLS).map(([name, text]) => {
    const one = button(text, () => choose(name));
    one.dataset.tool = name;
    return one;
  });
  const actions = Object.fromEntries(Object.entries(ACTIONS).map(([what, text]) => [what, button(text, () => send({ do: what }))]));

  const colouring = element("select", CONTROL);
  colouring.setAttribute("aria-label", "Colours");
  for (const [value, textContent] of Object.entries(COLOURINGS)) colouring.append(element("option", {}, { value, textContent }));
  colouring.addEventListener("change", () => colour(colouring.value));
  const file = element("input", { display: "none" }, { type: "file", accept: ".png,.jpg,.jpeg" });
  file.addEventListener("change", async () => {
    if (file.files.length) send({ do: "image" }, { content: new Uint8Array(await file.files[0].arrayBuffer()) });
    file.value = "";
  });
  bar.append(colouring, file);
  button("Image…", () => file.click());
  for (const format of ["obj", "glb"]) {
    button(`Save ${format.toUpperCase()}`, () => {
      saves = true;
      send({ do: "save", format });
    });
  }
  box.addEventListener("dragover", (event) => event.preventDefault());
  box.addEventListener("drop", async (event) => {
    event.preventDefault();
    event.stopPropagation();
    const [one] = event.dataTransfer.files;
    if (one) send({ do: "image" }, { content: new Uint8Array(await one.arrayBuffer()) });
  });

  function colour(name) {
    colouring.value = name;
    view.set({ colouring: name });
  }

  function choose(name) {
    view.hands.tool = name;
    view.scene.seamStart = -1;
    for (const one of tools) press(one, one.dataset.tool === name);
    view.set({});
  }
  choose("move");

  /** List the islands; a click selects one, with Shift several. */
  function list(header) {
    selected = header.selected;
    const key = JSON.stringify(header.islands);
    if (key !== listed) {
      listed = key;
      islands.replaceChildren();
      if (header.count > 1) button("All", () => send({ do: "select", islands: [] }), islands);
      header.islands.forEach((island, k) => {
        if (header.count < 2) return;
        const one = button(`${island.good ? "✓" : "✗"} ${k}: ${island.triangles.toLocaleString("en")}`, (event) => select(k, event.shiftKey), islands);
        one.dataset.island = k;
        one.title = `Island ${k}; Shift+click selects several`;
      });
    }
    for (const one of islands.querySelectorAll("[data-island]")) press(one, selected.includes(Number(one.dataset.island)));
  }

  function select(island, more) {
    const chosen = new Set(more ? selected : []);
    if (more && chosen.has(island)) chosen.delete(island);
    else chosen.add(island);
    send({ do: "select", islands: [...chosen].sort((a, b) => a - b) });
  }

  function download(name, content) {
    const link = element("a", {}, { href: URL.createObjectURL(new Blob([content])), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }

  function receive(message, buffers) {
    const frame = decodeFrame(buffers[0]);
    const { header, arrays } = frame;
    if (header.kind === "note") say(header.text, "error");
    else if (header.kind === "busy") say(`${header.what} …`, "good");
    else if (header.kind === "file") return saves && download(header.name, arrays.content);
    else if (header.kind === "saved") saves = false;
    else if (header.kind === "map" && arrays.places) say(...(verdict = [header.verdict, header.injective ? "good" : "error"]));
    else if (header.kind === "image") say(...verdict);
    if (header.kind === "map" && header.state === "settled") {
      list(header);
      for (const what of ["undo", "redo"]) {
        actions[what].disabled = !header[what];
        actions[what].style.opacity = header[what] ? "1" : "0.5";
      }
      if (header.drawn) say("The seams have changed: press Flatten or Unwrap.", "good");
    }
    view.receive(frame);
    if (message.first && header.kind === "map") view.fit();
  }

  const resize = () => (box.style.height = `${model.get("height")}px`);
  model.on("msg:custom", receive);
  model.on("change:height", resize);
  send({ do: "show" });
  return () => {
    model.off("msg:custom", receive);
    model.off("change:height", resize);
    view.dispose();
  };
}
