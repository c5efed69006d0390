"use strict";
// Only what is looked at is streamed; a hidden or frozen page watches nothing, so that the encoder rests too.
const live = $("live"), live2 = $("live2"), stage = $("stage");
let view = location.hash.slice(1), second = "", views = [], size = [1, 1], frozen = false, comparing = false;
const NOTHING = "data:,";
const watch = () => {
  if (!frozen) {
    live.src = document.hidden || !view ? NOTHING : address("stream", { view });
    live2.src = document.hidden || !comparing ? NOTHING : address("stream", { view: second });
    $("save-png").href = address("snapshot", { view, format: "png" });
    $("save-all").href = "still";
  }
  $("save-png").download = `stokescope-${view}.png`;
};
document.addEventListener("visibilitychange", watch);
for (const image of [live, live2]) {
  image.addEventListener("error", () => { if (!document.hidden && image.src.includes("stream")) setTimeout(watch, 2000); });
}
const label = name => views.find(v => v.name === name)?.label ?? name;
function choose(name) {
  view = name;
  history.replaceState(null, "", `#${name}`);
  for (const b of $("views").children) b.setAttribute("aria-pressed", b.dataset.view === name);
  if (frozen) freeze(false);
  drawLegend();
  watch();
  divide();
}

// Side by side: the second picture lies over the first, cut off left of the divider.
function divide() {
  const at = Number($("split-at").value);
  for (const e of [live2, $("still2")]) e.style.clipPath = `inset(0 0 0 ${at}%)`;
  $("divider").style.left = at + "%";
  $("tag-left").textContent = label(view);
  $("tag-right").textContent = label(second);
}
function compare(on) {
  comparing = on;
  $("compare").setAttribute("aria-pressed", on);
  for (const id of ["split", "second", "divider", "tag-left", "tag-right"]) $(id).hidden = !on;
  live2.hidden = !on;
  if (frozen) freeze(false);
  watch();
  divide();
}
$("compare").onclick = () => compare(!comparing);
$("second").onchange = () => { second = $("second").value; if (frozen) freeze(false); watch(); divide(); };
$("split-at").oninput = divide;

function showViews(found) {
  if (views.length) return;
  views = found;
  $("views").replaceChildren(...found.map(({ name, label }) => {
    const b = element("button", { textContent: label, onclick: () => choose(name) });
    b.dataset.view = name;
    return b;
  }));
  $("second").replaceChildren(...found.map(({ name, label }) => new Option(label, name)));
  const known = name => found.some(v => v.name === name);
  second = known("intensity") ? "intensity" : found[0].name;
  $("second").value = second;
  choose(known(view) ? view : known("aolp") ? "aolp" : found[0].name);
}

$("smooth").onclick = () => {
  const on = $("view").classList.toggle("smooth");
  $("smooth").setAttribute("aria-pressed", on);
};
$("full").onclick = () => document.fullscreenElement ? document.exitFullscreen() : $("view").requestFullscreen();
document.addEventListener("fullscreenchange", () => $("full").setAttribute("aria-pressed", Boolean(document.fullscreenElement)));
