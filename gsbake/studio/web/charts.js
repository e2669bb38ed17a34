// Curves of a run as small charts.
import { grouped, h, svg } from "./dom.js";

const WIDTH = 300;
const HEIGHT = 90;
const short = (value) => (Math.abs(value) >= 1000 ? grouped(value) : value !== 0 && Math.abs(value) < 0.01 ? value.toExponential(1) : Number(value.toPrecision(3)).toString());

export const chart = (name, points, index) => {
  const [xs, ys] = [points.map((point) => point[0]), points.map((point) => point[1])];
  const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const at = ([x, y]) => `${(((x - left) / (right - left || 1)) * WIDTH).toFixed(1)},${(HEIGHT - ((y - low) / (high - low || 1)) * HEIGHT).toFixed(1)}`;
  return h("figure", { class: "chart" },
    h("figcaption", {}, h("b", {}, name), h("span", { class: "soft" }, short(ys[ys.length - 1]))),
    svg("svg", { viewBox: `-2 -4 ${WIDTH + 4} ${HEIGHT + 8}`, preserveAspectRatio: "none", role: "img", "aria-label": `${name} ${short(ys[ys.length - 1])}` },
      svg("polyline", { class: `c${index % 5}`, points: points.map(at).join(" "), "vector-effect": "non-scaling-stroke" })),
    h("div", { class: "soft small ends" }, h("span", {}, short(low)), h("span", {}, short(high))));
};
