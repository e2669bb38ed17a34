// Requests to the server, all below its own address. An error becomes a sentence.
import { t } from "./strings.js";

export const enc = (text) => encodeURIComponent(text.toWellFormed ? text.toWellFormed() : text);
// A path whose slashes stay.
export const encPath = (text) => text.split("/").map(enc).join("/");
export const at = (capture, ...rest) => ["/api/captures", enc(capture), ...rest].join("/");

const answer = async (path, options) => {
  let found;
  try {
    found = await fetch(path, options);
  } catch {
    throw new Error(t.offline);
  }
  if (found.ok) return found;
  let why = found.status === 404 ? t.offline : String(found.status);
  try { why = (await found.json()).error || why; } catch { /* no JSON */ }
  throw Object.assign(new Error(why), { code: found.status });
};

export const get = async (path) => (await answer(path)).json();
export const getBytes = async (path) => (await answer(path)).arrayBuffer();
export const getBlob = async (path) => (await answer(path)).blob();
export const post = async (path, body = {}) => (await answer(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) })).json();
export const remove = async (path) => (await answer(path, { method: "DELETE", body: "{}" })).json();
export const put = async (path, body) => (await answer(path, { method: "PUT", body })).json();
export const postBlob = async (path, body) => (await answer(path, { method: "POST", body })).blob();

export const photoUrl = (capture, photo, size = "small") => `${at(capture, "photos", encPath(photo.name))}?size=${size}&v=${photo.version || ""}`;
