// Elements, buttons that show the command they stand for, and notices. Text is only ever set as text.
import { t } from "./strings.js";

const fill = (node, props, children) => {
  for (const [key, value] of Object.entries(props)) {
    if (value === undefined || value === null || value === false) continue;
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "class") node.setAttribute("class", value);
    else if (key === "data") Object.assign(node.dataset, value);
    else if (["value", "checked", "disabled", "selected", "indeterminate", "textContent"].includes(key)) node[key] = value;
    else node.setAttribute(key, value === true ? "" : String(value));
  }
  node.append(...children.flat(2).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
};

export const h = (tag, props = {}, ...children) => fill(document.createElement(tag), props, children);
export const svg = (tag, props = {}, ...children) => fill(document.createElementNS("http://www.w3.org/2000/svg", tag), props, children);

export const replace = (node, ...children) => node.replaceChildren(...children.flat(2).filter((child) => child !== null && child !== undefined && child !== false));

// -- the command bar ---------------------------------------------------------------------------------------------------------------------

const quote = (word) => (/^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`);
export const shell = (words) => words.map((word) => quote(String(word))).join(" ");

let command = "";
const bar = document.getElementById("command");
const line = h("code", { tabindex: 0 });
const copyButton = h("button", { type: "button", title: `${t.copyCommand} (C)`, onclick: () => copyCommand() }, t.copy);
bar.append(h("span", { class: "prompt", "aria-hidden": "true" }, "$"), line, copyButton);

export const showCommand = (words) => {
  command = typeof words === "string" ? words : shell(words);
  line.textContent = command || t.commandHint;
  line.classList.toggle("empty", !command);
  copyButton.disabled = !command;
};

export const copyCommand = async () => {
  if (!command) return;
  await navigator.clipboard.writeText(command).then(() => notice(t.copied), () => getSelection().selectAllChildren(line));
};

// A button; `words` are the command that it stands for, or a function that returns it.
export const action = (label, words, run, props = {}) => {
  const show = () => { const found = typeof words === "function" ? words() : words; if (found) showCommand(found); };
  const button = h("button", { type: "button", ...props, onpointerenter: show, onfocus: show }, label);
  button.addEventListener("click", async (event) => {
    show();
    button.setAttribute("aria-busy", "true");
    try {
      await run(event);
    } catch (error) {
      notice(error.message, "bad");
    } finally {
      button.removeAttribute("aria-busy");
    }
  });
  return button;
};

// -- notices and dialogs -----------------------------------------------------------------------------------------------------------------

export const notice = (text, kind = "") => {
  const box = h("p", { class: `notice ${kind}` }, text);
  document.getElementById("notices").append(box);
  setTimeout(() => box.remove(), kind === "bad" ? 12000 : 3000);
};

export const dialog = (title, ...content) => {
  const box = h("dialog", { "aria-label": title },
    h("div", { class: "dialog-head" }, h("h2", {}, title), h("button", { type: "button", class: "quiet", onclick: () => box.close() }, t.close)), ...content);
  box.addEventListener("close", () => box.remove());
  box.addEventListener("click", (event) => { if (event.target === box) box.close(); });
  document.body.append(box);
  box.showModal();
  return box;
};

export const select = (label, options, value, onchange) => {
  const box = h("select", { "aria-label": label, onchange: () => onchange(box.value) },
    options.map(([key, text]) => h("option", { value: key, selected: key === value }, text)));
  box.value = value;
  return box;
};

// Radio buttons that look like one control. Returns the element; its `pick(key)` chooses one.
export const choice = (label, options, value, onpick) => {
  const buttons = options.map(([key, text, hint]) => h("button", {
    type: "button", role: "radio", title: hint, data: { key }, "aria-checked": String(key === value), onclick: () => group.pick(key),
  }, text));
  const group = h("div", { class: "choice", role: "radiogroup", "aria-label": label }, buttons);
  group.pick = (key, quiet = false) => {
    for (const button of buttons) button.setAttribute("aria-checked", String(button.dataset.key === key));
    if (!quiet) onpick(key);
  };
  return group;
};

// -- numbers in words --------------------------------------------------------------------------------------------------------------------

export const bytes = (n) => (n < 1e6 ? `${Math.max(1, Math.round(n / 1e3))} kB` : n < 1e9 ? `${(n / 1e6).toFixed(1)} MB` : `${(n / 1e9).toFixed(1)} GB`);
export const grouped = (n) => String(Math.round(n)).replace(/\B(?=(\d{3})+$)/g, " ");
export const duration = (s) => (s < 90 ? `${Math.max(1, Math.round(s))} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`);
