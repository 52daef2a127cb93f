// The view in a notebook cell: the user's actions go to the kernel as custom messages, and the kernel returns frames.

import { decodeFrame, encodeFrame } from "./frames.js";
import { createView } from "./view.js";

const TONES = { error: "#b00020", good: "inherit" };

/** Called by anywidget for every cell that shows the widget; the returned function is called when the cell is gone. */
export function render({ model, el }) {
  const box = document.createElement("div");
  const line = document.createElement("div");
  Object.assign(box.style, { height: `${model.get("height")}px`, background: "#ffffff" });
  Object.assign(line.style, { minHeight: "1.5em", font: "13px sans-serif" });
  line.setAttribute("role", "status");
  el.append(box, line);

  const send = (message, arrays) => model.send({}, undefined, [encodeFrame(message, arrays)]);
  const view = createView(box, { send });
  const say = (text, tone) => {
    line.textContent = text;
    line.style.color = TONES[tone];
  };

  function receive(message, buffers) {
    const frame = decodeFrame(buffers[0]);
    const { header, arrays } = frame;
    if (header.kind === "note") say(header.text, "error");
    else if (header.kind === "busy") say(`${header.what} …`, "good");
    else if (header.kind === "map" && arrays.places) say(header.verdict, header.injective ? "good" : "error");
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
