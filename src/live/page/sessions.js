"use strict";
// Recording and the sessions that were recorded.
let known = "", allowed = false;
const bytes = n => n >= 1e9 ? `${(n / 1e9).toFixed(1)} GB` : n >= 1e6 ? `${(n / 1e6).toFixed(1)} MB` : `${Math.ceil(n / 1e3)} kB`;
const say = text => { $("record-status").textContent = text; };

$("record-form").onsubmit = async event => {
  event.preventDefault();
  const on = $("record").dataset.on !== "true";
  try {
    show(await send("recording", "POST", on ? { on, name: $("record-name").value, note: $("record-note").value } : { on }));
    if (!on) $("record-name").value = $("record-note").value = "";
    await listSessions();
  } catch (e) { say(e.message); }
};

function recording({ recording, controls }) {
  const on = recording?.on ?? false, button = $("record");
  button.dataset.on = on;
  button.textContent = on ? "Stop" : "Record";
  button.classList.toggle("recording", on);
  allowed = controls.allowed;
  button.disabled = !recording || !allowed;
  for (const id of ["record-name", "record-note"]) $(id).disabled = !recording || on || !allowed;
  if (!recording) return say("Start the service with --sessions DIR to record here.");
  if (!allowed) say("Read-only: start the service with --control, or use a token.");
  else if (recording.fault) say(`Not recorded: ${recording.fault}`);
  else if (on) say(`Recording: ${recording.frames} frames`);
  else if ($("record-status").textContent.startsWith("Recording")) say("");
  // the list changes with the first frame and after the last
  const now = `${on} ${recording.session} ${recording.frames > 0}`;
  if (now !== known) {
    known = now;
    listSessions().catch(e => say(e.message));
  }
}

function entry(session, current) {
  const { id, name, note, started, frames, format } = session;
  const title = name || id.replace("session-", ""), live = id === current;
  const button = (textContent, onclick, label) => element("button", { textContent, onclick, disabled: !allowed || live, ariaLabel: label });
  const download = (textContent, path, ending) =>
    element("a", { textContent, href: `sessions/${id}/${path}`, download: `${id}.${ending}`, ariaLabel: `Download ${title} as ${textContent}` });
  const downloads = [download("ZIP", "zip", "zip"), ...(format === "png16" ? [] : [download("OME-TIFF", "ome-tiff", "ome.tif")])];
  const image = element("img", { src: `sessions/${id}/thumbnail`, alt: "", loading: "lazy" });
  image.onerror = () => { image.removeAttribute("src"); };
  return element("li", { id },
    image,
    element("div", {}, element("b", { textContent: title }),
      element("p", { textContent: `${started.slice(0, 16).replace("T", " ")} · ${frames} frames · ${bytes(session.bytes)}${live ? " · being recorded" : ""}` }),
      ...(note ? [element("p", { textContent: note })] : [])),
    element("div", {}, ...downloads, button("Note", () => annotate(session), `Name and note of ${title}`), button("Delete", event => remove(event.target, id), `Delete ${title}`)));
}

async function listSessions(found) {
  const { sessions, current } = found ?? await ask("sessions");
  $("sessions").replaceChildren(...sessions.map(session => entry(session, current)));
}

// Deleting takes a second press.
async function remove(button, id) {
  if (button.dataset.sure !== "true") {
    button.dataset.sure = true;
    button.textContent = "Delete for good?";
    return;
  }
  try { await listSessions(await send(`sessions/${id}`, "DELETE")); } catch (e) { say(e.message); }
}

async function annotate({ id, name, note }) {
  const given = prompt("Name", name ?? "");
  if (given === null) return;
  const text = prompt("Note", note ?? "");
  if (text === null) return;
  try { await listSessions(await send(`sessions/${id}`, "POST", { name: given, note: text })); } catch (e) { say(e.message); }
}
