// Runs: settings, what the next run will do and take, and the one in progress.
import { at, get, post, remove } from "./api.js";
import { chart } from "./charts.js";
import * as commands from "./commands.js";
import { action, bytes, duration, h, notice, replace, select, showCommand } from "./dom.js";
import { row } from "./form.js";
import { t } from "./strings.js";

const POLL = 1500;
const PICTURE = 4000;

export const open = async (capture, current) => {
  let form = await get(`/api/settings?profile=${encodeURIComponent(capture.profile || "")}`).catch(() => get("/api/settings"));
  let plan = { stages: [], seconds: 0, memory: 0 };
  let live = await get(at(capture.name, "run"));
  let until = "";
  let timer = 0;
  let pictured = 0;
  let pictureUrl = "";

  // -- settings ----------------------------------------------------------------------------------------------------------------------------

  const main = h("div", { class: "fields" });
  const others = h("div", { class: "fields" });
  const search = h("input", { type: "search", placeholder: t.search, "aria-label": t.search, oninput: () => drawOthers() });
  const keep = async (body, words) => {
    showCommand(words);
    const found = await post(at(capture.name, "settings"), body);
    Object.assign(capture, { stored: true, settings: found.settings, profile: found.profile });
    drawForm();
    await replan();
  };
  const rowOf = (field) => {
    const changed = field.key in capture.settings;
    return row(field, changed, changed ? capture.settings[field.key] : field.value,
      (value) => keep({ set: { [field.key]: value } }, commands.set(capture, field.key, value)).catch((error) => { notice(error.message, "bad"); drawForm(); }),
      () => keep({ unset: [field.key] }, commands.unset(capture, field.key)));
  };
  const drawOthers = () => {
    const text = search.value.toLowerCase();
    replace(others, form.settings.filter((field) => field.first === null && !field.elsewhere && (!text || `${field.key} ${field.help}`.toLowerCase().includes(text)))
      .map(rowOf));
  };
  const more = h("details", { ontoggle: () => { if (more.open) drawOthers(); } }, h("summary", {}, t.more), search, others);
  const profiles = h("div", {});
  const drawForm = () => {
    replace(profiles, select(t.profile, Object.entries(form.profiles).map(([name, about]) => [name, `${name} – ${about}`]), form.profile, async (name) => {
      try {
        await keep({ profile: name }, commands.settings(capture, "--profile", name));
        form = await get(`/api/settings?profile=${encodeURIComponent(name)}`);
        drawForm();
      } catch (error) { notice(error.message, "bad"); }
    }));
    replace(main, form.settings.filter((field) => field.first !== null).sort((a, b) => a.first - b.first).map(rowOf));
    if (more.open) drawOthers();
  };

  // -- the next run ------------------------------------------------------------------------------------------------------------------------

  const buttons = h("div", { class: "bar" });
  const estimate = h("span", { class: "soft" });
  const stages = h("ol", { class: "stages" });
  const message = h("p", { class: "bad" });
  const running = () => live.runs || live.starting;
  const todo = () => plan.stages.filter((stage) => stage.status === "run" || stage.status === "waits").length;

  const replan = async () => {
    try {
      plan = await post(at(capture.name, "plan"));
      message.textContent = "";
    } catch (error) {
      message.textContent = error.message;
    }
    if (current()) drawRun();
  };

  const drawRun = () => {
    const began = plan.stages.some((stage) => stage.status === "cached");
    const label = todo() ? (began ? t.resume : t.run) : t.runAgain;
    estimate.textContent = running() ? "" : todo() ? t.estimate(duration(plan.seconds), bytes(plan.memory)) : plan.stages.length ? t.nothingToDo : "";
    replace(buttons,
      running()
        ? action(live.starting ? t.starting : live.stopping ? t.stopping : t.stop, live.pid ? `kill ${live.pid}` : "", async () => { await remove(at(capture.name, "run")); live.stopping = true; drawRun(); }, { id: "stop", disabled: live.starting || live.stopping })
        : action(label, () => commands.run(capture, until || "run"), async () => {
            await post(at(capture.name, "run"), until ? { until } : {});
            capture.stored = true;
            live = { starting: true, runs: false, stages: [], curves: {}, lines: [] };
            drawLive();
            poll();
          }, { class: "main", id: "run", disabled: !plan.stages.length }),
      running() ? null : select(t.until, [["", `${t.until} ${t.untilAll}`], ...plan.stages.map((stage) => [stage.name, `${t.until} ${stage.name}`])], until, (value) => { until = value; }),
      estimate);
    drawStages();
  };

  const drawStages = () => {
    const states = running() && live.stages?.length ? live.stages : plan.stages;
    replace(stages, states.map((stage) => {
      const share = stage.total ? stage.done / stage.total : 0;
      const detail = [stage.total ? `${stage.done} / ${stage.total}` : "", stage.text, stage.took, stage.left, stage.seconds ? duration(stage.seconds) : "", stage.status === "run" ? (stage.reasons || []).join("; ") : ""];
      return h("li", { class: stage.status }, h("b", {}, stage.title || stage.name), h("span", { class: "state" }, t.stageStates[stage.status] || stage.status),
        stage.status === "running" ? h("progress", stage.total ? { max: 1, value: share } : {}) : null, h("span", { class: "soft small" }, detail.filter(Boolean).join(", ")));
    }));
  };

  // -- the run in progress -----------------------------------------------------------------------------------------------------------------

  const picture = h("img", { class: "live-picture", alt: t.picture, hidden: true, id: "live-picture" });
  const curves = h("div", { class: "charts" });
  const lines = h("ul", { class: "lines plain" });
  const end = h("p", { id: "end" });

  const drawLive = () => {
    drawRun();
    replace(curves, Object.entries(live.curves || {}).filter(([, points]) => points.length > 1).map(([name, points], index) => chart(name, points, index)));
    replace(lines, live.lines?.length ? [...live.lines].reverse().map((line) => h("li", { class: line.kind }, h("b", {}, line.stage), h("span", {}, line.text))) : h("li", { class: "soft" }, t.noDecisions));
    const failed = live.message || (live.killed ? t.runKilled : "");
    end.textContent = running() ? "" : failed || (live.ended ? t.runDone : live.stages ? "" : t.noRun);
    end.className = running() || !live.stages?.length ? "soft" : failed ? "bad" : "good";
  };

  const showPicture = async () => {
    if (!live.runs || Date.now() - pictured < PICTURE) return;
    pictured = Date.now();
    const found = await fetch(at(capture.name, "picture"));
    if (found.status !== 200 || !current()) return;
    URL.revokeObjectURL(pictureUrl);
    pictureUrl = URL.createObjectURL(await found.blob());
    picture.src = pictureUrl;
    picture.hidden = false;
  };

  const poll = async () => {
    clearTimeout(timer);
    if (document.hidden || !current()) return;
    const before = running();
    try {
      const stopping = live.stopping;
      live = await get(at(capture.name, "run"));
      live.stopping = stopping && live.runs;
    } catch (error) {
      message.textContent = error.message;
    }
    if (!current()) return;
    drawLive();
    showPicture().catch(() => {});
    if (running()) timer = setTimeout(poll, POLL);
    else if (before) await replan();
  };
  const onvisible = () => { if (!document.hidden) poll(); };
  document.addEventListener("visibilitychange", onvisible);

  drawForm();
  drawLive();
  const node = h("div", { class: "page wide run" },
    h("aside", { class: "settings" }, h("h2", {}, t.profile), profiles, h("h2", {}, t.settings), main, more),
    h("div", { class: "progress" }, buttons, message, end, stages, h("div", { class: "live" }, picture, curves), h("h2", {}, t.decisions), lines));
  return {
    node,
    shown: () => { replan(); if (running()) poll(); },
    leave: () => { clearTimeout(timer); document.removeEventListener("visibilitychange", onvisible); URL.revokeObjectURL(pictureUrl); },
    keys: {},
  };
};
