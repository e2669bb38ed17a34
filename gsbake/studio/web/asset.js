// The asset: in 3D with maps and lights, against photos, beside another run, and its files for the places where it is used.
import { at, enc, encPath, get, post } from "./api.js";
import * as commands from "./commands.js";
import { action, bytes, choice, dialog, grouped, h, notice, replace, select, showCommand } from "./dom.js";
import { t } from "./strings.js";

let loading = null;
const viewerScript = () => (loading ||= new Promise((done, fail) => {
  delete window.__THREE__; // the viewer has a three.js of its own, and would warn of two
  document.head.append(Object.assign(document.createElement("script"), { src: "/web/vendor/model-viewer.min.js", onload: done, onerror: () => fail(new Error(t.offline)) }));
}));

const fileUrl = (capture, name, version, download) => `${at(capture.name, "files", encPath(name))}?v=${version}${download ? "&download" : ""}`;

const viewerOf = (capture, file) => h("model-viewer", {
  src: fileUrl(capture, "asset.glb", file.version), "camera-controls": true, "interaction-prompt": "none", "shadow-intensity": "0.6", "environment-image": "neutral",
  "tone-mapping": "neutral", alt: capture.name, "touch-action": "pan-y",
});

export const open = async (capture, current) => {
  const found = await get(at(capture.name, "asset"));
  const file = found.files["asset.glb"];
  if (!file) return { node: h("div", { class: "empty-page" }, h("h2", {}, t.tabs.asset), h("p", { class: "soft" }, t.noAsset)) };
  await viewerScript();

  // -- in 3D, with lights, maps and another run --------------------------------------------------------------------------------------------

  const viewers = h("div", { class: "viewers" }, viewerOf(capture, file));
  const each = (use) => [...viewers.querySelectorAll("model-viewer")].forEach(use);
  let environment = "neutral";
  const light = async (key) => {
    if (key === "own") environment = fileUrl(capture, "light.hdr", found.files["light.hdr"].version);
    else environment = key === "neutral" ? "neutral" : at(capture.name, "asset/pictures", (await get(at(capture.name, "asset/lights"))).key, `${key}.hdr`);
    each((viewer) => { viewer.setAttribute("environment-image", environment); });
  };
  const lights = choice(t.viewer, Object.entries(t.lights).filter(([key]) => key !== "own" || found.files["light.hdr"]), "neutral", (key) => light(key).catch((error) => notice(error.message, "bad")));
  const maps = h("div", { class: "maps" }, found.maps.map((name) => {
    const source = at(capture.name, "asset/maps", enc(name));
    const label = t.mapNames[name] || name;
    return h("button", { type: "button", class: "map", title: label, onclick: () => dialog(label, h("img", { class: "large", src: source, alt: label })).classList.add("wide") }, h("img", { src: source, alt: "", loading: "lazy" }), h("span", {}, label));
  }));
  const follow = (event) => each((viewer) => { if (viewer !== event.target && event.detail?.source === "user-interaction") { viewer.cameraOrbit = event.target.getCameraOrbit().toString(); viewer.fieldOfView = `${event.target.getFieldOfView()}deg`; viewer.jumpCameraToGoal(); } });
  const beside = async (name) => {
    const figures = viewers.querySelectorAll("model-viewer, .figures");
    [...figures].slice(1).forEach((node) => node.remove());
    viewers.classList.toggle("two", Boolean(name));
    if (!name) return;
    const [other, others] = await Promise.all([get(at(name)), get(at(name, "asset"))]);
    showCommand(commands.compare(capture, other));
    const second = viewerOf({ name }, others.files["asset.glb"]);
    second.setAttribute("environment-image", environment);
    viewers.append(second, h("div", { class: "figures" }, figuresOf(capture.name, found.report), figuresOf(name, others.report)));
    each((viewer) => viewer.addEventListener("camera-change", follow));
  };
  const figuresOf = (name, report) => h("dl", {}, h("dt", {}, name), ["psnr", "ssim", "triangles", "texture", "bytes"].filter((key) => report[key] !== null && report[key] !== undefined)
    .map((key) => h("dd", {}, key === "bytes" ? bytes(report[key]) : key === "triangles" ? `${grouped(report[key])} ${t.columns.triangles.toLowerCase()}` : `${key === "texture" ? "" : key.toUpperCase()} ${key === "ssim" ? report[key].toFixed(3) : key === "psnr" ? `${report[key].toFixed(1)} dB` : `${report[key]}²`}`)));

  // -- against a photo ---------------------------------------------------------------------------------------------------------------------

  const photoImage = h("img", { alt: t.comparePhoto, id: "compare-photo" });
  const renderImage = h("img", { class: "over", alt: t.render, id: "compare-render" });
  const slider = h("input", { type: "range", min: 0, max: 100, value: 50, "aria-label": t.slider, oninput: () => pair.style.setProperty("--at", `${slider.value}%`) });
  const tag = h("span", { class: "tag left" }, t.render);
  const pair = h("div", { class: "compare" }, photoImage, renderImage, tag, h("span", { class: "tag right" }, t.comparePhoto), slider);
  const score = h("span", { class: "soft", id: "compare-score" });
  let against = found.photos[0]?.name || "";
  let error = false;
  let view = null;
  const drawPair = () => {
    if (!view) return;
    const picture = (kind) => at(capture.name, "asset/pictures", view.key, `${kind}.jpg`);
    photoImage.src = picture("photo");
    renderImage.src = picture(error ? "error" : "render");
    tag.textContent = error ? t.errorMap : t.render;
  };
  const compare = async (name) => {
    against = name;
    score.textContent = t.drawing;
    view = await get(at(capture.name, "asset/views", enc(name)));
    if (!current()) return;
    score.textContent = t.psnr(view.psnr, view.ssim);
    pair.hidden = false;
    drawPair();
  };
  const comparePanel = h("section", {}, h("h2", {}, t.compare), h("div", { class: "bar" },
    select(t.comparePhoto, found.photos.map((photo) => [photo.name, photo.psnr ? `${photo.source} (${photo.psnr.toFixed(1)} dB)` : photo.source]), against, (name) => compare(name).catch((why) => { score.textContent = why.message; })),
    h("label", { class: "slim", title: t.errorHint }, h("input", { type: "checkbox", id: "error-map", onchange: (event) => { error = event.target.checked; drawPair(); } }), t.errorMap), score), pair);
  pair.hidden = true;

  // -- what to photograph next -------------------------------------------------------------------------------------------------------------

  const places = h("ul", { class: "plain" }, h("li", { class: "soft" }, t.loading));
  const fillPlaces = async () => {
    const { places: list } = await get(at(capture.name, "asset/places"));
    replace(places, list.length ? list.map((place) => h("li", {}, t.place(place.where, Math.round(100 * place.share)))) : h("li", { class: "soft" }, t.nothingMissing));
  };

  // -- targets -----------------------------------------------------------------------------------------------------------------------------

  const stem = (name, form) => (name === "surfels" ? "surfels.ply" : ["usdz", "usdc", "obj"].includes(form) ? `asset${name === "default" ? "" : `_${name}`}.${form}` : `asset${name === "default" ? "" : `_${name}`}${form ? `_${form}` : ""}.glb`);
  const targets = h("tbody");
  let timer = 0;
  const wanted = (name, form) => [...new Set([...found.targets, form ? `${name}:${form}` : name])];
  const make = async (name, form) => {
    const names = wanted(name, form);
    await post(at(capture.name, "settings"), { set: { "targets.files": names } });
    await post(at(capture.name, "run"), { until: "targets" });
    found.targets = names;
    const wait = async () => {
      const state = await get(at(capture.name, "run"));
      if (!current()) return;
      if (state.runs || state.starting) {
        timer = setTimeout(() => wait().catch((why) => notice(why.message, "bad")), 1000);
        return;
      }
      if (state.message) notice(state.message, "bad");
      found.files = (await get(at(capture.name, "asset"))).files;
      drawTargets();
    };
    timer = setTimeout(() => wait().catch((why) => notice(why.message, "bad")), 1000);
  };
  const drawTargets = () => replace(targets, found.budgets.map((budget) => {
    let form = "";
    const actions = h("td", {});
    const name = h("code", {});
    const size = h("td", { class: "num" });
    const fill = () => {
      const file = stem(budget.name, form);
      const there = found.files[file];
      name.textContent = file;
      size.textContent = there ? bytes(there.bytes) : "";
      replace(actions, there ? h("a", { class: "button", href: fileUrl(capture, file, there.version, true), download: true, data: { target: budget.name } }, t.download) : null,
        budget.name === "default" && !form ? null : action(t.makeTarget, () => commands.target(capture, wanted(budget.name, form)), async (event) => {
          const button = event.currentTarget || actions.lastChild;
          await make(budget.name, form);
          button.textContent = t.making;
          button.disabled = true;
        }, { class: "small", data: { make: budget.name } }));
    };
    fill();
    return h("tr", {}, h("td", {}, h("b", {}, t.target[budget.name])), h("td", { class: "soft" }, t.budget(budget.megabytes, budget.triangles && grouped(budget.triangles), budget.texture)),
      h("td", {}, budget.name === "surfels" ? null : select(t.form, [["", t.plainForm], ...found.forms.flat().map((one) => [one, one])], form, (value) => { form = value; fill(); }), " ", name), size, actions);
  }));
  drawTargets();
  const files = h("details", {}, h("summary", {}, t.otherFiles), h("ul", { class: "plain" }, Object.entries(found.files).map(([name, one]) => h("li", {}, h("a", { href: fileUrl(capture, name, one.version, true), download: true }, name), " ", h("span", { class: "soft" }, bytes(one.bytes))))));

  const node = h("div", { class: "page wide asset" },
    h("div", { class: "bar" }, lights, h("span", { class: "grow" }),
      found.others.length ? select(t.beside, [["", t.besideNone], ...found.others.map((name) => [name, `${t.beside}: ${name}`])], "", (name) => beside(name).catch((why) => notice(why.message, "bad"))) : null,
      found.files["report.html"] ? h("a", { class: "button", href: fileUrl(capture, "report.html", found.files["report.html"].version), target: "_blank", rel: "noopener" }, t.report) : null),
    viewers, maps, found.photos.length ? comparePanel : null,
    h("section", {}, h("h2", {}, t.nextPhotos), places),
    h("section", {}, h("h2", {}, t.targets), h("div", { class: "scroll" }, h("table", {}, h("thead", {}, h("tr", {}, t.targetHead.map((head) => h("th", {}, head)))), targets)), files));
  return {
    node,
    shown: async () => {
      if (against) await compare(against).catch((why) => { score.textContent = why.message; });
      if (current()) await fillPlaces().catch((why) => replace(places, h("li", { class: "bad" }, why.message)));
    },
    leave: () => { clearTimeout(timer); each((viewer) => viewer.remove()); },
    keys: {},
  };
};
