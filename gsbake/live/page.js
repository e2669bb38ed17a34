"use strict";
(() => {
  const at = (id) => document.getElementById(id);
  const made = (name, text, kind) => {
    const out = document.createElement(name);
    out.textContent = text;
    if (kind) out.className = kind;
    return out;
  };
  const svg = (name, attributes, text) => {
    const out = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) out.setAttribute(key, value);
    if (text !== undefined) out.textContent = text;
    return out;
  };

  const curve = (name, points) => {
    const xs = points.map((p) => p[0]);
    const ys = points.map((p) => p[1]);
    const [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const place = (p) => `${5 + (390 * (p[0] - x0)) / (x1 - x0 || 1)},${118 - (95 * (p[1] - y0)) / (y1 - y0 || 1)}`;
    const out = svg("svg", { viewBox: "0 0 400 130", role: "img", "aria-label": name });
    out.append(svg("text", { x: 5, y: 12 }, `${name}: ${Number(ys[ys.length - 1].toPrecision(5))}`));
    out.append(svg("polyline", { points: points.map(place).join(" ") }));
    return out;
  };

  const show = (state) => {
    at("stages").replaceChildren(...state.stages.map((stage) => {
      const row = document.createElement("tr");
      const progress = document.createElement("td");
      if (stage.status === "running" && stage.total) {
        const bar = document.createElement("progress");
        bar.max = stage.total;
        bar.value = stage.done;
        progress.append(bar, ` ${stage.done} of ${stage.total}`);
      } else progress.textContent = stage.took ? `${stage.status}, ${stage.took}` : stage.status;
      row.append(made("td", stage.name), progress, made("td", stage.left || ""), made("td", stage.text || "", "soft"));
      return row;
    }));
    const curves = Object.entries(state.curves).filter((entry) => entry[1].length > 1);
    if (curves.length) at("curves").replaceChildren(...curves.map(([name, points]) => curve(name, points)));
    at("lines").replaceChildren(...state.lines.slice().reverse().map((line) => made("li", `${line.stage}: ${line.text}`, line.kind)));
    const running = state.stages.find((stage) => stage.status === "running");
    const minutes = `${Math.floor(state.seconds / 60)} min ${String(Math.floor(state.seconds % 60)).padStart(2, "0")} s`;
    at("now").textContent = state.ended ? `The run has ended after ${minutes}.` : `${running ? running.title : "Waiting"}, ${minutes} so far`;
  };

  let ended = false;
  const update = async () => {
    try {
      const state = await (await fetch("state.json")).json();
      show(state);
      ended = state.ended;
      const image = new Image();
      image.onload = () => {
        at("picture").src = image.src;
        at("picture").hidden = false;
        at("none").hidden = true;
      };
      image.src = `picture.jpg?${Date.now()}`;
    } catch {
      at("now").textContent = "The run has ended.";
      ended = true;
    }
    if (!ended) setTimeout(update, 1500);
  };
  update();
})();
