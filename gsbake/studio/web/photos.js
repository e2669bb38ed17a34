// The contact sheet: what the check found of each photo, and which ones are left out.
import { at, get, photoUrl, post } from "./api.js";
import { dropArea, uploadInto } from "./captures.js";
import * as commands from "./commands.js";
import { action, choice, dialog, h, replace, showCommand } from "./dom.js";
import { t } from "./strings.js";

// Share of clipped pixels, and stops from the median, from which a photo is marked.
const CLIPPED = 0.03;
const STOPS = 0.7;

const flagsOf = (photo, median) => {
  const flags = [];
  if (photo.skipped) flags.push(t.flags.skipped);
  if (photo.blurred) flags.push(t.flags.blurred);
  if (photo.clipped > CLIPPED) flags.push(t.flags.clipped);
  if (photo.registered === false) flags.push(t.flags.unplaced);
  if (photo.duplicate_of) flags.push(t.flags.duplicate);
  if (photo.exposure !== undefined && photo.exposure !== null && Math.abs(photo.exposure - median) > STOPS) flags.push(photo.exposure < median ? t.flags.dark : t.flags.bright);
  return flags;
};

export const open = async (capture, current) => {
  let found = await get(at(capture.name, "photos"));
  let filter = "all";
  let timer = 0;
  const sheet = h("div", { class: "sheet", role: "list" });
  const findings = h("div", { class: "findings" });
  const node = h("div", { class: "page" });
  const leftOut = () => found.photos.filter((photo) => photo.left_out).map((photo) => photo.name);

  const toggle = async (photo) => {
    photo.left_out = !photo.left_out;
    const names = leftOut();
    showCommand(commands.leaveOut(capture, names));
    try {
      await post(at(capture.name, "settings"), names.length ? { set: { "ingest.leave_out": names } } : { unset: ["ingest.leave_out"] });
      capture.stored = true;
    } catch (error) {
      photo.left_out = !photo.left_out;
      throw error;
    } finally {
      drawCell(photo);
      countFilters();
    }
  };

  const enlarge = (photo) => {
    let index = found.photos.indexOf(photo);
    const image = h("img", { class: "large", alt: photo.name });
    const caption = h("p", { class: "soft" });
    const show = () => {
      const one = found.photos[index];
      image.src = photoUrl(capture.name, one, "large");
      image.alt = one.name;
      caption.textContent = [one.name, one.blur !== undefined && one.blur !== null ? t.photoFacts(one.blur.toFixed(2), one.exposure.toFixed(1), (100 * one.clipped).toFixed(1)) : "", one.skipped || ""].filter(Boolean).join(" – ");
    };
    const box = dialog(photo.name, image, caption);
    box.classList.add("wide");
    box.addEventListener("keydown", (event) => {
      const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (step) index = (index + step + found.photos.length) % found.photos.length;
      if (step) show();
      if (event.key.toLowerCase() === "x") toggle(found.photos[index]);
    });
    show();
  };

  let filters = null;
  const countFilters = () => {
    const counts = { all: found.photos.length, flagged: found.photos.filter((photo) => flagsOf(photo, found.median).length).length, out: leftOut().length };
    for (const button of filters.children) button.textContent = `${t.filters[button.dataset.key]} ${counts[button.dataset.key]}`;
  };

  const cells = new Map();
  const drawCell = (photo) => {
    const cell = cells.get(photo.name);
    if (!cell) return;
    const flags = flagsOf(photo, found.median);
    cell.classList.toggle("out", photo.left_out);
    const out = action(photo.left_out ? t.takeAgain : t.leaveOut,
      () => commands.leaveOut(capture, photo.left_out ? leftOut().filter((name) => name !== photo.name) : [...leftOut(), photo.name]), () => toggle(photo), { tabindex: -1, class: "small" });
    const image = h("img", { src: photoUrl(capture.name, photo), alt: "", loading: "lazy", decoding: "async", onerror: () => { image.classList.add("broken"); image.alt = t.unreadable; } });
    replace(cell, image,
      h("div", { class: "flags" }, photo.left_out ? h("span", { class: "flag" }, t.leftOut) : null, flags.map((flag) => h("span", { class: "flag bad" }, flag))),
      h("div", { class: "cell-foot" }, h("span", { class: "name", title: photo.name }, photo.name), out));
  };

  const visible = () => found.photos.filter((photo) => filter === "all" || (filter === "out" ? photo.left_out : flagsOf(photo, found.median).length));
  const drawSheet = () => {
    cells.clear();
    replace(sheet, visible().map((photo, index) => {
      const cell = h("div", { class: "cell", role: "listitem", tabindex: index ? -1 : 0, "aria-label": [photo.name, ...flagsOf(photo, found.median)].join(", "), ondblclick: () => enlarge(photo) });
      cell.addEventListener("keydown", (event) => {
        if (event.target !== cell) return;
        const all = [...sheet.children];
        const columns = Math.max(1, all.filter((one) => one.offsetTop === all[0].offsetTop).length);
        const step = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: columns, ArrowUp: -columns }[event.key];
        if (step) {
          const next = all[all.indexOf(cell) + step];
          if (next) { cell.tabIndex = -1; next.tabIndex = 0; next.focus(); }
        } else if (event.key === "Enter") enlarge(photo);
        else if (event.key.toLowerCase() === "x") toggle(photo);
        else return;
        event.preventDefault();
        event.stopPropagation();
      });
      cells.set(photo.name, cell);
      return cell;
    }));
    found.photos.forEach(drawCell);
  };

  const drawFindings = () => replace(findings, found.checking ? h("p", { class: "soft busy" }, t.checking)
    : found.error ? h("p", { class: "bad" }, found.error)
    : found.checked ? found.findings.map((finding) => h("div", { class: `finding ${finding.level}`, title: t.levels[finding.level] },
        h("b", {}, finding.about), h("span", {}, finding.text), finding.do ? h("span", { class: "soft" }, finding.do) : null))
    : found.photos.length ? h("p", { class: "soft" }, t.notChecked) : null);

  const load = async () => {
    found = await get(at(capture.name, "photos"));
    if (!current()) return;
    draw();
    clearTimeout(timer);
    if (found.checking) timer = setTimeout(load, 1500);
  };

  const area = dropArea(t.addPhotos, async (files) => { if (await uploadInto(capture.name, files, area)) await load(); }, () => `cp … ${capture.source}/`);
  const draw = () => {
    const stops = found.photos.map((photo) => photo.exposure).filter((value) => value !== undefined && value !== null).sort((a, b) => a - b);
    found.median = stops.length ? stops[stops.length >> 1] : 0;
    filters = choice(t.tabs.photos, Object.keys(t.filters).map((key) => [key, ""]), filter, (key) => { filter = key; drawSheet(); });
    countFilters();
    replace(node, h("div", { class: "bar" }, h("h1", {}, t.tabs.photos), filters, h("span", { class: "grow" }),
      action(t.check, commands.check(capture), async () => { await post(at(capture.name, "check")); await load(); }, { class: "main", id: "check", disabled: found.checking || !(found.photos.length || found.video) })),
      findings, found.video ? h("p", { class: "soft" }, t.video) : null, sheet, area);
    drawFindings();
    drawSheet();
  };
  draw();
  if (found.checking) timer = setTimeout(load, 1500);
  return { node, leave: () => clearTimeout(timer), keys: {} };
};
