"use strict";
// Helpers that all parts of the page use. The browser sends the cookie of the login by itself.
const $ = id => document.getElementById(id);
const address = (path, query = {}) => {
  const q = new URLSearchParams(query).toString();
  return q ? `${path}?${q}` : path;
};
const ask = async (path, query) => {
  const answer = await fetch(address(path, query));
  if (answer.status === 401) location.reload();
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
};
const send = async (path, method, body) => {
  const answer = await fetch(path, { method, headers: { "Content-Type": "application/json" }, body: JSON.stringify(body ?? {}) });
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
};
const element = (name, properties, ...children) => {
  const e = Object.assign(document.createElement(name), properties);
  e.append(...children);
  return e;
};
