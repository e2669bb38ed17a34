// Set-up: what is baked, what is up, where the front is, how large it is; in the scene after poses.
import { at, get, getBytes, photoUrl, post } from "./api.js";
import * as commands from "./commands.js";
import { action, choice, h, notice, replace, select } from "./dom.js";
import { go } from "./place.js";
import { scalePanel } from "./scale.js";
import { t } from "./strings.js";

const POINTS = { ground: 3, edge: 2 };
const round = (value) => Number(value.toPrecision(6));

export const open = async (capture, current) => {
  const data = await get(at(capture.name, "scene"));
  if (!data.cameras.length) {
    const node = h("div", { class: "empty-page" }, h("h2", {}, t.tabs.setup), h("p", { class: "soft" }, t.needsPoses),
      action(t.findCameras, commands.run(capture, "poses"), async () => { await post(at(capture.name, "run"), { until: "poses" }); go(capture.name, "run"); }, { class: "main", id: "find-cameras" }));
    return { node };
  }
  const { photos: listed } = await get(at(capture.name, "photos"));
  const versions = Object.fromEntries(listed.map((photo) => [photo.name, photo.version]));
  const photos = data.cameras.map((camera, index) => ({ ...camera, index, version: versions[camera.source] || "" }));

  const store = async (key, value) => {
    const found = await post(at(capture.name, "settings"), value === null ? { unset: [key] } : { set: { [key]: value } });
    Object.assign(capture, { stored: true, settings: found.settings });
    notice(t.saved);
  };
  const storeMany = async (body) => {
    const found = await post(at(capture.name, "settings"), body);
    Object.assign(capture, { stored: true, settings: found.settings });
    notice(t.saved);
  };

  const canvas = h("canvas", { class: "scene", tabindex: 0, role: "img", "aria-label": t.tabs.setup, id: "scene" });
  const info = h("span", { class: "soft" }, t.cameraCount(photos.length));
  const hint = h("span", { class: "soft hint" }, t.modeHints.look);
  let scene = null;

  // -- region ------------------------------------------------------------------------------------------------------------------------------

  const numbers = h("div", { class: "numbers" });
  const drawNumbers = () => {
    const region = scene?.region;
    if (!region) {
      replace(numbers, h("p", { class: "soft small" }, t.regionNone));
      return;
    }
    const field = (index, label, step) => h("input", { type: "number", step, value: round(region[index]), "aria-label": label, onchange: (event) => {
      const next = [...scene.region];
      const value = Number(event.target.value);
      if (Number.isFinite(value) && (index < 3 || value > 0)) next[index] = value;
      scene.region = next;
      scene.update();
      drawNumbers();
    } });
    const step = round(data.radius / 50);
    const turn = h("input", { type: "number", step: 1, value: Math.round((Math.atan2(region[9], region[6]) * 180) / Math.PI), "aria-label": t.turn, onchange: () => {
      const angle = (Number(turn.value) * Math.PI) / 180;
      const [c, s] = [Math.cos(angle), Math.sin(angle)];
      scene.region = [...scene.region.slice(0, 6), c, -s, 0, s, c, 0, 0, 0, 1];
      scene.update();
    } });
    replace(numbers,
      h("label", {}, t.centre, h("span", {}, [0, 1, 2].map((k) => field(k, `${t.centre} ${"xyz"[k]}`, step)))),
      h("label", {}, t.edges, h("span", {}, [0, 1, 2].map((k) => field(3 + k, `${t.edges} ${"xyz"[k]}`, step)))),
      h("label", {}, t.turn, h("span", {}, turn)));
  };
  const around = () => {
    scene.region = [...data.centre, 2 * data.radius, 2 * data.radius, 2 * data.radius, 1, 0, 0, 0, 1, 0, 0, 0, 1].map(round);
    modes.pick("box");
    scene.update();
    drawNumbers();
  };
  const regionWords = () => (scene?.region ? commands.set(capture, "poses.region_box", scene.region.map(round)) : "");
  const regionPanel = h("section", {}, h("h2", {}, t.region), numbers, h("div", { class: "bar" },
    action(t.regionNew, "", around, { id: "new-box" }),
    action(t.regionSave, regionWords, async () => { if (scene.region) await storeMany({ set: { "poses.region": "auto", "poses.region_box": scene.region.map(round) } }); }, { class: "main", id: "use-box" }),
    action(t.regionClear, () => commands.settings(capture, "--region", "none"), async () => {
      await storeMany({ set: { "poses.region": "none" }, unset: ["poses.region_box"] });
      scene.region = null;
      scene.update();
      drawNumbers();
    })));

  // -- up ----------------------------------------------------------------------------------------------------------------------------------

  const upState = h("span", { class: "soft" });
  const flat = () => scene.marks.flat().map(round);
  const upText = () => scene.marks.map((mark) => mark.map(round).join(",")).join(" ");
  const complete = () => scene && scene.marks.length === (POINTS[scene.mode] || 9);
  const drawUp = () => {
    const wanted = POINTS[scene?.mode];
    upState.textContent = wanted ? t.upPoints(scene.marks.length, wanted) : "";
    upUse.disabled = !complete();
  };
  const upUse = action(t.upUse, () => (complete() ? commands.settings(capture, "--up", upText()) : ""), () => store("export.up_points", flat()), { class: "main", id: "use-up", disabled: true });
  const upNow = () => (capture.settings["export.up_points"]?.length ? "points" : capture.settings["export.up"] || "cameras");
  const upSelect = select(t.up, Object.entries(t.upBy), upNow(), async (key) => {
    if (key === "points") modes.pick("ground");
    else await storeMany({ set: { "export.up": key }, unset: ["export.up_points"] });
  });
  const upPanel = h("section", {}, h("h2", {}, t.up), upSelect, h("div", { class: "bar" },
    action(t.modes.ground, "", () => modes.pick("ground"), { id: "up-ground" }), action(t.modes.edge, "", () => modes.pick("edge")), upState, upUse));

  // -- front and origin --------------------------------------------------------------------------------------------------------------------

  const preview = h("figure", { class: "preview", hidden: true });
  const frontSelect = select(t.front, [["", t.frontNone], ...photos.map((photo) => [photo.source, photo.source])], capture.settings["export.front"] || "", (value) => store("export.front", value || null));
  const choose = (index) => {
    const photo = photos[index];
    scene.chosen = index;
    scene.update();
    preview.hidden = false;
    replace(preview, h("img", { src: photoUrl(capture.name, { name: photo.source, version: photo.version }), alt: "" }), h("figcaption", {}, photo.source,
      action(t.frontThis, () => commands.settings(capture, "--front", photo.source), async () => { await store("export.front", photo.source); frontSelect.value = photo.source; }, { class: "small", id: "use-front" })));
  };
  const frontPanel = h("section", {}, h("h2", {}, t.front), frontSelect, preview);
  const originPanel = h("section", {}, h("h2", {}, t.origin),
    select(t.origin, Object.entries(t.origins), capture.settings["export.origin"] || "auto", (value) => store("export.origin", value === "auto" ? null : value)));

  // -- the page ----------------------------------------------------------------------------------------------------------------------------

  const modes = choice(t.tabs.setup, Object.entries(t.modes), "look", (mode) => {
    if (mode !== scene.mode) scene.marks = [];
    scene.setMode(mode);
    hint.textContent = t.modeHints[mode];
    drawUp();
  });
  const scale = scalePanel(capture, photos, store);
  const node = h("div", { class: "page wide" },
    h("div", { class: "setup" },
      h("div", { class: "left" }, h("div", { class: "stage" }, h("div", { class: "bar over" }, modes, h("span", { class: "grow" }), info), canvas, hint), scale.node),
      h("aside", { class: "panels" }, regionPanel, upPanel, frontPanel, originPanel)));

  const shown = async () => {
    try {
      const { Scene3D } = await import("./scene3d.js"); // three.js, which no other tab needs
      scene = new Scene3D(canvas, data, {
        onpoint: (point) => {
          if (scene.marks.length >= POINTS[scene.mode]) scene.marks = [];
          scene.marks.push(point);
          scene.update();
          drawUp();
        },
        oncamera: choose,
        onregion: drawNumbers,
      });
    } catch (error) {
      notice(error.message, "bad");
      return;
    }
    scene.region = capture.settings["poses.region_box"]?.length ? capture.settings["poses.region_box"] : data.region;
    scene.update();
    drawNumbers();
    drawUp();
    if (data.points) info.textContent = `${t.cameraCount(photos.length)}, ${t.pointCount(scene.setPoints(await getBytes(at(capture.name, "scene/points"))))}`;
    canvas.dataset.ready = "true";
    if (current()) scale.shown();
  };
  return { node, shown, leave: () => { scene?.close(); scale.close(); }, keys: {} };
};
