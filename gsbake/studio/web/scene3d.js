// The scene after poses in three.js: cameras, points, the region with handles, and picking. It is drawn when something changes, never idle.
import * as THREE from "/web/vendor/three.module.min.js";

THREE.ColorManagement.enabled = false;
const PICK = 14; // pixels
const FRUSTUM = 0.16; // length of a camera as a share of the object's radius
const css = (name) => new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue(name).trim() || "#888");

export class Scene3D {
  // `onpoint(position)`, `oncamera(index)` and `onregion(region)` are called for what was clicked or dragged.
  constructor(canvas, data, { onpoint, oncamera, onregion }) {
    Object.assign(this, { canvas, data, onpoint, oncamera, onregion });
    this.mode = "look";
    this.region = null;
    this.marks = [];
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(45, 1, data.radius / 100, data.radius * 400);
    this.camera.up.set(0, 0, 1);
    this.target = new THREE.Vector3(...data.centre);
    this.orbit = { turn: 0.7, tilt: 0.45, distance: 3.6 * data.radius };
    this.changing = new THREE.Group();
    this.scene.add(this.changing);
    this.addCameras();
    this.addGround();
    this.watch = new ResizeObserver(() => this.draw());
    this.watch.observe(canvas);
    this.onTheme = () => { this.addCameras(); this.addGround(); this.update(); };
    addEventListener("themechange", this.onTheme);
    this.listen();
    this.update();
  }

  close() {
    this.watch.disconnect();
    removeEventListener("themechange", this.onTheme);
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  addCameras() {
    this.cameras?.removeFromParent();
    const at = [];
    const { radius } = this.data;
    for (const { centre, corners } of this.data.cameras) {
      const ends = corners.map((ray) => centre.map((value, k) => value + FRUSTUM * radius * ray[k]));
      ends.forEach((end, k) => at.push(...centre, ...end, ...end, ...ends[(k + 1) % 4]));
    }
    this.cameras = this.lines(at, css("--c1"));
    this.scene.add(this.cameras);
  }

  addGround() {
    this.grid?.removeFromParent();
    const { radius, centre } = this.data;
    this.grid = new THREE.GridHelper(8 * radius, 16, css("--line"), css("--line"));
    this.grid.rotation.x = Math.PI / 2;
    this.grid.position.set(centre[0], centre[1], centre[2] - radius);
    this.scene.add(this.grid);
  }

  setPoints(buffer) {
    const count = Math.floor(buffer.byteLength / 15);
    this.points = new Float32Array(buffer, 0, 3 * count);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(this.points, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(buffer, 12 * count, 3 * count), 3, true));
    this.scene.add(new THREE.Points(geometry, new THREE.PointsMaterial({ size: 3, sizeAttenuation: false, vertexColors: true })));
    this.draw();
    return count;
  }

  lines(numbers, colour, width = 1) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(numbers), 3));
    return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: colour, linewidth: width }));
  }

  // -- what changes: region, handles, marks -------------------------------------------------------------------------------------------------

  axis(k) { return new THREE.Vector3(...[0, 1, 2].map((row) => this.region[6 + 3 * row + k])); }

  corner(signs) {
    const out = new THREE.Vector3(...this.region.slice(0, 3));
    signs.forEach((sign, k) => out.addScaledVector(this.axis(k), 0.5 * sign * this.region[3 + k]));
    return out;
  }

  handles() {
    if (!this.region) return [];
    return [0, 1, 2].flatMap((k) => [-1, 1].map((sign) => ({ k, sign, at: this.corner([0, 1, 2].map((other) => (other === k ? sign : 0))) })));
  }

  update() {
    for (const child of [...this.changing.children]) { child.geometry?.dispose(); child.removeFromParent(); }
    if (this.region) {
      const at = [];
      for (let a = 0; a < 8; a += 1) {
        for (let k = 0; k < 3; k += 1) {
          if (a & (1 << k)) continue;
          for (const end of [a, a | (1 << k)]) at.push(...this.corner([0, 1, 2].map((bit) => (end & (1 << bit) ? 1 : -1))).toArray());
        }
      }
      this.changing.add(this.lines(at, css("--accent")));
      if (this.mode === "box") for (const handle of this.handles()) this.ball(handle.at, css("--accent"), 0.035);
    }
    this.marks.forEach((mark) => this.ball(new THREE.Vector3(...mark), css("--good"), 0.03));
    if (this.marks.length > 1) {
      const closed = this.marks.length === 3 ? [...this.marks, this.marks[0]] : this.marks;
      this.changing.add(this.lines(closed.slice(1).flatMap((mark, k) => [...closed[k], ...mark]), css("--good")));
    }
    if (this.chosen !== undefined) {
      const { centre } = this.data.cameras[this.chosen];
      this.ball(new THREE.Vector3(...centre), css("--accent"), 0.035);
    }
    this.draw();
  }

  ball(at, colour, size) {
    const mesh = new THREE.Mesh(new THREE.SphereGeometry(size * this.data.radius, 16, 12), new THREE.MeshBasicMaterial({ color: colour }));
    mesh.position.copy(at);
    this.changing.add(mesh);
  }

  setMode(mode) { this.mode = mode; this.update(); }

  // -- drawing and looking ------------------------------------------------------------------------------------------------------------------

  draw() {
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      const { clientWidth: width, clientHeight: height } = this.canvas;
      if (!width || !height) return;
      this.renderer.setPixelRatio(devicePixelRatio || 1);
      this.renderer.setSize(width, height, false);
      const { turn, tilt, distance } = this.orbit;
      this.camera.aspect = width / height;
      this.camera.position.set(Math.cos(tilt) * Math.sin(turn), -Math.cos(tilt) * Math.cos(turn), Math.sin(tilt)).multiplyScalar(distance).add(this.target);
      this.camera.lookAt(this.target);
      this.camera.updateProjectionMatrix();
      this.camera.updateMatrixWorld();
      this.renderer.render(this.scene, this.camera);
      this.canvas.dataset.drawn = String(Number(this.canvas.dataset.drawn || 0) + 1);
    });
  }

  turn(x, y) {
    this.orbit.turn -= x;
    this.orbit.tilt = Math.min(1.55, Math.max(-1.55, this.orbit.tilt + y));
    this.draw();
  }

  nearer(factor) {
    this.orbit.distance = Math.min(60, Math.max(0.15, this.orbit.distance / this.data.radius / factor)) * this.data.radius;
    this.draw();
  }

  shift(x, y) {
    const scale = (2 * this.orbit.distance * Math.tan(Math.PI / 8)) / this.canvas.clientHeight;
    const right = new THREE.Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0);
    const up = new THREE.Vector3().setFromMatrixColumn(this.camera.matrixWorld, 1);
    this.target.addScaledVector(right, -x * scale).addScaledVector(up, y * scale);
    this.draw();
  }

  // -- picking ------------------------------------------------------------------------------------------------------------------------------

  // A position on the canvas in pixels; null behind the camera.
  toScreen(at) {
    const place = at.clone().project(this.camera);
    if (place.z > 1 || place.z < -1) return null;
    return { x: (place.x * 0.5 + 0.5) * this.canvas.clientWidth, y: (0.5 - place.y * 0.5) * this.canvas.clientHeight };
  }

  nearest(candidates, x, y, within = PICK) {
    let best = null;
    for (const candidate of candidates) {
      const place = this.toScreen(candidate.at);
      if (!place) continue;
      const gap = Math.hypot(place.x - x, place.y - y);
      if (gap <= within && (!best || gap < best.gap)) best = { ...candidate, gap };
    }
    return best;
  }

  // Of the points close to the pointer the one closest to it, of those that are not behind others.
  pointAt(x, y) {
    const close = [];
    const at = new THREE.Vector3();
    for (let k = 0; k < (this.points?.length || 0); k += 3) {
      at.set(this.points[k], this.points[k + 1], this.points[k + 2]);
      const away = at.distanceTo(this.camera.position);
      const place = this.toScreen(at);
      const gap = place ? Math.hypot(place.x - x, place.y - y) : Infinity;
      if (gap <= PICK) close.push({ gap, away, at: [this.points[k], this.points[k + 1], this.points[k + 2]] });
    }
    const front = Math.min(...close.map((one) => one.away)) + 0.1 * this.data.radius;
    const found = close.filter((one) => one.away <= front).sort((a, b) => a.gap - b.gap);
    return found.length ? found[0].at : null;
  }

  listen() {
    const { canvas } = this;
    let last = null;
    let moved = 0;
    let dragged = null;
    const where = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      const [x, y] = where(event);
      last = { x, y, button: event.button };
      moved = 0;
      dragged = this.mode === "box" && event.button === 0 ? this.nearest(this.handles(), x, y, PICK + 4) : null;
    });
    canvas.addEventListener("pointermove", (event) => {
      const [x, y] = where(event);
      if (!last) {
        const near = this.mode === "box" ? this.nearest(this.handles(), x, y, PICK + 4) : null;
        canvas.dataset.handle = near ? "xyz"[near.k] : "";
        return;
      }
      const [dx, dy] = [x - last.x, y - last.y];
      moved += Math.abs(dx) + Math.abs(dy);
      if (dragged) this.drag(dragged, dx, dy);
      else if (last.button === 0) this.turn(dx / 160, dy / 160);
      else this.shift(dx, dy);
      Object.assign(last, { x, y });
    });
    canvas.addEventListener("pointerup", (event) => {
      if (last && !dragged && moved < 4 && event.button === 0) this.click(...where(event));
      last = dragged = null;
    });
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); this.nearer(Math.exp(-event.deltaY / 500)); }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[event.key];
      if (turns) this.turn(...turns);
      else if (event.key === "+") this.nearer(1.15);
      else if (event.key === "-") this.nearer(1 / 1.15);
      else return;
      event.preventDefault();
      event.stopPropagation();
    });
  }

  click(x, y) {
    if (this.mode === "ground" || this.mode === "edge") {
      const found = this.pointAt(x, y);
      if (found) this.onpoint(found);
      return;
    }
    const camera = this.nearest(this.data.cameras.map(({ centre }, index) => ({ index, at: new THREE.Vector3(...centre) })), x, y);
    if (camera) this.oncamera(camera.index);
  }

  // Move one side of the box along its axis by the pointer's way on the screen.
  drag({ k, sign }, dx, dy) {
    const axis = this.axis(k);
    const at = this.handles().find((handle) => handle.k === k && handle.sign === sign).at;
    const [from, to] = [this.toScreen(at), this.toScreen(at.clone().addScaledVector(axis, 0.01 * this.data.radius))];
    if (!from || !to) return;
    const along = [(to.x - from.x) / (0.01 * this.data.radius), (to.y - from.y) / (0.01 * this.data.radius)];
    const length = along[0] ** 2 + along[1] ** 2;
    if (length < 1e-6) return;
    const way = (dx * along[0] + dy * along[1]) / length;
    const edge = Math.max(this.region[3 + k] + sign * way, 0.02 * this.data.radius);
    const grown = edge - this.region[3 + k];
    const region = [...this.region];
    region[3 + k] = edge;
    axis.toArray().forEach((value, row) => { region[row] += 0.5 * sign * grown * value; });
    this.region = region;
    this.update();
    this.onregion(region);
  }
}
