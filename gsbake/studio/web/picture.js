// A photo that fills a canvas: nearer and farther, moved, and pointed at by mouse, touch, pen or keys.
import { h } from "./dom.js";

const STEP = 12;

export class Picture {
  // `draw(context, toScreen)` draws over the image; `down`, `move`, `up` get positions in pixels of the image and the event.
  constructor({ label, draw = () => {}, down = () => {}, move = () => {}, up = () => {} }) {
    Object.assign(this, { drawOver: draw, down, move, up });
    this.canvas = h("canvas", { class: "picture", tabindex: 0, role: "img", "aria-label": label });
    this.image = null;
    this.view = { x: 0, y: 0, scale: 1 };
    this.pointer = null; // in pixels of the image
    this.keyed = false;
    this.pressed = false;
    this.touches = new Map();
    this.watch = new ResizeObserver(() => { if (this.image) { this.fit(); } });
    this.watch.observe(this.canvas);
    this.listen();
  }

  async load(url) {
    const image = new Image();
    image.src = url;
    await image.decode();
    this.image = image;
    this.keyed = false;
    this.pointer = { x: image.naturalWidth / 2, y: image.naturalHeight / 2 };
    this.fit();
  }

  close() { this.watch.disconnect(); }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const scale = Math.min(width / this.image.naturalWidth, height / this.image.naturalHeight) || 1;
    this.view = { scale, x: (width - scale * this.image.naturalWidth) / 2, y: (height - scale * this.image.naturalHeight) / 2 };
    this.draw();
  }

  zoom(factor, at) {
    const { x, y, scale } = this.view;
    const next = Math.min(40, Math.max(0.02, scale * factor));
    const centre = at || { x: this.canvas.clientWidth / 2, y: this.canvas.clientHeight / 2 };
    this.view = { scale: next, x: centre.x - ((centre.x - x) * next) / scale, y: centre.y - ((centre.y - y) * next) / scale };
    this.draw();
  }

  toImage(event) {
    const box = this.canvas.getBoundingClientRect();
    return { x: (event.clientX - box.left - this.view.x) / this.view.scale, y: (event.clientY - box.top - this.view.y) / this.view.scale };
  }

  draw() {
    if (!this.image || this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      const ratio = devicePixelRatio || 1;
      const { canvas, view } = this;
      const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
      if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
      const context = canvas.getContext("2d");
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, width, height);
      context.setTransform(ratio * view.scale, 0, 0, ratio * view.scale, ratio * view.x, ratio * view.y);
      context.imageSmoothingEnabled = view.scale < 3;
      context.drawImage(this.image, 0, 0);
      this.drawOver(context, 1 / view.scale);
      if (this.keyed && this.pointer) {
        const { x, y } = this.pointer;
        const arm = 12 / view.scale;
        for (const [colour, size] of [["#000", 3], ["#fff", 1.2]]) {
          context.strokeStyle = colour;
          context.lineWidth = size / view.scale;
          context.beginPath();
          context.moveTo(x - arm, y);
          context.lineTo(x + arm, y);
          context.moveTo(x, y - arm);
          context.lineTo(x, y + arm);
          context.stroke();
        }
      }
    });
  }

  listen() {
    const { canvas } = this;
    let last = null;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      if (!this.image) return;
      canvas.setPointerCapture(event.pointerId);
      this.touches.set(event.pointerId, { x: event.clientX, y: event.clientY });
      this.keyed = false;
      if (event.button === 0 && this.touches.size === 1) {
        this.pressed = true;
        this.pointer = this.toImage(event);
        this.down(this.pointer, event);
      } else {
        if (this.pressed) this.up(this.pointer, event, true);
        this.pressed = false;
        last = { x: event.clientX, y: event.clientY };
      }
      this.draw();
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.image) return;
      if (this.touches.size === 2 && this.touches.has(event.pointerId)) {
        const before = [...this.touches.values()];
        this.touches.set(event.pointerId, { x: event.clientX, y: event.clientY });
        const after = [...this.touches.values()];
        const gap = ([a, b]) => Math.hypot(a.x - b.x, a.y - b.y) || 1;
        const box = canvas.getBoundingClientRect();
        this.zoom(gap(after) / gap(before), { x: (after[0].x + after[1].x) / 2 - box.left, y: (after[0].y + after[1].y) / 2 - box.top });
        return;
      }
      if (last) {
        this.view = { ...this.view, x: this.view.x + event.clientX - last.x, y: this.view.y + event.clientY - last.y };
        last = { x: event.clientX, y: event.clientY };
      } else {
        this.keyed = false;
        const moves = event.getCoalescedEvents?.() || [event];
        for (const one of moves.length ? moves : [event]) {
          this.pointer = this.toImage(one);
          this.move(this.pointer, event, this.pressed);
        }
      }
      this.draw();
    });
    const release = (event) => {
      this.touches.delete(event.pointerId);
      last = null;
      if (this.pressed) this.up(this.pointer, event, event.type === "pointercancel");
      this.pressed = false;
      this.draw();
    };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const box = canvas.getBoundingClientRect();
      this.zoom(Math.exp(-event.deltaY / 400), { x: event.clientX - box.left, y: event.clientY - box.top });
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (!this.image) return;
      const move = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (move) {
        const step = (event.shiftKey ? 4 : 1) * (STEP / this.view.scale) / 3;
        this.keyed = true;
        this.pointer = { x: this.pointer.x + step * move[0], y: this.pointer.y + step * move[1] };
        this.move(this.pointer, event, this.pressed);
      } else if (event.key === " ") {
        if (!event.repeat) {
          this.keyed = this.pressed = true;
          this.down(this.pointer, event);
        }
      } else if (event.key === "+") this.zoom(1.25);
      else if (event.key === "-") this.zoom(0.8);
      else if (event.key === "0") this.fit();
      else return;
      event.preventDefault();
      event.stopPropagation();
      this.draw();
    });
    canvas.addEventListener("keyup", (event) => {
      if (event.key === " " && this.pressed) {
        this.up(this.pointer, event);
        this.pressed = false;
        this.draw();
      }
    });
  }
}
