// The form of the settings, made from their own descriptions.
import { h, select } from "./dom.js";
import { t } from "./strings.js";

const shownValue = (value) => (Array.isArray(value) ? value.join(", ") : String(value));

const control = (field, value, onchange) => {
  const label = field.key;
  if (field.kind === "switch") return h("input", { type: "checkbox", checked: value, "aria-label": label, onchange: (event) => onchange(event.target.checked) });
  if (field.kind === "choice") {
    return select(label, field.choices.map((one) => [String(one), String(one)]), String(value), (text) => onchange(field.choices.find((one) => String(one) === text)));
  }
  if (field.kind === "number") {
    return h("input", { type: "number", value, min: field.least, max: field.most, step: field.whole ? 1 : "any", "aria-label": label,
      onchange: (event) => { if (event.target.value !== "" && event.target.reportValidity()) onchange(Number(event.target.value)); } });
  }
  return h("input", { type: "text", value: shownValue(value), "aria-label": label, onchange: (event) => {
    const text = event.target.value.trim();
    if (field.kind === "text") onchange(text);
    else onchange(text ? text.split(",").map((one) => (field.numbers ? Number(one) : one.trim())) : []);
  } });
};

// One row; `set(value)` keeps a value and `reset()` returns to the profile's.
export const row = (field, changed, value, set, reset) => h("div", { class: `field ${changed ? "changed" : ""}`, data: { key: field.key } },
  h("div", { class: "field-head" }, h("code", {}, field.key), changed ? h("button", { type: "button", class: "small quiet", title: `${t.reset}: ${shownValue(field.value)}`, onclick: reset }, "↺") : null),
  control(field, value, set),
  h("p", { class: "soft small" }, field.help, field.allowed ? ` (${field.allowed})` : ""));
