"use strict";
function bars(id, values, colour) {
  const c = $(id), g = c.getContext("2d"), scale = devicePixelRatio || 1, width = c.clientWidth, height = 60;
  if (c.width !== Math.round(width * scale)) c.width = Math.round(width * scale);
  c.height = height * scale;
  g.scale(scale, scale);
  const most = Math.max(...values) || 1, step = width / values.length;
  values.forEach((v, i) => {
    // the square root keeps rare values visible
    const h = Math.sqrt(v / most) * (height - 2);
    g.fillStyle = colour(i, values.length);
    g.fillRect(i * step, height - h, Math.max(step - 1, 1), h);
  });
}
// Petals: how much polarized light has which angle. Line: what a turning polarizer passes (Malus). Both repeat after 180°.
function polarPlot(h) {
  const c = $("polar"), g = c.getContext("2d"), scale = devicePixelRatio || 1, width = c.clientWidth, height = 190;
  [c.width, c.height] = [Math.round(width * scale), height * scale];
  g.scale(scale, scale);
  const x = width / 2, y = height / 2, r = height / 2 - 18, most = Math.max(...h.aolp) || 1, n = h.aolp.length;
  g.strokeStyle = "#262b35"; g.fillStyle = "#a3abba"; g.font = "11px system-ui, sans-serif"; g.textAlign = "center"; g.textBaseline = "middle";
  for (const share of [.5, 1]) { g.beginPath(); g.arc(x, y, r * share, 0, 7); g.stroke(); }
  for (const d of [0, 45, 90, 135]) {
    const a = d * Math.PI / 180;
    g.beginPath(); g.moveTo(x - r * Math.cos(a), y + r * Math.sin(a)); g.lineTo(x + r * Math.cos(a), y - r * Math.sin(a)); g.stroke();
    g.fillText(d + "°", x + (r + 15) * Math.cos(a), y - (r + 10) * Math.sin(a));
  }
  h.aolp.forEach((v, i) => {
    g.fillStyle = hue(180 * (i + .5) / n);
    for (const turn of [0, Math.PI]) {
      g.beginPath(); g.moveTo(x, y); g.arc(x, y, r * Math.sqrt(v / most), turn - (i + 1) * Math.PI / n, turn - i * Math.PI / n); g.fill();
    }
  });
  const [s0, s1, s2] = h.stokes, peak = s0 + Math.hypot(s1, s2) || 1;
  g.strokeStyle = "#fff"; g.lineWidth = 1.5; g.beginPath();
  for (let d = 0; d <= 360; d += 3) {
    const a = d * Math.PI / 180, m = r * (s0 + s1 * Math.cos(2 * a) + s2 * Math.sin(2 * a)) / peak;
    g.lineTo(x + m * Math.cos(a), y - m * Math.sin(a));
  }
  g.stroke();
}
async function distribution() {
  const h = await ask("histogram", region ?? {});
  $("histograms").hidden = !h;
  if (!h) return;
  const mean = h.mean_dolp == null ? "no valid pixel" : `summed light: DoLP ${h.mean_dolp.toFixed(3)}, AoLP ${h.mean_aolp_degrees.toFixed(0)}°`;
  $("of").textContent = `· ${region ? `${region.w} × ${region.h} at ${region.x}, ${region.y}` : "whole picture"} · ${mean}`;
  bars("dolp-histogram", h.dolp, (i, n) => `hsl(${285 + 135 * i / n} 65% ${25 + 50 * i / n}%)`);
  bars("aolp-histogram", h.aolp, (i, n) => hue(180 * (i + .5) / n));
  polarPlot(h);
}
