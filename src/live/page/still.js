"use strict";
// Freezing asks the service for one frame: its pictures and the numbers they were drawn from, so that a frozen picture can be read out.
let numbers = null, sigmas = null, trusted = null;

// Files of a ZIP file without compression, by its directory.
function unzip(buffer) {
  const view = new DataView(buffer), files = {};
  let end = buffer.byteLength - 22;
  while (view.getUint32(end, true) !== 0x06054b50) end--;
  let at = view.getUint32(end + 16, true);
  for (let n = view.getUint16(end + 10, true); n > 0; n--) {
    const [length, name, header] = [view.getUint32(at + 24, true), view.getUint16(at + 28, true), view.getUint32(at + 42, true)];
    const text = new TextDecoder().decode(new Uint8Array(buffer, at + 46, name));
    const start = header + 30 + view.getUint16(header + 26, true) + view.getUint16(header + 28, true);
    files[text] = new Uint8Array(buffer, start, length);
    at += 46 + name + view.getUint16(at + 30, true) + view.getUint16(at + 32, true);
  }
  return files;
}

// Values of an NPY file of 32-bit floating point.
function parseNpy(bytes) {
  const head = 10 + bytes[8] + 256 * bytes[9], text = new TextDecoder().decode(bytes.subarray(10, head));
  const shape = /'shape': \(([^)]*)\)/.exec(text)[1].split(",").map(s => s.trim()).filter(Boolean).map(Number);
  return { shape, values: new Float32Array(bytes.slice(head).buffer) };
}

async function drawStill(canvas, png) {
  const picture = await createImageBitmap(new Blob([png], { type: "image/png" }));
  [canvas.width, canvas.height] = [picture.width, picture.height];
  canvas.getContext("2d").drawImage(picture, 0, 0);
}

// Polarization of a pixel of the frozen frame, summed over its channels, with its standard errors as the service propagates them.
function frozenReading({ x, y }) {
  const [h, w] = numbers.shape.slice(-2), each = numbers.shape.at(-3), channels = numbers.shape.length > 3 ? numbers.shape[0] : 1;
  const parts = (of, k) => Array.from({ length: k < each ? channels : 0 }, (_, c) => of.values[((c * each + k) * h + y) * w + x]);
  const [s0, s1, s2] = [0, 1, 2].map(k => parts(numbers, k).reduce((sum, v) => sum + v, 0));
  const [e0, e1, e2] = [0, 1, 2].map(k => Math.hypot(...parts(sigmas, k)));
  const reading = { x, y, s0, valid: trusted[y * w + x] === 1 };
  if (each !== 3) return reading;
  const length = Math.hypot(s1, s2), error = length > 0 ? Math.hypot(s1 * e1, s2 * e2) / length : Math.hypot(e1, e2) / Math.SQRT2;
  return { ...reading, dolp: Math.min(length / Math.max(s0, 1e-6), 1), dolp_error: s0 > 0 ? Math.hypot(error, length / s0 * e0) / s0 : 0,
    aolp_degrees: (Math.atan2(s2, s1) * 90 / Math.PI + 180) % 180,
    aolp_error_degrees: length > error ? Math.hypot(s2 * e1, s1 * e2) / length ** 2 * 90 / Math.PI : null };
}

async function freeze(on) {
  if (on) {
    const names = comparing ? [view, second] : [view];
    $("freeze").disabled = true;
    try {
      const answer = await fetch(address("still", { views: [...new Set(names)].join(",") }));
      if (!answer.ok) throw new Error(await answer.text());
      const files = unzip(await answer.arrayBuffer());
      numbers = parseNpy(files["stokes.npy"]);
      sigmas = parseNpy(files["stokes_error.npy"]);
      trusted = files["valid.npy"].subarray(-numbers.shape.at(-1) * numbers.shape.at(-2));
      await drawStill($("still"), files[`${view}.png`]);
      if (comparing) await drawStill($("still2"), files[`${second}.png`]);
    } catch (e) {
      $("readout").textContent = e.message;
      on = false;
    }
    $("freeze").disabled = false;
  }
  frozen = on;
  for (const [image, canvas, wanted] of [[live, $("still"), true], [live2, $("still2"), comparing]]) {
    canvas.hidden = !(on && wanted);
    image.hidden = on || !wanted;
  }
  $("freeze").setAttribute("aria-pressed", on);
  $("freeze").textContent = on ? "Frozen" : "Freeze";
  if (on) {
    live.src = live2.src = NOTHING;
    $("save-png").href = $("still").toDataURL("image/png");
  } else watch();
  read();
}
$("freeze").onclick = () => freeze(!frozen);
