"use strict";
// Read-out under the cursor or the last touch, and the region that figures are taken of.
let point = null, reading = false, region = null, corner = null, choosing = false;
function pixelAt(event, clamp = false) {
  const box = $("sheet").getBoundingClientRect();
  let x = Math.floor((event.clientX - box.left) / box.width * size[0]), y = Math.floor((event.clientY - box.top) / box.height * size[1]);
  if (clamp) [x, y] = [Math.min(Math.max(x, 0), size[0] - 1), Math.min(Math.max(y, 0), size[1] - 1)];
  return x < 0 || y < 0 || x >= size[0] || y >= size[1] ? null : { x, y };
}
function place(event) {
  const at = pixelAt(event);
  if (at) mark(at);
}
function mark(at) {
  point = at;
  Object.assign($("cross").style, { display: "block", left: 100 * (at.x + .5) / size[0] + "%", top: 100 * (at.y + .5) / size[1] + "%" });
  read();
}
function outline() {
  $("box").hidden = !region;
  if (region) Object.assign($("box").style, { left: 100 * region.x / size[0] + "%", top: 100 * region.y / size[1] + "%",
    width: 100 * region.w / size[0] + "%", height: 100 * region.h / size[1] + "%" });
}
stage.addEventListener("pointerdown", event => {
  place(event);
  if (choosing) { corner = pixelAt(event); stage.setPointerCapture(event.pointerId); event.preventDefault(); }
});
stage.addEventListener("pointermove", event => {
  place(event);
  const at = corner && pixelAt(event, true);
  if (!at) return;
  region = { x: Math.min(at.x, corner.x), y: Math.min(at.y, corner.y), w: Math.abs(at.x - corner.x) + 1, h: Math.abs(at.y - corner.y) + 1 };
  outline();
});
for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, () => { if (corner) { corner = null; distribution(); } });
$("region").onclick = () => {
  choosing = !choosing;
  $("region").setAttribute("aria-pressed", choosing);
  stage.classList.toggle("region", choosing);
  if (!choosing) { region = null; outline(); distribution(); }
};
const field = (name, value) => element("span", { textContent: name }, element("b", { textContent: value }));
// A value with its standard error, both with the digits that the error leaves.
function measured(value, error, unit = "") {
  const digits = Math.min(Math.max(Math.ceil(-Math.log10(error || 1)), unit ? 0 : 2), 4);
  return `${value.toFixed(digits)}${unit} ± ${error.toFixed(digits)}${unit}`;
}
function showReading(p) {
  const number = (v, digits, unit = "") => v == null ? "–" : v.toFixed(digits) + unit;
  $("readout").replaceChildren(field("x, y", `${p.x}, ${p.y}`), field("S0", number(p.s0, 4)),
    field("DoLP", p.dolp == null ? "–" : measured(p.dolp, p.dolp_error)),
    field("AoLP", p.aolp_degrees == null ? "–" : p.aolp_error_degrees == null ? "uncertain" : measured(p.aolp_degrees, p.aolp_error_degrees, "°")),
    ...(p.valid ? [] : [field("not to be trusted:", "dark or saturated")]));
}
async function read() {
  if (!point || reading || document.hidden) return;
  if (frozen) return showReading(frozenReading(point));
  reading = true;
  try {
    const p = await ask("pixel", point);
    if (p && !frozen) showReading(p);
  } catch { /* the lamps say what is wrong */ }
  reading = false;
}
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
stage.addEventListener("keydown", event => {
  const step = STEPS[event.key];
  if (!step) return;
  event.preventDefault();
  const stride = event.shiftKey ? 10 : 1, from = point ?? { x: size[0] >> 1, y: size[1] >> 1 };
  const within = (v, n) => Math.min(Math.max(v, 0), n - 1);
  mark({ x: within(from.x + stride * step[0], size[0]), y: within(from.y + stride * step[1], size[1]) });
});
