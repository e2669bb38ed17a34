// The list of captures, and new ones from dropped files.
import { at, get, post } from "./api.js";
import { action, h, notice, replace, showCommand } from "./dom.js";
import { go } from "./place.js";
import { t } from "./strings.js";
import { upload } from "./upload.js";

// An area that takes dropped or chosen files: `onfiles(files)`.
export const dropArea = (label, onfiles, words) => {
  const input = h("input", { type: "file", multiple: true, hidden: true, accept: "image/*,video/*,.heic,.dng,.cr2,.cr3,.nef,.arw,.raf,.exr", onchange: () => { if (input.files.length) onfiles([...input.files]); input.value = ""; } });
  const area = h("div", { class: "drop" }, action(label, words, () => input.click()), h("span", { class: "soft" }, t.dropHere), input);
  const over = (on) => area.classList.toggle("over", on);
  area.addEventListener("dragover", (event) => { event.preventDefault(); over(true); });
  area.addEventListener("dragleave", () => over(false));
  area.addEventListener("drop", (event) => {
    event.preventDefault();
    event.stopPropagation();
    over(false);
    if (event.dataTransfer.files.length) onfiles([...event.dataTransfer.files]);
  });
  return area;
};

// Progress of an upload in place of the drop area.
export const uploadInto = async (capture, files, area) => {
  const bar = h("progress", { max: 1, value: 0 });
  const text = h("span", { class: "soft" });
  const row = h("div", { class: "drop busy" }, bar, text);
  area.replaceWith(row);
  const arrived = await upload(capture, files, (label, share) => { text.textContent = label; bar.value = share; });
  row.replaceWith(area);
  if (arrived) notice(t.uploaded(arrived));
  return arrived;
};

const nameOf = (files) => {
  const stem = files[0].name.replace(/\.[^.]*$/, "").replace(/[^\w-]+/g, "-").replace(/^-+|-+$/g, "");
  return files.length === 1 && stem ? stem : "capture";
};

export const open = async (current) => {
  const found = await get("/api/captures");
  const body = h("tbody");
  const list = h("table", { class: "captures" },
    h("thead", {}, h("tr", {}, h("th"), h("th", {}, t.columns.capture), h("th", {}, t.columns.state),
      found.columns.map((column) => h("th", { class: "num" }, t.columns[column] || column)))), body);

  const rows = found.captures.map((capture) => {
    const state = h("td", {});
    const cells = found.columns.map(() => h("td", { class: "num" }));
    const link = h("a", { href: `#/${encodeURIComponent(capture.name)}/photos` }, capture.name);
    link.addEventListener("focus", () => showCommand(["gsbake", "status", "--out", capture.out]));
    body.append(h("tr", { onclick: (event) => { if (event.target.tagName !== "A") go(capture.name); } },
      h("td", { class: "thumb" }, h("img", { src: at(capture.name, "thumbnail"), alt: "", loading: "lazy", width: 72, height: 54, onerror: (event) => event.target.classList.add("broken") })),
      h("td", {}, link, h("div", { class: "soft small" }, capture.source)), state, cells));
    return { capture, state, cells };
  });

  const fillRow = async ({ capture, state, cells }) => {
    const details = await get(at(capture.name));
    if (!current()) return details;
    const kind = details.state;
    const word = kind === "unfinished" || kind === "running" ? `${t.states[kind]}, ${t.stagesDone(details.done, details.stages)}` : t.states[kind];
    replace(state, h("span", { class: `state ${kind}` }, word), details.message && kind !== "empty" ? h("div", { class: "soft small" }, details.message) : null);
    details.cells.forEach((cell, index) => { cells[index].textContent = cell.text; });
    if (details.count && !details.cells[0]?.text) cells[0].textContent = details.count;
    return details;
  };

  let timer = 0;
  const refresh = async () => {
    const details = [];
    for (const row of rows) if (current()) details.push(await fillRow(row));
    clearTimeout(timer);
    if (current() && details.some((one) => one.state === "running")) timer = setTimeout(() => { if (!document.hidden) refresh(); }, 3000);
  };
  document.addEventListener("visibilitychange", refresh);

  const make = async (files) => {
    const base = nameOf(files);
    const taken = new Set(found.captures.map((capture) => capture.name.toLowerCase()));
    let name = base;
    for (let number = 2; taken.has(name.toLowerCase()); number += 1) name = `${base}-${number}`;
    const chosen = await ask(name, files);
    if (!chosen) return;
    const capture = await post("/api/captures", { name: chosen });
    if (await uploadInto(capture.name, files, area)) go(capture.name);
  };

  const ask = (name, files) => new Promise((done) => {
    const field = h("input", { type: "text", value: name, maxlength: 80, required: true, "aria-label": t.captureName });
    const form = h("form", { class: "inline", onsubmit: (event) => { event.preventDefault(); form.replaceWith(area); done(field.value.trim()); } },
      h("label", {}, t.captureName, field), h("span", { class: "soft" }, t.photoCount(files.length)),
      h("button", { type: "submit", class: "main" }, t.create), h("button", { type: "button", onclick: () => { form.replaceWith(area); done(""); } }, t.cancel));
    area.replaceWith(form);
    const show = () => showCommand(`mkdir -p ${field.value}/images && cp … ${field.value}/images/`);
    field.addEventListener("input", show);
    show();
    field.focus();
    field.select();
  });
  const area = dropArea(t.chooseFiles, (files) => make(files).catch((error) => notice(error.message, "bad")), "mkdir -p NAME/images && cp … NAME/images/");

  const node = h("div", { class: "page" }, h("h1", {}, t.capturesTitle(found.folder)),
    found.grows ? area : null,
    rows.length ? h("div", { class: "scroll" }, list) : h("div", { class: "empty-page" }, h("h2", {}, t.noCaptures), h("p", { class: "soft" }, t.noCapturesHint)));
  return { node, shown: refresh, leave: () => { clearTimeout(timer); document.removeEventListener("visibilitychange", refresh); }, keys: {} };
};
