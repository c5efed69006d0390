"use strict";
async function change(what) {
  try {
    show(await send("control", "POST", what));
  } catch (e) { $("settings-note").textContent = e.message; }
}
let sliding = null;
function slider(id, key) {
  const e = $(id);
  e.oninput = () => { sliding = id; $(id + "-value").textContent = e.value; };
  e.onchange = () => { sliding = null; change({ [key]: Number(e.value) }); };
}
slider("iterations", "iterations");
slider("quality", "jpeg_quality");
$("dolp-scale").onchange = () => {
  const chosen = $("dolp-scale").value;
  change({ dolp_scale: chosen === "auto" ? chosen : Number(chosen) });
};
$("store").onclick = () => change({ background: "store" });
$("clear").onclick = () => change({ background: "clear" });
$("physics").onclick = () => change({ fusion: false });
$("fused").onclick = () => change({ fusion: true });
$("restart").onclick = async () => {
  try {
    show(await send("cameras/restart", "POST"));
    $("restart-note").textContent = "The cameras are opened again …";
    setTimeout(() => { $("restart-note").textContent = ""; }, 5000);
  } catch (e) { $("restart-note").textContent = e.message; }
};
function settings({ controls, report }) {
  const set = (id, value, text) => { if (sliding !== id) { $(id).value = value; $(id + "-value").textContent = text; } };
  $("iterations").max = Math.max(100, controls.iterations);
  const ran = report?.iterations ?? controls.iterations, run = ran === controls.iterations ? "" : ` (${ran} run)`;
  set("iterations", controls.iterations, controls.iterations + run);
  set("quality", controls.jpeg_quality, controls.jpeg_quality);
  const { auto, end } = controls.dolp_scale;
  if (document.activeElement !== $("dolp-scale")) $("dolp-scale").value = auto ? "auto" : String(end);
  if (end !== dolpEnd) {
    dolpEnd = Number(end.toPrecision(2));
    drawLegend();
  }
  for (const id of ["iterations", "quality", "dolp-scale", "store", "physics", "restart"]) $(id).disabled = !controls.allowed;
  $("clear").disabled = !controls.allowed || !controls.background;
  $("fused").disabled = !controls.allowed || !controls.fusion.available;
  $("fused").title = controls.fusion.reason ?? "";
  $("physics").setAttribute("aria-pressed", !controls.fusion.on);
  $("fused").setAttribute("aria-pressed", controls.fusion.on);
  $("background-note").textContent = controls.background ? "Background stored" : "No background";
  $("fusion-note").textContent = controls.fusion.available ? "" : `Physics only: ${controls.fusion.reason}.`;
  $("settings-note").textContent = controls.allowed ? "" : "Read-only: start the service with --control, or use a token.";
}
