// The view in a notebook cell: the user's actions go to the kernel as custom messages, and the kernel returns frames.

import { decodeFrame, encodeFrame } from "./frames.js";
import { createView } from "./view.js";

const TOOLS = { move: "Move", pin: "Pin", seam: "Seam", erase: "Erase" };
const ACTIONS = { unwrap: "Unwrap", flatten: "Flatten", undo: "Undo", redo: "Redo" };
const TONES = { error: "#b00020", good: "inherit" };

/** Called by anywidget for every cell that shows the widget; the returned function is called when the cell is gone. */
export function render({ model, el }) {
  const box = document.createElement("div");
  const line = document.createElement("div");
  Object.assign(box.style, { height: `${model.get("height")}px`, background: "#ffffff" });
  Object.assign(line.style, { minHeight: "1.5em", font: "13px sans-serif" });
  line.setAttribute("role", "status");
  const bar = document.createElement("div");
  Object.assign(bar.style, { display: "flex", flexWrap: "wrap", gap: "4px", padding: "4px 0" });
  el.append(bar, box, line);

  const send = (message, arrays) => model.send({}, undefined, [encodeFrame(message, arrays)]);
  const view = createView(box, { send });
  const say = (text, tone) => {
    line.textContent = text;
    line.style.color = TONES[tone];
  };

  function button(text, act) {
    const one = document.createElement("button");
    one.textContent = text;
    Object.assign(one.style, { minHeight: "32px", padding: "2px 10px", font: "13px sans-serif", cursor: "pointer" });
    one.addEventListener("click", act);
    bar.append(one);
    return one;
  }

  const tools = Object.entries(TOOLS).map(([name, text]) => {
    const one = button(text, () => choose(name));
    one.dataset.tool = name;
    return one;
  });
  const actions = Object.fromEntries(Object.entries(ACTIONS).map(([what, text]) => [what, button(text, () => send({ do: what }))]));

  function choose(name) {
    view.hands.tool = name;
    view.scene.seamStart = -1;
    for (const one of tools) one.setAttribute("aria-pressed", one.dataset.tool === name);
    for (const one of tools) one.style.fontWeight = one.dataset.tool === name ? "700" : "400";
    view.set({});
  }
  choose("move");

  function receive(message, buffers) {
    const frame = decodeFrame(buffers[0]);
    const { header, arrays } = frame;
    if (header.kind === "note") say(header.text, "error");
    else if (header.kind === "busy") say(`${header.what} …`, "good");
    else if (header.kind === "map" && arrays.places) say(header.verdict, header.injective ? "good" : "error");
    if (header.kind === "map" && header.state === "settled") {
      actions.undo.disabled = !header.undo;
      actions.redo.disabled = !header.redo;
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
