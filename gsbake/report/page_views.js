// Other views of the asset in the viewer: one channel of its material, or its triangles. Each is a GLB made of the page's own.
(() => {
  const viewer = document.querySelector("model-viewer");
  const buttons = document.querySelectorAll(".views button");
  if (!viewer || !buttons.length) return;
  const bytes = (text) => Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));

  const opened = () => {
    const data = bytes(document.getElementById("model").textContent);
    const view = new DataView(data.buffer);
    const length = view.getUint32(12, true);
    return { json: JSON.parse(new TextDecoder().decode(data.subarray(20, 20 + length))), binary: data.subarray(28 + length) };
  };

  const packed = (json, binary) => {
    const pad = (size) => (4 - (size % 4)) % 4;
    const body = new Uint8Array(binary.length + pad(binary.length));
    body.set(binary);
    json.buffers[0].byteLength = body.length;
    const raw = new TextEncoder().encode(JSON.stringify(json));
    const text = new Uint8Array(raw.length + pad(raw.length)).fill(32);
    text.set(raw);
    const out = new Uint8Array(28 + text.length + body.length);
    const view = new DataView(out.buffer);
    [0x46546c67, 2, out.length, text.length, 0x4e4f534a].forEach((value, k) => view.setUint32(4 * k, value, true));
    out.set(text, 20);
    view.setUint32(20 + text.length, body.length, true);
    view.setUint32(24 + text.length, 0x004e4942, true);
    out.set(body, 28 + text.length);
    return URL.createObjectURL(new Blob([out], { type: "model/gltf-binary" }));
  };

  const joined = (json, binary, content, extra) => {
    const start = binary.length + ((4 - (binary.length % 4)) % 4);
    const out = new Uint8Array(start + content.length);
    out.set(binary);
    out.set(content, start);
    json.bufferViews.push({ buffer: 0, byteOffset: start, byteLength: content.length, ...extra });
    return out;
  };

  const flat = (json, colour) => {
    json.extensionsUsed = [...new Set([...(json.extensionsUsed || []), "KHR_materials_unlit"])];
    json.materials[0] = { extensions: { KHR_materials_unlit: {} }, pbrMetallicRoughness: colour };
  };

  const channel = (uri) => {
    const { json, binary } = opened();
    const head = uri.slice(5, uri.indexOf(";"));
    const body = joined(json, binary, bytes(uri.slice(uri.indexOf(",") + 1)), {});
    json.images.push({ mimeType: head, bufferView: json.bufferViews.length - 1 });
    json.textures.push({ ...(json.samplers ? { sampler: 0 } : {}), source: json.images.length - 1 });
    flat(json, { baseColorTexture: { index: json.textures.length - 1 } });
    return packed(json, body);
  };

  const wire = () => {
    const { json, binary } = opened();
    const primitive = json.meshes[0].primitives[0];
    const accessor = json.accessors[primitive.indices];
    const view = json.bufferViews[accessor.bufferView];
    const Kind = accessor.componentType === 5125 ? Uint32Array : Uint16Array;
    const start = (view.byteOffset || 0) + (accessor.byteOffset || 0);
    const corner = new Kind(binary.slice(start, start + accessor.count * Kind.BYTES_PER_ELEMENT).buffer);
    const edges = new Uint32Array(2 * corner.length);
    for (let k = 0; k < corner.length; k += 3) edges.set([corner[k], corner[k + 1], corner[k + 1], corner[k + 2], corner[k + 2], corner[k]], 2 * k);
    const body = joined(json, binary, new Uint8Array(edges.buffer), { target: 34963 });
    json.accessors.push({ bufferView: json.bufferViews.length - 1, componentType: 5125, count: edges.length, type: "SCALAR" });
    primitive.indices = json.accessors.length - 1;
    primitive.mode = 1;
    flat(json, { baseColorFactor: [0.05, 0.05, 0.05, 1] });
    return packed(json, body);
  };

  const first = viewer.src;
  const made = new Map();
  for (const button of buttons) {
    button.addEventListener("click", () => {
      for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
      const name = button.dataset.view;
      if (!made.has(name)) {
        const image = document.querySelector(`img[data-channel="${name}"]`);
        made.set(name, name === "" ? first : name === "wire" ? wire() : channel(image.src));
      }
      viewer.src = made.get(name);
    });
  }
})();
