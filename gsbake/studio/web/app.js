// The page: its address chooses a capture and a tab; keys for both; light and dark.
import { at, get } from "./api.js";
import * as asset from "./asset.js";
import * as captures from "./captures.js";
import { copyCommand, dialog, h, notice, replace, showCommand } from "./dom.js";
import * as masks from "./masks.js";
import * as photos from "./photos.js";
import { go, place } from "./place.js";
import * as run from "./run.js";
import * as setup from "./setup.js";
import { t } from "./strings.js";

const TABS = { photos, masks, setup, run, asset };
const view = document.getElementById("view");
const top = document.getElementById("top");
let shown = { leave: () => true, keys: {} };
let opening = 0;

const dark = () => (document.documentElement.dataset.theme ? document.documentElement.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches);
const turnLights = () => {
  const theme = dark() ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  try { localStorage.setItem("theme", theme); } catch { /* not kept */ }
  dispatchEvent(new Event("themechange"));
};

const drawTop = ({ name, tab }) => {
  const links = Object.keys(TABS).map((key, index) => h("a", {
    href: `#/${encodeURIComponent(name)}/${key}`, "aria-current": key === tab ? "page" : null, title: `${t.tabs[key]} (${index + 1})`,
  }, t.tabs[key]));
  replace(top,
    h("a", { class: "brand", href: "#/", title: `${t.back} (0)` }, h("img", { src: "/web/icon.svg", alt: "", width: 22, height: 22 }), h("span", {}, t.brand)),
    name ? h("span", { class: "capture-name" }, name) : null,
    name ? h("nav", { "aria-label": name }, links) : h("span", { class: "grow" }),
    h("button", { type: "button", class: "quiet", title: `${t.keys} (?)`, "aria-label": t.keys, onclick: showKeys }, "?"),
    h("button", { type: "button", class: "quiet", title: `${t.theme} (T)`, "aria-label": t.theme, onclick: turnLights }, "◐"));
};

const showKeys = () => dialog(t.keys, h("div", { class: "keys" }, t.keyHelp.map(([title, rows]) => h("section", {}, h("h3", {}, title),
  h("dl", {}, rows.flatMap(([key, what]) => [h("dt", {}, key), h("dd", {}, what)]))))));

const open = async () => {
  const token = ++opening;
  const where = place();
  await shown.leave?.();
  shown = { keys: {} };
  drawTop(where);
  showCommand("");
  document.title = where.name ? `${where.name}: ${t.tabs[where.tab]} – ${t.brand}` : t.brand;
  replace(view, h("p", { class: "soft pad" }, t.loading));
  try {
    let next;
    if (where.name) {
      const [capture, settings] = await Promise.all([get(at(where.name)), get(at(where.name, "settings")).catch(() => ({ settings: {}, stored: false }))]);
      next = await TABS[where.tab].open({ ...capture, stored: settings.stored, profile: settings.profile, settings: settings.settings }, () => token === opening);
    } else {
      next = await captures.open(() => token === opening);
    }
    if (token !== opening) {
      next.leave?.();
      return;
    }
    shown = next;
    replace(view, next.node);
    next.shown?.();
  } catch (error) {
    if (token === opening) replace(view, h("p", { class: "pad bad" }, error.message));
  }
};

const typing = (target) => target instanceof HTMLElement && (target.isContentEditable || /^(TEXTAREA|SELECT)$/.test(target.tagName)
  || (target.tagName === "INPUT" && !/^(checkbox|radio|range|button|color)$/.test(target.type)));

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || typing(event.target) || document.querySelector("dialog[open]")) return;
  const own = shown.keys?.[event.key] || shown.keys?.[event.key.toLowerCase()];
  const { name } = place();
  const tabs = Object.keys(TABS);
  const common = {
    "?": showKeys, t: turnLights, c: copyCommand, 0: () => go(""),
    ...Object.fromEntries(tabs.map((tab, index) => [String(index + 1), () => name && go(name, tab)])),
  };
  const found = own || common[event.key.toLowerCase()];
  if (!found) return;
  if (found(event) !== false) event.preventDefault();
});
addEventListener("hashchange", open);
addEventListener("unhandledrejection", (event) => { notice(event.reason?.message || String(event.reason), "bad"); event.preventDefault(); });
addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => event.preventDefault());

try { document.documentElement.dataset.theme = localStorage.getItem("theme") || ""; } catch { /* not kept */ }
if (!document.documentElement.dataset.theme) delete document.documentElement.dataset.theme;
if (location.search) history.replaceState(null, "", `/${location.hash}`);
open();
