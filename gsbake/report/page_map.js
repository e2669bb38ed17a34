// Map of the cameras in 3D: drag or arrow keys turn it, scroll, + and − zoom.
(() => {
  const canvas = document.getElementById("map");
  if (!canvas) return;
  const data = JSON.parse(document.getElementById("map-data").textContent);
  const state = { turn: 0.6, tilt: 0.4, zoom: 1 };
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  const project = ([x, y, z]) => {
    const [ct, st, cp, sp] = [Math.cos(state.turn), Math.sin(state.turn), Math.cos(state.tilt), Math.sin(state.tilt)];
    const [u, w] = [ct * x - st * z, st * x + ct * z];
    const [v, depth] = [cp * y - sp * w, sp * y + cp * w];
    const scale = (state.zoom * Math.min(canvas.width, canvas.height) * 0.62) / (6 - depth);
    return [canvas.width / 2 + scale * u, canvas.height / 2 - scale * v, depth];
  };

  const draw = () => {
    const ratio = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * ratio;
    canvas.height = canvas.clientHeight * ratio;
    const c = canvas.getContext("2d");
    const dot = (p, size) => c.fillRect(p[0] - size / 2, p[1] - size / 2, size, size);
    const points = data.surface.map((s) => [project(s), s[3]]).sort((a, b) => a[0][2] - b[0][2]);
    for (const [p, seen] of points) {
      c.fillStyle = colour(seen ? "--soft" : "--bad");
      c.globalAlpha = seen ? 0.45 : 1;
      dot(p, (seen ? 2 : 3.5) * ratio);
    }
    c.globalAlpha = 1;
    c.lineWidth = 1.5 * ratio;
    for (const camera of data.cameras) {
      const p = project(camera.at);
      const q = project(camera.at.map((x, k) => x + 0.35 * camera.to[k]));
      c.strokeStyle = c.fillStyle = colour(camera.weak ? "--bad" : camera.psnr === null ? "--c1" : "--good");
      c.beginPath();
      c.moveTo(p[0], p[1]);
      c.lineTo(q[0], q[1]);
      c.stroke();
      dot(p, (camera.weak ? 9 : 6) * ratio);
    }
    c.strokeStyle = colour("--soft");
    c.lineWidth = ratio;
    for (const [a, b] of data.region) {
      const [p, q] = [project(a), project(b)];
      c.beginPath();
      c.moveTo(p[0], p[1]);
      c.lineTo(q[0], q[1]);
      c.stroke();
    }
    c.lineWidth = 1.5 * ratio;
    c.strokeStyle = c.fillStyle = colour("--warn");
    c.font = `${12 * ratio}px sans-serif`;
    data.proposed.forEach((place, k) => {
      const p = project(place.at);
      c.beginPath();
      c.arc(p[0], p[1], 8 * ratio, 0, 2 * Math.PI);
      c.stroke();
      c.fillText(String(k + 1), p[0] - 3.5 * ratio, p[1] + 4 * ratio);
    });
    canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
  };

  const move = (turn, tilt, zoom) => {
    state.turn += turn;
    state.tilt = Math.max(-1.5, Math.min(1.5, state.tilt + tilt));
    state.zoom = Math.max(0.3, Math.min(6, state.zoom * zoom));
    draw();
  };
  let at = null;
  canvas.addEventListener("pointerdown", (event) => {
    at = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!at) return;
    move((event.clientX - at[0]) / 150, (event.clientY - at[1]) / 150, 1);
    at = [event.clientX, event.clientY];
  });
  canvas.addEventListener("pointerup", () => { at = null; });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    move(0, 0, event.deltaY < 0 ? 1.1 : 1 / 1.1);
  }, { passive: false });
  const keys = { ArrowLeft: [-0.15, 0, 1], ArrowRight: [0.15, 0, 1], ArrowUp: [0, 0.15, 1], ArrowDown: [0, -0.15, 1], "+": [0, 0, 1.15], "-": [0, 0, 1 / 1.15] };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    move(...keys[event.key]);
  });
  window.addEventListener("resize", draw);
  document.getElementById("theme").addEventListener("click", draw);
  draw();
})();
