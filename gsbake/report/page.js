"use strict";
(() => {
  const root = document.documentElement;
  const bytes = (text) => Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));

  document.getElementById("theme").addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
  });

  for (const box of document.querySelectorAll(".compare")) {
    const slider = box.querySelector("input");
    slider.addEventListener("input", () => box.style.setProperty("--at", `${slider.value}%`));
  }

  const dialog = document.getElementById("large");
  for (const button of document.querySelectorAll("button.zoom")) {
    button.addEventListener("click", () => {
      const small = button.querySelector("img");
      const large = dialog.querySelector("img");
      large.src = small.src;
      large.alt = small.alt;
      dialog.showModal();
    });
  }
  dialog.addEventListener("click", () => dialog.close());

  const viewer = document.querySelector("model-viewer");
  if (!viewer) return;
  const model = document.getElementById("model").textContent;
  viewer.src = URL.createObjectURL(new Blob([bytes(model)], { type: "model/gltf-binary" }));
  const lights = document.querySelectorAll(".lights button");
  const urls = new Map();
  for (const button of lights) {
    button.addEventListener("click", () => {
      for (const other of lights) other.setAttribute("aria-pressed", String(other === button));
      const id = button.dataset.light;
      if (!id) {
        viewer.environmentImage = "neutral";
        return;
      }
      if (!urls.has(id)) urls.set(id, URL.createObjectURL(new Blob([bytes(document.getElementById(id).textContent)])));
      // The viewer determines the format from the URL's extension; a fragment does not change the loaded file.
      viewer.environmentImage = `${urls.get(id)}#light.hdr`;
    });
  }
  if (lights.length) lights[0].click();
})();
