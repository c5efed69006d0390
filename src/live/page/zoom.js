"use strict";
// Zoom of the picture, live or frozen: by wheel, two fingers, buttons and keys, until a pixel is PIXEL wide. A drag moves a picture that is
// larger than its place. Pictures, read-out and region lie on one sheet, whose box says which pixel is where.
const PIXEL = 40, sheet = $("sheet"), touches = new Map();
let zoom = 1, pan = [0, 0], moved = null;

// Width and height of the whole picture in its place.
function whole() {
  const scale = Math.min(stage.clientWidth / size[0], stage.clientHeight / size[1]);
  return size.map(n => n * scale);
}
function layOut() {
  const fitted = whole();
  // the picture covers its place as far as it can
  pan = pan.map((p, k) => {
    const most = Math.max(0, (zoom * fitted[k] - [stage.clientWidth, stage.clientHeight][k]) / 2);
    return Math.min(most, Math.max(-most, p));
  });
  Object.assign(sheet.style, { width: `${zoom * fitted[0]}px`, height: `${zoom * fitted[1]}px`,
    transform: `translate(calc(-50% + ${pan[0]}px), calc(-50% + ${pan[1]}px))` });
  stage.classList.toggle("zoomed", zoom > 1);
  const times = `${zoom < 10 ? Math.round(10 * zoom) / 10 : Math.round(zoom)}×`;
  $("zoom-whole").textContent = times;
  $("zoom-whole").setAttribute("aria-label", `${times} zoom, show the whole picture`);
  $("zoom-out").disabled = $("zoom-whole").disabled = zoom === 1;
  $("zoom-in").disabled = zoom >= largest();
}
const largest = () => Math.max(1, PIXEL * size[0] / (whole()[0] || 1));

// Zooms and keeps the place (x, y) of the window where it is; without one that of the read-out, or the middle.
function zoomBy(factor, x, y) {
  const box = stage.getBoundingClientRect(), before = zoom;
  if (x === undefined) {
    const mark = point && sheet.getBoundingClientRect();
    [x, y] = mark ? [mark.left + (point.x + .5) / size[0] * mark.width, mark.top + (point.y + .5) / size[1] * mark.height]
      : [box.left + box.width / 2, box.top + box.height / 2];
  }
  zoom = Math.min(largest(), Math.max(1, zoom * factor));
  const from = [x - box.left - box.width / 2, y - box.top - box.height / 2];
  pan = pan.map((p, k) => from[k] - (from[k] - p) * zoom / before);
  layOut();
}
// Moves the picture so far that the read-out is seen.
function follow() {
  if (!point || zoom === 1) return;
  const fitted = whole(), place = [stage.clientWidth, stage.clientHeight];
  const at = [point.x, point.y].map((v, k) => ((v + .5) / size[k] - .5) * zoom * fitted[k]);
  pan = pan.map((p, k) => Math.max(-place[k] * .4 - at[k], Math.min(place[k] * .4 - at[k], p)));
  layOut();
}

stage.addEventListener("wheel", event => {
  // the page scrolls where there is nothing to make smaller
  if (event.deltaY > 0 && zoom === 1) return;
  event.preventDefault();
  zoomBy(2 ** (-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 120) / 240), event.clientX, event.clientY);
}, { passive: false });
$("zoom-in").onclick = () => zoomBy(2);
$("zoom-out").onclick = () => zoomBy(.5);
$("zoom-whole").onclick = () => zoomBy(0);
stage.addEventListener("keydown", event => {
  const factor = { "+": 2, "=": 2, "-": .5, "0": 0 }[event.key];
  if (event.ctrlKey || event.metaKey) return;
  if (factor !== undefined) {
    event.preventDefault();
    zoomBy(factor);
  } else if (STEPS[event.key]) follow();
});

stage.addEventListener("pointerdown", event => {
  touches.set(event.pointerId, [event.clientX, event.clientY]);
  moved = zoom > 1 && !choosing && touches.size === 1 ? event.pointerId : null;
  if (moved !== null) stage.setPointerCapture(event.pointerId);
});
stage.addEventListener("pointermove", event => {
  const before = touches.get(event.pointerId), now = [event.clientX, event.clientY];
  if (!before) return;
  touches.set(event.pointerId, now);
  const other = [...touches].find(([id]) => id !== event.pointerId)?.[1];
  if (other) {
    const apart = at => Math.hypot(at[0] - other[0], at[1] - other[1]) || 1;
    zoomBy(apart(now) / apart(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
  } else if (moved === event.pointerId) {
    pan = pan.map((p, k) => p + now[k] - before[k]);
    layOut();
  }
});
for (const end of ["pointerup", "pointercancel", "pointerleave"]) {
  stage.addEventListener(end, event => { touches.delete(event.pointerId); if (moved === event.pointerId) moved = null; });
}
new ResizeObserver(layOut).observe(stage);
