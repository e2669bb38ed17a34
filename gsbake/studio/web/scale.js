// The scale by a known length: the same two ends clicked in two photos, with the epipolar line as a help.
import { at, photoUrl, post } from "./api.js";
import * as commands from "./commands.js";
import { action, h, notice, replace, select } from "./dom.js";
import { Picture } from "./picture.js";
import { t } from "./strings.js";

const KEY = "scale.known_distances";
const STEPS = ["a1", "a2", "b1", "b2"];

// `photos` are those with cameras; `store(key, value)` keeps a setting. Returns the panel's element and `close`.
export const scalePanel = (capture, photos, store) => {
  const known = () => capture.settings[KEY] || [];
  const sides = [{ index: 0 }, { index: Math.min(photos.length - 1, Math.max(1, Math.round(photos.length / 8))) }];
  let picks = {};
  let lines = {};
  const step = () => STEPS.find((name) => !picks[name]) || "done";
  const hint = h("p", { class: "hint soft" });
  const length = h("input", { type: "text", size: 8, "aria-label": t.length, placeholder: "8cm", title: t.lengthHint });

  const ratio = (side) => side.source.width / side.picture.image.naturalWidth;
  const text = () => {
    const end = (name) => [1, 2].map((k) => {
      const pick = picks[`${name}${k}`];
      return `${photos[sides[k - 1].index].source}:${pick.x.toFixed(1)},${pick.y.toFixed(1)}`;
    }).join("+");
    return step() === "done" ? `${end("a")} ${end("b")} ${length.value.trim() || "8cm"}` : "";
  };
  const words = () => commands.settings(capture, ...[...known(), text()].filter(Boolean).flatMap((one) => ["--known-distance", one]));

  const refresh = () => {
    hint.textContent = t.scaleSteps[step()];
    use.disabled = step() !== "done";
    for (const side of sides) side.picture.draw();
  };

  const click = async (number, point) => {
    const side = sides[number];
    const next = step();
    if (next === "done" || !side.picture.image) return;
    const name = `${next[0]}${number + 1}`;
    if (picks[name]) return;
    const scale = ratio(side);
    picks[name] = { x: point.x * scale, y: point.y * scale };
    refresh();
    const other = sides[1 - number];
    if (picks[`${name[0]}${2 - number}`]) return;
    try {
      const found = await post(at(capture.name, "scene/epipolar"), { photo: photos[side.index].source, other: photos[other.index].source, ...picks[name] });
      if (picks[name]) lines[`${name[0]}${2 - number}`] = found.line;
    } catch (error) {
      notice(error.message, "bad");
    }
    refresh();
  };

  const drawOver = (number) => (context, pixel) => {
    const side = sides[number];
    if (!side.source) return;
    const scale = 1 / ratio(side);
    for (const name of ["a", "b"]) {
      const key = `${name}${number + 1}`;
      const line = lines[key];
      if (line && !picks[key]) {
        for (const [colour, width] of [["rgb(0 0 0 / .6)", 3.5], ["#ffd24a", 1.5]]) {
          context.strokeStyle = colour;
          context.lineWidth = width * pixel;
          context.beginPath();
          line.forEach(([x, y], k) => (k ? context.lineTo(x * scale, y * scale) : context.moveTo(x * scale, y * scale)));
          context.stroke();
        }
      }
      const pick = picks[key];
      if (pick) {
        const [x, y] = [pick.x * scale, pick.y * scale];
        for (const [colour, width] of [["#000", 3.5], ["#ffd24a", 1.8]]) {
          context.strokeStyle = colour;
          context.lineWidth = width * pixel;
          context.beginPath();
          context.arc(x, y, 7 * pixel, 0, 2 * Math.PI);
          context.moveTo(x - 12 * pixel, y);
          context.lineTo(x + 12 * pixel, y);
          context.moveTo(x, y - 12 * pixel);
          context.lineTo(x, y + 12 * pixel);
          context.stroke();
        }
        context.font = `600 ${14 * pixel}px sans-serif`;
        context.fillStyle = "#fff";
        context.strokeStyle = "#000";
        context.lineWidth = 3 * pixel;
        context.strokeText(name.toUpperCase(), x + 11 * pixel, y - 9 * pixel);
        context.fillText(name.toUpperCase(), x + 11 * pixel, y - 9 * pixel);
      }
    }
  };

  const load = async (number) => {
    const side = sides[number];
    const photo = photos[side.index];
    side.source = photo.size;
    picks = {};
    lines = {};
    try { await side.picture.load(photoUrl(capture.name, { name: photo.source, version: photo.version }, "large")); } catch (error) { notice(error.message, "bad"); }
    refresh();
  };

  sides.forEach((side, number) => {
    side.picture = new Picture({ label: number ? t.rightPhoto : t.leftPhoto, draw: drawOver(number), up: (point, event, cancelled) => { if (!cancelled) click(number, point); } });
    side.node = h("div", { class: "pane" },
      select(number ? t.rightPhoto : t.leftPhoto, photos.map((photo, k) => [String(k), photo.source]), String(side.index), (value) => { side.index = Number(value); load(number); }), side.picture.canvas);
  });

  const use = action(t.useLength, words, async () => {
    await store(KEY, [...known(), text()]);
    picks = {};
    lines = {};
    drawKnown();
    refresh();
  }, { class: "main", id: "use-length", disabled: true });
  const list = h("ul", { class: "plain" });
  const drawKnown = () => replace(list, known().length ? known().map((one) => {
    const rest = known().filter((other) => other !== one);
    return h("li", {}, h("code", {}, one), action(t.remove, () => (rest.length ? commands.settings(capture, ...rest.flatMap((other) => ["--known-distance", other])) : commands.unset(capture, KEY)),
      async () => { await store(KEY, rest.length ? rest : null); drawKnown(); }, { class: "small" }));
  }) : h("li", { class: "soft" }, t.noLengths));
  drawKnown();

  const node = h("section", { class: "scale" }, h("h2", {}, t.scale), h("p", { class: "soft" }, t.scaleHint),
    h("div", { class: "bar" }, hint, h("span", { class: "grow" }), h("label", { class: "slim" }, t.length, length), use,
      action(t.startOver, "", () => { picks = {}; lines = {}; refresh(); })),
    h("div", { class: "panes" }, sides.map((side) => side.node)), h("h3", {}, t.lengths), list);
  length.addEventListener("input", refresh);
  return { node, shown: () => { load(0); load(1); }, close: () => sides.forEach((side) => side.picture.close()) };
};
