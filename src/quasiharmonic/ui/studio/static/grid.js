// The grid in the plane with the unit square, and scale bars.

const LEAST = 56; // distance of grid lines in CSS pixels
const BAR = 70; // least length of a scale bar in CSS pixels

/** Draw grid lines and the unit square. */
export function drawGrid(context, scene, plane, style) {
  const line = style.getPropertyValue("--grid").trim() || "#d5dae6";
  const ink = style.getPropertyValue("--ink").trim() || "#0f1f4a";
  const { x, y, width, height } = plane.box;
  const step = plane.roundLength(LEAST);
  const [ox, oy] = scene.origin;
  context.save();
  context.beginPath();
  context.rect(x, y, width, height);
  context.clip();
  context.strokeStyle = line;
  context.lineWidth = 1;
  const [left, top] = plane.placeOf([x, y]);
  const [right, bottom] = plane.placeOf([x + width, y + height]);
  context.beginPath();
  for (let u = Math.ceil((left + ox) / step) * step; u <= right + ox; u += step) {
    const at = Math.round(plane.pointOf(u - ox, 0)[0]) + 0.5;
    context.moveTo(at, y);
    context.lineTo(at, y + height);
  }
  for (let v = Math.ceil((bottom + oy) / step) * step; v <= top + oy; v += step) {
    const at = Math.round(plane.pointOf(0, v - oy)[1]) + 0.5;
    context.moveTo(x, at);
    context.lineTo(x + width, at);
  }
  context.globalAlpha = 0.6;
  context.stroke();
  context.globalAlpha = 1;
  const [x0, y0] = plane.pointOf(-ox, -oy);
  const [x1, y1] = plane.pointOf(1 - ox, 1 - oy);
  if (x1 - x0 > 24) {
    context.strokeStyle = ink;
    context.setLineDash([2, 3]);
    context.strokeRect(x0, y1, x1 - x0, y0 - y1);
    context.setLineDash([]);
    context.fillStyle = ink;
    context.font = "11px system-ui, sans-serif";
    context.textAlign = "left";
    context.textBaseline = "top";
    context.fillText("0, 0", x0 + 3, y0 + 3);
    context.fillText("1, 1", x1 + 3, y1 + 3);
  }
  context.restore();
}

/** Draw a scale bar in the lower left of a pane; `pixels` is the length of a unit. */
export function drawScale(context, box, pixels, ink) {
  if (!(pixels > 0) || !Number.isFinite(pixels)) return;
  const least = BAR / pixels;
  const power = 10 ** Math.floor(Math.log10(least));
  const length = power * [1, 2, 5, 10].find((factor) => factor * power >= least);
  const [x, y, width] = [box.x + 14, box.y + box.height - 14, length * pixels];
  context.strokeStyle = ink;
  context.fillStyle = ink;
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(x, y - 4);
  context.lineTo(x, y);
  context.lineTo(x + width, y);
  context.lineTo(x + width, y - 4);
  context.stroke();
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "bottom";
  const words = length >= 1e6 || length < 1e-4 ? length.toExponential(0) : String(Number(length.toPrecision(3)));
  context.fillText(`${words} ${length === 1 ? "unit" : "units"}`, x + 4, y - 3);
}
