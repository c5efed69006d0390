"use strict";
const STAGES = { wait: "#4b5364", prepare: "#7cc7ff", register: "#b08cff", recon: "#59d38c", fusion: "#ffc861", publish: "#ff9f7a", encode: "#f07cc0", preview: "transparent" };
function lamp(id, camera) {
  const e = $(id);
  e.hidden = !camera;
  if (camera) { e.className = "lamp " + (camera.online ? "good" : "bad"); e.title = camera.fault ?? camera.name; }
}
function show(s) {
  const other = String(size) !== String(s.size);
  size = s.size;
  stage.style.aspectRatio = size.join(" / ");
  stage.style.maxWidth = $("split").style.maxWidth = `calc(58vh * ${size[0] / size[1]})`;
  if (other) layOut();
  showViews(s.views);
  $("board").textContent = s.board;
  lamp("raw-lamp", s.cameras.raw);
  lamp("guide-lamp", s.cameras.guide);
  const lost = 100 * (s.saturated ?? 0), exposure = $("exposure-lamp");
  exposure.hidden = s.saturated == null;
  exposure.className = "lamp " + (lost >= 1 ? "bad" : lost > 0.01 ? "warn" : "good");
  exposure.textContent = lost > 0.01 ? `${lost.toFixed(lost < 1 ? 2 : 0)} % saturated` : "light";
  exposure.title = lost > 0.01 ? "Expose shorter, lower the gain or dim the light. The view Raw shows these readings in red." : "No reading is saturated";
  const r = s.report, rows = [
    ["Frame", s.frame ?? "–"], ["Per second", s.fps.toFixed(1)],
    ...(s.quality.shown_fps != null ? [["Shown per second", s.quality.shown_fps.toFixed(1)]] : []),
    ["Delay, median", s.latency_ms.p50 == null ? "–" : `${s.latency_ms.p50.toFixed(0)} ms`],
    ["Delay, 95 %", s.latency_ms.p95 == null ? "–" : `${s.latency_ms.p95.toFixed(0)} ms`],
    ["Skipped", s.dropped.raw], ["Unpaired", s.dropped.unpaired],
    ...(s.quality.target_fps ? [["Target", `${s.quality.target_fps.toFixed(1)}/s, ${s.quality.held ? "held" : `missed: ${s.quality.missed}`}`]] : []),
    ...(s.machine.temperature_c != null ? [["Temperature", `${s.machine.temperature_c.toFixed(0)} °C`]] : []),
    ...(lost > 0 ? [["Saturated readings", `${lost.toFixed(2)} %`]] : []),
    ...(s.recording ? [["Recorded", s.recording.written + (s.recording.dropped ? `, ${s.recording.dropped} left out` : "")]] : []),
    ...(r ? [["Method", `${r.method}, ${r.iterations} iterations`], ["Residual", r.residual_rms?.toFixed(4) ?? "–"],
      ["Mean DoLP", r.mean_dolp?.toFixed(3) ?? "–"], ["Valid pixels", `${(100 * r.valid_fraction).toFixed(1)} %`]] : []),
    ["Size", s.size.join(" × ")],
    ...(s.peak_rss_bytes ? [["Memory, peak", `${(s.peak_rss_bytes / 2 ** 20).toFixed(0)} MiB`]] : []),
  ];
  $("figures").replaceChildren(...rows.flatMap(([k, v]) => [element("dt", { textContent: k }), element("dd", { textContent: v })]));
  const times = s.stages_ms, used = Object.keys(STAGES).filter(k => times[k]?.p50 > 0.05 && k !== "preview");
  const sum = used.reduce((a, k) => a + times[k].p50, 0) || 1;
  $("stages").replaceChildren(...used.map(k => element("i", { style: `width: ${100 * times[k].p50 / sum}%; background: ${STAGES[k]}` })));
  const cells = (name, ...rest) => element("tr", {}, ...[name, ...rest].map(c => element("td", {}, c)));
  $("timings").replaceChildren(
    element("tr", {}, ...["Stage, ms", "median", "95 %"].map(textContent => element("th", { textContent }))),
    ...[...used, ...(times.preview ? ["preview"] : [])].map(k => {
      const name = element("span", {}, element("i", { style: `background: ${STAGES[k]}` }), k === "preview" ? "frame to picture" : k);
      return cells(name, times[k].p50.toFixed(1), times[k].p95.toFixed(1));
    }));
  settings(s);
  recording(s);
  const warnings = [
    ...(s.cameras.raw.fault ? [`Raw camera offline: ${s.cameras.raw.fault}`] : []),
    ...(s.cameras.guide?.fault ? [`Guide camera offline: ${s.cameras.guide.fault}`] : []),
    ...(s.fault ? [`No result: ${s.fault}`] : []),
    ...(s.machine.undervoltage ? ["Undervoltage: the supply is too weak, the processor slows down."] : []),
    ...(s.machine.throttled ? ["Throttled: heat holds the processor's clock down."] : []),
    ...(s.quality.reduced ? [`Quality reduced: ${s.quality.reduced}`] : []),
    ...(s.recording?.fault ? [`Not recorded: ${s.recording.fault}`] : []),
    ...(s.saving.fault ? [`Not saved: ${s.saving.fault}`] : []),
    ...(r?.warnings ?? []),
  ];
  doubt(r);
  $("warnings").style.display = warnings.length ? "block" : "none";
  $("warnings").replaceChildren(...warnings.map(textContent => element("p", { textContent })));
}
// The verdict on a frame that cannot be believed, across its picture.
function doubt(report) {
  const verdict = report?.verdict, bad = verdict === "not credible", suspect = report?.suspects?.[0];
  $("doubt").hidden = !(bad || verdict === "doubtful");
  $("doubt").className = bad ? "bad" : "";
  $("doubt").textContent = $("doubt").hidden ? "" : (bad ? "Not credible: " : "Doubtful: ")
    + (suspect ? `probably ${suspect.what}` : `the residual is ${report.figures.residual_over_noise.toFixed(1)} times the noise`);
}
async function poll() {
  if (!document.hidden) {
    try {
      show(await ask("state"));
      if (!frozen) await distribution();
      read();
    } catch {
      $("raw-lamp").className = "lamp bad";
      $("raw-lamp").title = "the service does not answer";
    }
  }
  setTimeout(poll, 1000);
}
ask("version").then(v => { $("version").textContent = `${v.program} ${v.version}`; }, () => {});
poll();
