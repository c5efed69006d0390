"use strict";
// Colours as the pictures have them: hue = angle, brightness = degree.
// The same circle in Oklab as the service draws with: darker where it is red, lighter where it is green.
function hue(degrees) {
  const p = (2 * degrees + 20) * Math.PI / 180, a = .14 * Math.cos(p), b = .14 * Math.sin(p), light = .66 - .15 * Math.cos(p);
  const [l, m, s] = [light + .39633778 * a + .21580376 * b, light - .105561346 * a - .06385417 * b, light - .08948418 * a - 1.2914855 * b].map(v => v ** 3);
  const curve = v => Math.round(255 * Math.min(Math.max(v <= .0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - .055, 0), 1));
  return `rgb(${[4.0767417 * l - 3.3077116 * m + .23096994 * s, -1.268438 * l + 2.6097574 * m - .34131938 * s, -.0041960863 * l - .7034186 * m + 1.7076147 * s].map(curve)})`;
}
let dolpEnd = 1;
const DOLP = "linear-gradient(90deg, #05041f, #3b1a78, #9a1f83, #e0403f, #f59b38, #fdf0bd)";
function drawLegend() {
  const legend = $("legend"), say = html => element("p", { innerHTML: html });
  const scale = (colours, low, high) => element("div", { className: "scale" },
    element("i", { style: `background: ${colours}` }),
    element("div", {}, element("span", { textContent: low }), element("span", { textContent: high })));
  if (view === "aolp") legend.replaceChildren(wheel(), say(`Hue is the <b>angle</b> of polarization, seen as on the wheel; brightness is its <b>degree</b>, 0 to ${dolpEnd}. Gray: no angle is certain.`));
  else if (view === "aolp-saturation") legend.replaceChildren(wheel(true), say(`Hue is the <b>angle</b> of polarization; its strength is the <b>degree</b>, 0 to ${dolpEnd}. Unpolarized light is white. Gray: no angle is certain.`));
  else if (view === "difference") legend.replaceChildren(scale("linear-gradient(90deg, #4aa8ff, #141414, #ffa52e)", "less", "more"), say("Intensity against the stored <b>background</b>, drawn up to its largest change."));
  else if (view === "dolp") legend.replaceChildren(scale(DOLP, "0", String(dolpEnd)), say("The <b>degree</b> of linear polarization. Gray: too dark or saturated."));
  else if (view === "dolp-error") legend.replaceChildren(scale(DOLP, "0", String(dolpEnd)), say("The <b>standard error</b> of the degree: two pixels that differ by less are the same. Gray: too dark or saturated."));
  else if (view === "composite") legend.replaceChildren(
    scale("linear-gradient(90deg, #f00 33%, #0f0 33% 66%, #00f 66%)", "0° 45°", "90°"),
    say("Red, green and blue are what polarizers at 0°, 45° and 90° pass. Unpolarized light is gray."));
  else if (view === "imin") legend.replaceChildren(scale("linear-gradient(90deg, #000, #fff)", "0", "white"), say("The least a turning polarizer would pass: the scene without its <b>glare</b>."));
  else if (view === "raw") legend.replaceChildren(scale("linear-gradient(90deg, #000, #fff 88%, #ff3030 88%)", "dark", "full"), say("Readings as they are, on a fixed scale. <b>Red</b> is saturated, blue is clipped at black."));
  else legend.replaceChildren(scale("linear-gradient(90deg, #000, #fff)", "0", "white"), say("Linear intensity, drawn with the sRGB curve; the brightest 0.5 % are white."));
}
function wheel(white = false) {
  const side = 208, c = element("canvas", { width: side, height: side, role: "img", ariaLabel: "Wheel of angles: its hue at each direction" }), g = c.getContext("2d");
  const middle = side / 2, r = middle - 32;
  const rim = g.createConicGradient(0, middle, middle);
  // the canvas turns clockwise, angles counter-clockwise; both halves of the wheel are the same directions
  for (let i = 0; i <= 72; i++) rim.addColorStop(i / 72, hue((360 - 5 * i) % 180));
  g.fillStyle = rim;
  g.beginPath(); g.arc(middle, middle, r, 0, 7); g.fill();
  const dark = g.createRadialGradient(middle, middle, 0, middle, middle, r);
  dark.addColorStop(0, white ? "#fff" : "#000"); dark.addColorStop(1, white ? "#fff0" : "#0000");
  g.fillStyle = dark;
  g.beginPath(); g.arc(middle, middle, r + 1, 0, 7); g.fill();
  g.fillStyle = "#a3abba"; g.font = "20px system-ui, sans-serif"; g.textAlign = "center"; g.textBaseline = "middle";
  for (const d of [0, 45, 90, 135]) {
    const a = d * Math.PI / 180;
    g.fillText(d + "°", middle + (r + (d % 90 ? 20 : 16)) * Math.cos(a), middle - (r + 16) * Math.sin(a));
  }
  return c;
}

