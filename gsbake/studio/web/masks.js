// Masks: a photo with its mask over it, and what is drawn on it. White is the object; what is kept is an ordinary mask file.
import { at, encPath, get, getBlob, photoUrl, postBlob, put } from "./api.js";
import { action, choice, h, notice, replace, showCommand } from "./dom.js";
import { Picture } from "./picture.js";
import { t } from "./strings.js";

const UNDO = 24;
const TOOLS = { b: "brush", e: "eraser", g: "polygon", s: "smart" };

const canvasOf = (width, height) => Object.assign(document.createElement("canvas"), { width, height });
const blobOf = (canvas) => new Promise((done) => canvas.toBlob(done, "image/png"));

export const open = async (capture, current) => {
  const listing = await get(at(capture.name, "masks"));
  const { photos } = listing;
  if (!photos.length) return { node: h("p", { class: "pad soft" }, t.noPhotos) };
  let index = 0;
  let tool = "brush";
  let size = 24;
  let opacity = 0.5;
  let visible = true;
  let changed = false;
  let mask = null; // canvas: black, white where the object is
  let tint = null; // canvas: the same as colour and transparency
  let stroke = null; // canvas of a smart stroke in progress
  let last = null;
  let corners = [];
  const undo = [];

  const picture = new Picture({
    label: t.tabs.masks,
    draw: (context, pixel) => drawOver(context, pixel),
    down: (point, event) => press(point, event),
    move: (point, event, pressed) => drag(point, pressed),
    up: (point, event, cancelled) => lift(event, cancelled),
  });

  const photo = () => photos[index];
  const path = () => at(capture.name, "masks", encPath(photo().name));
  const file = () => `${listing.folder}/${photo().name.replace(/\.[^.]*$/, ".png")}`;

  // -- the mask in memory ------------------------------------------------------------------------------------------------------------------

  const refreshTint = () => {
    const context = tint.getContext("2d");
    const pixels = mask.getContext("2d").getImageData(0, 0, mask.width, mask.height);
    for (let k = 0; k < pixels.data.length; k += 4) {
      const inside = pixels.data[k] > 127;
      pixels.data[k] = inside ? 40 : 22;
      pixels.data[k + 1] = inside ? 190 : 24;
      pixels.data[k + 2] = inside ? 120 : 44;
      pixels.data[k + 3] = inside ? 60 : 190;
    }
    context.putImageData(pixels, 0, 0);
    picture.draw();
  };

  const remember = () => {
    const copy = canvasOf(mask.width, mask.height);
    copy.getContext("2d").drawImage(mask, 0, 0);
    undo.push(copy);
    if (undo.length > UNDO) undo.shift();
    setChanged(true);
  };
  const setChanged = (value) => { changed = value; state.textContent = value ? t.unsaved : ""; };
  const stepBack = () => {
    const before = undo.pop();
    if (!before) return;
    mask.getContext("2d").drawImage(before, 0, 0);
    setChanged(true);
    refreshTint();
  };

  const line = (canvas, from, to, colour) => {
    const context = canvas.getContext("2d");
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = size / picture.view.scale;
    context.lineCap = context.lineJoin = "round";
    context.beginPath();
    context.moveTo(from.x, from.y);
    context.lineTo(to.x + 0.01, to.y);
    context.stroke();
  };

  // -- drawing on it -----------------------------------------------------------------------------------------------------------------------

  const press = (point, event) => {
    if (!mask) return;
    if (tool === "polygon") {
      if (corners.length > 2 && event.detail > 1) closePolygon(event.shiftKey);
      else corners.push(point);
      return;
    }
    last = point;
    if (tool === "smart") stroke = canvasOf(mask.width, mask.height);
    else remember();
    drag(point, true);
  };
  const drag = (point, pressed) => {
    if (!pressed || !last || !mask) return;
    if (stroke) line(stroke, last, point, "#fff");
    else {
      line(mask, last, point, tool === "brush" ? "#fff" : "#000");
      line(tint, last, point, tool === "brush" ? "rgb(40 190 120)" : "rgb(22 24 44)");
    }
    last = point;
  };
  const lift = (event, cancelled) => {
    if (!last) return;
    last = null;
    if (stroke) {
      const drawn = stroke;
      if (cancelled) stroke = null;
      else smart(drawn, event.shiftKey).catch((error) => notice(error.message, "bad")).finally(() => { stroke = null; picture.draw(); });
    } else refreshTint();
  };
  const closePolygon = (away) => {
    if (corners.length > 2) {
      remember();
      const context = mask.getContext("2d");
      context.fillStyle = away ? "#000" : "#fff";
      context.beginPath();
      corners.forEach(({ x, y }, k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.fill();
      refreshTint();
    }
    corners = [];
    picture.draw();
  };

  // Red: the mask; green: the stroke says object; blue: it says background.
  const smart = async (drawn, away) => {
    const both = canvasOf(mask.width, mask.height);
    const context = both.getContext("2d");
    const pixels = mask.getContext("2d").getImageData(0, 0, mask.width, mask.height);
    const marks = drawn.getContext("2d").getImageData(0, 0, mask.width, mask.height);
    for (let k = 0; k < pixels.data.length; k += 4) {
      const marked = marks.data[k + 3] > 127 ? 255 : 0;
      pixels.data[k + 1] = away ? 0 : marked;
      pixels.data[k + 2] = away ? marked : 0;
      pixels.data[k + 3] = 255;
    }
    context.putImageData(pixels, 0, 0);
    state.textContent = t.loading;
    const where = index;
    try {
      const found = await createImageBitmap(await postBlob(path(), await blobOf(both)));
      if (where !== index) return;
      remember();
      mask.getContext("2d").drawImage(found, 0, 0);
      refreshTint();
    } finally {
      setChanged(changed);
    }
  };

  const drawOver = (context, pixel) => {
    if (!tint) return;
    if (visible) {
      context.globalAlpha = opacity * 1.6 > 1 ? 1 : opacity * 1.6;
      context.drawImage(tint, 0, 0);
      context.globalAlpha = 1;
    }
    if (stroke) {
      context.globalAlpha = 0.85;
      context.drawImage(stroke, 0, 0);
      context.globalAlpha = 1;
    }
    const { pointer } = picture;
    context.lineWidth = 1.5 * pixel;
    if (tool === "polygon" && corners.length) {
      context.beginPath();
      [...corners, pointer].forEach(({ x, y }, k) => (k ? context.lineTo(x, y) : context.moveTo(x, y)));
      context.strokeStyle = "#fff";
      context.stroke();
    } else if (pointer && tool !== "polygon") {
      for (const [colour, radius] of [["rgb(0 0 0 / .6)", size / 2 + 1], ["#fff", size / 2]]) {
        context.strokeStyle = colour;
        context.beginPath();
        context.arc(pointer.x, pointer.y, radius * pixel, 0, 2 * Math.PI);
        context.stroke();
      }
    }
  };

  // -- one photo after the other -----------------------------------------------------------------------------------------------------------

  const save = async () => {
    if (!changed || !mask) return;
    const one = photo();
    showCommand(t.writesMask(file()));
    const found = await put(path(), await blobOf(mask));
    one.source = "file";
    one.doubtful = false;
    setChanged(false);
    drawList();
    notice(t.maskSaved(found.file));
  };
  const load = async () => {
    mask = tint = stroke = null;
    corners = [];
    undo.length = 0;
    setChanged(false);
    const one = photo();
    title.textContent = one.name;
    try {
      await picture.load(photoUrl(capture.name, one, "large"));
      const bitmap = await createImageBitmap(await getBlob(path()));
      if (one !== photo() || !current()) return;
      mask = canvasOf(bitmap.width, bitmap.height);
      tint = canvasOf(bitmap.width, bitmap.height);
      mask.getContext("2d", { willReadFrequently: true }).drawImage(bitmap, 0, 0);
      refreshTint();
      node.dataset.ready = one.name;
    } catch (error) {
      notice(error.message, "bad");
    }
  };
  const show = async (next) => {
    await save();
    index = (next + photos.length) % photos.length;
    drawList();
    await load();
  };

  // -- the page ----------------------------------------------------------------------------------------------------------------------------

  const list = h("div", { class: "strip", role: "listbox", "aria-label": t.tabs.photos });
  const drawList = () => {
    replace(list, photos.map((one, k) => h("button", {
      type: "button", class: `strip-item ${one.doubtful ? "doubtful" : ""}`, role: "option", "aria-selected": String(k === index), title: one.name,
      onclick: () => show(k).catch((error) => notice(error.message, "bad")),
    }, h("img", { src: photoUrl(capture.name, one), alt: "", loading: "lazy" }), h("span", {}, one.name), h("small", {}, one.doubtful ? t.doubtful : t.maskSources[one.source]))));
    list.children[index]?.scrollIntoView({ block: "nearest", inline: "nearest" });
  };

  const title = h("b", {}, photo().name);
  const state = h("span", { class: "state unfinished" });
  const hint = h("span", { class: "soft hint" }, t.toolHints[tool]);
  const useTool = (key) => { tool = key; corners = []; hint.textContent = t.toolHints[key]; picture.draw(); };
  const tools = choice(t.tabs.masks, Object.keys(t.tools).map((key) => [key, t.tools[key], `${t.toolHints[key]} (${Object.keys(TOOLS).find((one) => TOOLS[one] === key).toUpperCase()})`]), tool, useTool);
  const sizes = h("input", { type: "range", min: 3, max: 120, value: size, "aria-label": t.size, oninput: () => { size = Number(sizes.value); picture.draw(); } });
  const strength = h("input", { type: "range", min: 10, max: 100, value: 100 * opacity, "aria-label": t.opacity, oninput: () => { opacity = strength.value / 100; picture.draw(); } });
  const shows = h("input", { type: "checkbox", checked: visible, onchange: () => { visible = shows.checked; picture.draw(); } });
  const setSize = (factor) => { size = Math.min(120, Math.max(3, size * factor)); sizes.value = size; picture.draw(); };

  const node = h("div", { class: "work" },
    h("div", { class: "bar" }, tools, h("label", { class: "slim" }, t.size, sizes), h("label", { class: "slim" }, shows, t.overlay), h("label", { class: "slim" }, t.opacity, strength),
      action(t.undo, () => "", stepBack, { title: `${t.undo} (Z)` }), h("span", { class: "grow" }), title, state,
      action(t.saveMask, () => t.writesMask(file()), save, { class: "main", id: "save-mask", title: `${t.saveMask} (W)` }),
      action(t.next, () => t.writesMask(file()), () => show(index + 1), { title: `${t.next} (N)` })),
    h("div", { class: "split" }, h("aside", {}, h("p", { class: "soft small" }, t.doubtfulFirst), list), h("div", { class: "stage" }, picture.canvas, hint)));
  drawList();

  const pick = (key) => () => tools.pick(TOOLS[key]);
  return {
    node,
    shown: () => { load(); picture.canvas.focus({ preventScroll: true }); },
    leave: async () => { await save().catch((error) => notice(error.message, "bad")); picture.close(); },
    keys: {
      b: pick("b"), e: pick("e"), g: pick("g"), s: pick("s"), "[": () => setSize(0.8), "]": () => setSize(1.25), z: stepBack,
      v: () => { shows.checked = visible = !visible; picture.draw(); }, w: () => save().catch((error) => notice(error.message, "bad")),
      n: () => show(index + 1), p: () => show(index - 1),
      Enter: (event) => { if (tool !== "polygon" || !corners.length) return false; closePolygon(event.shiftKey); return true; },
      Escape: () => { corners = []; picture.draw(); },
    },
  };
};
