"use strict";
// The setup: live pictures on the scale of the counts, settings of the cameras, and one page for each step of calibration.
const TASKS = {
  dark: ["Dark", "Cover the lensless sensor so that no light reaches it, then take the dark frame."],
  mask: ["Mask", "Take the diffuser off and light the sensor evenly through a polarizer. Take one view for each angle of the polarizer, three or more; 0, 30, 60, 90, 120 and 150 are a good choice. Then measure."],
  psf: ["PSF", "Put the diffuser on and darken the room. Place one small light source, such as an LED behind a pinhole, in the middle of the view at the working distance."],
  white: ["White", "Fill the view with a white, evenly lit surface."],
  align: ["Align", "Show both cameras one well-lit printed target with fine structure, and let nothing move."],
  verify: ["Verify", "Place a lamp behind a polarizer in the view. Take one view for each of two angles or more, such as 0, 60 and 120. Then measure."],
};
// the same checks in words for lamps that are red and green
const FINE = { "too bright": "not too bright", "too dark": "not too dark", moved: "still", "source too large": "source small enough",
  "guide too bright": "guide not too bright", "guide too dark": "guide not too dark", "guide moved": "guide still" };
// fields of the settings of a camera, with their keys
const SETTINGS = { exposure: "exposure_us", gain: "gain", "frame-rate": "frame_rate" };
let step = "", steps = [], camera = "raw", state = null, busy = false, asked = null, at = null, shown = null;

// Live picture: the next one is asked for when the last one is there, at most some five times a second.
let showing = false;
async function show() {
  if (showing || document.hidden) return;
  showing = true;
  try {
    const answer = await fetch(address("snapshot", { view: camera }));
    if (answer.status === 401) return location.reload();
    if (answer.ok) {
      const before = $("live").src;
      $("live").src = URL.createObjectURL(await answer.blob());
      if (before.startsWith("blob:")) URL.revokeObjectURL(before);
    }
  } catch { /* the service is not there: the state says so */ } finally { showing = false; }
}
setInterval(show, 200);

function see(name) {
  camera = name;
  for (const each of ["raw", "guide"]) $(`see-${each}`).setAttribute("aria-pressed", each === name);
  asked = null;
  at = null;
  $("cross").style.display = "none";
  // at once: what is typed from now on is not replaced by an answer that is under way
  if (state) showCamera();
  update();
  show();
}
$("see-raw").onclick = () => see("raw");
$("see-guide").onclick = () => see("guide");
$("zoom").onclick = () => {
  const on = $("stage").classList.toggle("zoom");
  $("zoom").setAttribute("aria-pressed", on);
};

// Read-out in counts. The picture is fitted into the stage as object-fit does it.
const own = () => state?.cameras[camera];
function place(clientX, clientY) {
  const [width, height] = own().size, box = $("live").getBoundingClientRect();
  const scale = Math.min(box.width / width, box.height / height);
  const x = Math.floor((clientX - box.left - (box.width - width * scale) / 2) / scale);
  const y = Math.floor((clientY - box.top - (box.height - height * scale) / 2) / scale);
  if (x >= 0 && y >= 0 && x < width && y < height) { at = [x, y]; readOut(); }
}
async function readOut() {
  if (!at || !own()) return;
  const [width, height] = own().size, image = $("live").getBoundingClientRect(), stage = $("stage").getBoundingClientRect();
  const scale = Math.min(image.width / width, image.height / height), cross = $("cross");
  cross.style.left = image.left - stage.left + (image.width - width * scale) / 2 + (at[0] + .5) * scale + "px";
  cross.style.top = image.top - stage.top + (image.height - height * scale) / 2 + (at[1] + .5) * scale + "px";
  cross.style.display = "block";
  try {
    const found = await ask("pixel", { view: camera, x: at[0], y: at[1] });
    const counts = found.counts ? found.counts.map(v => Math.round(100 * v) / 100).join(", ") : "no frame yet";
    $("readout").replaceChildren(element("span", { textContent: `${at[0]}, ${at[1]}` }), element("span", { textContent: `${counts} counts${found.saturated ? ", saturated" : ""}` }));
  } catch { /* the next one follows */ }
}
$("stage").addEventListener("pointerdown", e => own() && place(e.clientX, e.clientY));
$("stage").addEventListener("keydown", e => {
  const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  if (!move || !own()) return;
  e.preventDefault();
  const by = e.shiftKey ? 10 : 1, size = own().size;
  at = (at ?? size.map(n => Math.floor(n / 2))).map((v, k) => Math.min(size[k] - 1, Math.max(0, v + by * move[k])));
  readOut();
});

const number = v => v === null || v === undefined ? "–" : Math.abs(v) >= 100 ? Math.round(v).toString() : String(Math.round(100 * v) / 100);
async function histogram() {
  const canvas = $("histogram"), found = await ask("histogram", { view: camera });
  if (!found) return;
  const width = canvas.width = canvas.clientWidth * devicePixelRatio, context = canvas.getContext("2d");
  const top = Math.log1p(1e4 * Math.max(...found.classes)), each = width / found.classes.length;
  context.clearRect(0, 0, width, canvas.height);
  found.classes.forEach((share, k) => {
    const height = top > 0 ? Math.log1p(1e4 * share) / top * canvas.height : 0;
    context.fillStyle = k === found.classes.length - 1 && found.saturated > 0 ? "#ff3030" : "#7cc7ff";
    context.fillRect(k * each, canvas.height - height, Math.max(1, each - 1), height);
  });
}

function showCamera() {
  for (const name of ["raw", "guide"]) {
    const found = state.cameras[name], lamp = $(`${name}-lamp`);
    lamp.hidden = $(`see-${name}`).hidden = !found;
    if (found) lamp.className = `lamp ${found.online ? "good" : "bad"}`;
  }
  const found = own(), figures = found.figures ?? {};
  $("stage").style.aspectRatio = found.size.join(" / ");
  $("white").textContent = number(found.white);
  const rows = [
    ["Camera", found.name], ["State", found.fault ?? (found.waiting ? `waits for ${found.waiting}` : `${number(found.fps)} frames per second`)],
    ["Median", `${number(figures.median)} counts`], ["Brightest", `${number(figures.bright)} counts`],
    ["Saturated", `${number(100 * (figures.saturated ?? 0))} %`], ["No count", `${number(100 * (figures.clipped ?? 0))} %`],
    ["Focus", `${number(figures.focus)} %`],
    ["Exposure", `asked ${number(found.exposure_us.asked)}, took ${number(found.exposure_us.took)} µs`],
    ["Gain", `asked ${number(found.gain.asked)}, took ${number(found.gain.took)}`],
    ["Frame rate", `asked ${number(found.frame_rate.asked)}, took ${number(found.frame_rate.took)}/s`],
  ];
  $("figures").replaceChildren(...rows.flatMap(([name, value]) => [element("dt", { textContent: name }), element("dd", { textContent: value })]));
  if (asked !== camera) {
    asked = camera;
    for (const [id, key] of Object.entries(SETTINGS)) $(id).value = found[key].asked ?? "";
    $("source").value = found.source;
    $("source-field").hidden = found.backend !== "sim";
  }
  $("frame-rate-field").hidden = !found.frame_rate.limits;
  limit();
  $("set").disabled = $("restart").disabled = !state.controls.allowed;
}
// Limits of the settings. The longest exposure is another one with another frame rate: the camera then says what it took.
function limit() {
  const found = own(), other = !$("frame-rate-field").hidden && $("frame-rate").value !== String(found.frame_rate.asked ?? "");
  for (const [id, key] of Object.entries(SETTINGS)) {
    const limits = id === "exposure" && other ? null : found[key].limits;
    [$(id).min, $(id).max] = limits ?? ["", ""];
    $(`${id}-limits`).textContent = limits ? `(${limits.map(v => v < 1 ? v : number(v)).join(" to ")})` : "";
  }
}
$("frame-rate").oninput = limit;
$("restart").onclick = async () => {
  try { state = await send("cameras/restart", "POST"); } catch (error) { $("control-note").textContent = error.message; }
};
$("control-form").onsubmit = async e => {
  e.preventDefault();
  const change = {};
  for (const [id, key] of Object.entries(SETTINGS)) if (!$(id).closest(".field").hidden) change[key] = $(id).value === "" ? null : Number($(id).value);
  if (own().backend === "sim") change.source = $("source").value;
  $("control-note").textContent = "The camera is opened again …";
  try {
    state = await send("control", "POST", { [camera]: change });
    $("control-note").textContent = "";
  } catch (error) { $("control-note").textContent = error.message; }
};

function choose(name) {
  step = name;
  history.replaceState(null, "", `#${name}`);
  const [title, task] = TASKS[name];
  $("title").textContent = title;
  $("task").textContent = task;
  const turned = name === "mask" || name === "verify";
  $("angle-field").hidden = !turned;
  for (const field of document.querySelectorAll(".mask")) field.hidden = name !== "mask";
  if (name === "align" && state?.cameras.guide) $("see-guide").hidden = false;
  for (const b of $("steps").children) {
    b.setAttribute("aria-pressed", b.dataset.step === name);
    // within the row of steps, which is wider than a phone
    if (b.dataset.step === name) $("steps").scrollLeft = b.offsetLeft - $("steps").offsetLeft - 60;
  }
  shown = null;
  update();
}

function showStep(found) {
  busy = found.state === "taking" || found.state === "measuring";
  const may = state.controls.allowed && !busy, turned = found.step === "mask" || found.step === "verify";
  $("lamps").replaceChildren(...(found.lamps ?? []).map(lamp =>
    element("li", { className: `lamp ${lamp.lit ? "bad" : "good"}`, textContent: lamp.lit ? lamp.name : FINE[lamp.name] })));
  $("take").disabled = !may;
  $("measure-form").hidden = !turned || !found.views.length;
  $("measure").disabled = !may;
  $("views").textContent = `Taken at ${found.views.map(v => v + "°").join(", ")}.`;
  $("progress").hidden = !busy;
  if (found.state === "taking") $("progress").value = found.progress.taken / found.progress.of;
  else $("progress").removeAttribute("value");
  const { result, fault } = found, remedy = (result ?? fault)?.remedy;
  const said = fault?.error ?? result?.verdict ?? found.verdict ?? (found.kept ? "This step is done; it can be taken again." : "");
  $("verdict").textContent = busy ? (found.state === "taking" ? "Taking frames …" : "Measuring …") : remedy ? `${said.replace(/\.?$/, ".")} ${fault ? "What helps:" : "To improve it,"} ${remedy}.` : said;
  $("verdict").className = fault ? "bad" : result && !result.good ? "poor" : "";
  $("decide").hidden = !result;
  $("keep").disabled = $("again").disabled = !may;
  const picture = result ? `new ${found.step} ${result.verdict}` : found.kept ? `kept ${found.step}` : "";
  if (picture !== shown) {
    shown = picture;
    $("result").hidden = !picture;
    if (picture) $("result").src = address(`calibrate/${found.step}/picture`, { of: picture });
  }
}
$("result").onerror = () => { $("result").hidden = true; };

function showSteps(all) {
  const names = all.map(each => each.step);
  if (names.join() !== steps.join()) {
    steps = names;
    $("steps").replaceChildren(...names.map(name => {
      const b = element("button", { textContent: TASKS[name][0], onclick: () => choose(name) });
      b.dataset.step = name;
      return b;
    }));
    const wished = location.hash.slice(1), next = all.find(each => !each.kept)?.step ?? names[0];
    if (!step) choose(names.includes(wished) ? wished : next);
  }
  for (const [k, b] of [...$("steps").children].entries()) {
    b.classList.toggle("kept", all[k].kept);
    b.setAttribute("aria-label", TASKS[names[k]][0] + (all[k].kept ? ", done" : ""));
  }
}

let updating = false;
async function update() {
  if (updating || document.hidden) return;
  updating = true;
  try {
    state = await ask("state");
    // the bundle is in place and the live service runs
    if (state.mode !== "setup") return location.replace("/");
    $("board").textContent = state.board;
    showCamera();
    const all = (await ask("calibrate")).steps;
    showSteps(all);
    const found = all.find(each => each.step === step);
    if (found) showStep(found);
    const left = state.missing.map(name => TASKS[name][0]).join(", ");
    $("left").textContent = !state.controls.allowed ? "Nothing can be changed: start the service with --control, or with a token."
      : left ? `Left to do: ${left}.` : "The bundle is complete. Align and Verify make sure that it is right.";
    $("finish").disabled = Boolean(left) || busy || !state.controls.allowed;
    await histogram();
    await readOut();
  } catch (error) {
    $("left").textContent = `No answer: ${error.message}`;
  } finally { updating = false; }
}
setInterval(update, 700);
document.addEventListener("visibilitychange", update);

const act = async (path, body) => {
  try {
    await send(path, "POST", body);
    shown = null;
    await update();
  } catch (error) {
    $("verdict").textContent = error.message;
    $("verdict").className = "bad";
  }
};
$("take-form").onsubmit = e => {
  e.preventDefault();
  const body = { frames: Number($("frames").value) };
  if (!$("angle-field").hidden) body.angle = Number($("angle").value);
  act(`calibrate/${step}`, body);
};
$("measure-form").onsubmit = e => {
  e.preventDefault();
  const body = { zero: Number($("zero").value) };
  if (step === "mask") {
    body.stripes = Number($("stripes").value);
    body.mask_angles = $("mask-angles").value.split(",").map(Number);
  }
  act(`calibrate/${step}/measure`, body);
};
$("keep").onclick = async () => {
  await act(`calibrate/${step}/keep`);
  const next = steps[steps.indexOf(step) + 1];
  if (next && $("verdict").className !== "bad") choose(next);
};
$("again").onclick = () => act(`calibrate/${step}/again`);
$("finish").onclick = async () => {
  await act("calibrate/finish");
  $("left").textContent = "The instrument starts …";
};
update();
show();
