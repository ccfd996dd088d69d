/* The page of a result: rebuilds both frames from superpixels, planes and motions. */
(async () => {
for (const image of document.querySelectorAll("figure > img"))
  image.onclick = () => image.parentElement.classList.toggle("large");
addEventListener("keydown", (event) => {
  if (event.key === "Escape")
    document.querySelectorAll("figure.large").forEach((f) => f.classList.remove("large"));
  /* sliders and buttons have keys of their own */
  if (event.target !== document.body || !window.soupView) return;
  const step = { ArrowLeft: -0.1, ArrowRight: 0.1 }[event.key];
  if (step) window.soupView.setTime(Math.min(Math.max(Number($("time").value) + step, 0), 1));
  else if (event.key === " ") $("play").click();
  else return;
  event.preventDefault();
});

/* both frames one above the other, cut at an edge that can be moved */
const [left, right] = ["ref", "next"].map((name) => document.querySelector(`img[data-name="image_${name}"]`));
if (left && right) {
  [$("before").src, $("after").src, $("split").hidden] = [left.src, right.src, false];
  $("edge").oninput = () => { $("before").style.clipPath = `inset(0 ${100 - $("edge").value}% 0 0)`; };
}

const [labels, planes, motion, motionCamera, borrowed, seen, surface, sigma, component, tie] = await Promise.all([
  unpack(scene.labels, Uint16Array), unpack(scene.planes, Float32Array),
  unpack(scene.motion, Float32Array), unpack(scene.motionCamera, Float32Array),
  unpack(scene.borrowed, Uint8Array), unpack(scene.seen, Uint8Array), unpack(scene.surface, Uint8Array),
  unpack(scene.sigma, Uint8Array), unpack(scene.component, Uint16Array), unpack(scene.tie, Uint8Array),
]);
const [w, h] = scene.grid;

/* points of the reference frame; camera axes: x right, y down, z ahead */
function points() {
  const [[fx, skew, cx], [, fy, cy]] = scene.K;
  const out = new Float32Array(3 * w * h);
  for (let v = 0, p = 0; v < h; v++)
    for (let u = 0; u < w; u++, p++) {
      const y = (v * scene.step - cy) / fy, x = (u * scene.step - cx - skew * y) / fx;
      const i = 3 * labels[p];
      const inverse = planes[i] * x + planes[i + 1] * y + planes[i + 2];
      const z = inverse > 0 ? 1 / inverse : NaN;
      out.set([x * z, y * z, z], 3 * p);
    }
  return out;
}

/* two triangles of every four pixels that are no curtain; of a curtain its four pixels alone */
function pieces() {
  const out = new Uint32Array(6 * (w - 1) * (h - 1)), edge = new Uint8Array(w * h);
  let count = 0, bit = 0;
  const has = (k) => (surface[k >> 3] >> (k & 7)) & 1;
  for (let v = 0; v < h - 1; v++)
    for (let u = 0; u < w - 1; u++) {
      const a = v * w + u, b = a + 1, c = a + w, d = c + 1;
      if (!has(bit++)) {
        edge[a] = edge[b] = edge[c] = edge[d] = 1;
        continue;
      }
      for (const corner of [a, c, b, b, c, d]) out[count++] = corner;
    }
  const rim = Uint32Array.from(edge.keys()).filter((p) => edge[p]);
  return [out.slice(0, count), rim];
}

const VERTEX = `
  in float label, seen, sigma;
  uniform sampler2D motion;
  uniform float time, pixel, focal, size;
  uniform vec2 grid;
  out vec2 place;
  out float depth, hidden, unsure;
  vec3 turned(vec3 w, vec3 x) {
    float angle = length(w);
    if (angle < 1e-9) return x + cross(w, x);
    vec3 k = w / angle;
    return x * cos(angle) + cross(k, x) * sin(angle) + k * dot(k, x) * (1.0 - cos(angle));
  }
  vec3 moved(sampler2D table, vec3 x, float t) {
    int i = int(label + 0.5);
    vec4 turn = texelFetch(table, ivec2(0, i), 0);
    vec3 pivot = texelFetch(table, ivec2(1, i), 0).xyz;
    vec3 shift = texelFetch(table, ivec2(2, i), 0).xyz;
    return turned(t * turn.xyz, x - pivot) + pivot + t * shift;
  }
  uniform sampler2D raw;
  uniform mat3 cameraNext;
  uniform vec2 sizeNext;
  uniform bool fromNext;
  void main() {
    int p = gl_VertexID, w = int(grid.x);
    vec3 x = position;
    depth = x.z;
    unsure = sigma;
    hidden = 0.0;
    place = (vec2(p % w, p / w) + 0.5) / grid;
    if (fromNext) {
      vec3 q = cameraNext * moved(raw, x, 1.0);
      place = (q.xy / q.z + 0.5) / sizeNext;
      hidden = 1.0 - seen;
    }
    vec3 at = moved(motion, x, time);
    vec4 seenAt = modelViewMatrix * vec4(at, 1.0);
    gl_Position = projectionMatrix * seenAt;
    /* a point is as large as its pixel */
    gl_PointSize = clamp(depth * pixel * focal / max(-seenAt.z, 1e-6 * depth), 1.0, 8.0) * size;
  }`;
const FRAGMENT = `
  precision highp float;
  in vec2 place;
  in float depth, hidden, unsure;
  uniform sampler2D colours;
  uniform float far, most;
  out vec4 colour;
  void main() {
    if (!(depth < far) || unsure > most) discard;
    vec2 inside = step(vec2(0.0), place) * step(place, vec2(1.0));
    colour = inside.x * inside.y > 0.5 && hidden < 0.5 ? texture(colours, place) : vec4(0.35, 0.35, 0.38, 1.0);
  }`;

/* one row of three texels per superpixel: rotation, pivot, shift */
function motionTexture(values) {
  const texels = new Float32Array(12 * scene.count);
  for (let i = 0; i < scene.count; i++) {
    for (let part = 0; part < 3; part++)
      texels.set(values.subarray(9 * i + 3 * part, 9 * i + 3 * part + 3), 12 * i + 4 * part);
  }
  const out = new THREE.DataTexture(texels, 3, scene.count, THREE.RGBAFormat, THREE.FloatType);
  out.needsUpdate = true;
  return out;
}

const view = makeView(50, Math.max(scene.deepest, scene.middle));
if (!view) return;
const { body, eye, controls, draw } = view;
controls.zoomToCursor = true;

/* all colours are written as they are: no light, no change of colour space */
const texture = async (name) => {
  const image = document.querySelector(`figure > img[data-name="${name}"]`);
  await image.decode();
  const out = new THREE.Texture(image);
  out.flipY = false;
  out.colorSpace = THREE.NoColorSpace;
  const photo = name.startsWith("image");
  out.minFilter = out.magFilter = photo ? THREE.LinearFilter : THREE.NearestFilter;
  out.generateMipmaps = false;
  out.needsUpdate = true;
  return out;
};
const textures = {};
const K = scene.KNext;
const home = motionTexture(motion), raw = motionTexture(motionCamera);
const uniforms = {
  motion: { value: home }, raw: { value: raw }, time: { value: 0 },
  grid: { value: new THREE.Vector2(w, h) }, pixel: { value: scene.step / scene.K[0][0] },
  focal: { value: 1 },
  cameraNext: { value: new THREE.Matrix3().set(...K[0], ...K[1], ...K[2]) },
  sizeNext: { value: new THREE.Vector2(...scene.sizeNext) }, fromNext: { value: false },
  size: { value: 1 }, most: { value: 1 }, colours: { value: null }, far: { value: scene.far },
};
const material = new THREE.ShaderMaterial({
  uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT, glslVersion: THREE.GLSL3,
  side: THREE.DoubleSide,
});
const position = new THREE.BufferAttribute(points(), 3);
const label = new THREE.BufferAttribute(Float32Array.from(labels), 1);
const shown = new THREE.BufferAttribute(Float32Array.from(seen), 1);
const unsure = new THREE.BufferAttribute(Float32Array.from(sigma, (x) => x / 255), 1);
const geometry = (index) => {
  const out = new THREE.BufferGeometry();
  out.setAttribute("position", position);
  out.setAttribute("label", label);
  out.setAttribute("seen", shown);
  out.setAttribute("sigma", unsure);
  if (index) out.setIndex(new THREE.BufferAttribute(index, 1));
  return out;
};
const [corners, rim] = pieces();
const mesh = new THREE.Mesh(geometry(corners), material);
/* the surface ends at the centres of its pixels: points cover the other half */
const fringe = new THREE.Points(geometry(rim), material);
const cloud = new THREE.Points(geometry(null), material);
mesh.frustumCulled = fringe.frustumCulled = cloud.frustumCulled = false;
cloud.visible = false;

body.add(mesh, fringe, cloud);

let pose = matrix(scene.camera);
const [[fx], [, fy]] = scene.K;
const cameras = new THREE.Group();
const cameraRef = frustum(0x6fb7ff), cameraNext = frustum(0xffa94d);
cameras.add(cameraRef, cameraNext);
body.add(cameras);

/* path of the pivot of every component that moves */
const paths = new THREE.Group();
function drawPaths(values) {
  paths.clear();
  const seen = new Set();
  for (let i = 0; i < scene.count; i++) {
    const pivot = [...values.subarray(9 * i + 3, 9 * i + 6)], key = pivot.join();
    if (seen.has(key)) continue;
    seen.add(key);
    const shift = values.subarray(9 * i + 6, 9 * i + 9);
    if (Math.hypot(...shift) < 0.01 * pivot[2]) continue;
    paths.add(lines([pivot, pivot.map((x, k) => x + shift[k])], 0xff5566, true));
  }
}
body.add(paths);

function fit(margin) {
  const aspect = $("stage").clientWidth / $("stage").clientHeight;
  const tall = Math.max(scene.size[1] / fy, scene.size[0] / fx / aspect) * margin;
  eye.fov = 2 * Math.atan(tall / 2) * 180 / Math.PI;
}
const m = scene.middle;
const VIEWS = {
  aside: () => { fit(1); view.look([0.2 * m, -0.17 * m, -0.45 * m], [0, 0.02 * m, m]); },
  reference: () => { fit(1); view.look([0, 0, 0], [0, 0, m]); },
  next: () => { fit(1); view.look([0, 0, 0], [0, 0, m], pose); setTime(1); },
  left: () => { fit(1.1); view.look([-0.75 * m, -0.15 * m, 0.15 * m], [0, 0, m]); },
  right: () => { fit(1.1); view.look([0.75 * m, -0.15 * m, 0.15 * m], [0, 0, m]); },
  top: () => {
    fit(1.3);
    const reach = Math.min(scene.far, 3 * m), height = 0.55 * reach / Math.tan(eye.fov * Math.PI / 360);
    view.look([0, -height, 0.5 * reach - 0.01 * m], [0, 0, 0.5 * reach]);
  },
};
/* points are as large as their pixels */
view.before = () => { uniforms.focal.value = $("canvas").height / 2 / Math.tan(eye.fov * Math.PI / 360); };

function setTime(value) {
  $("time").value = value;
  uniforms.time.value = Number(value);
  draw();
}
async function setMode(name) {
  textures[name] ??= await texture(name);
  uniforms.colours.value = textures[name];
  uniforms.fromNext.value = name === "image_next";
  const mode = data.modes.find((one) => one.name === name);
  $("mode-title").textContent = mode.title;
  $("mode-legend").innerHTML = mode.legend;
  for (const button of $("modes").children) button.classList.toggle("on", button.value === name);
  draw();
}
function setView(name) { VIEWS[name](); eye.updateProjectionMatrix(); controls.update(); draw(); }
/* the address opens what is shown */
const asked = { mode: data.modes[0].name, view: "aside" };
function remember(change) {
  Object.assign(asked, change);
  history.replaceState(null, "", `#mode=${asked.mode}&view=${asked.view}&time=${$("time").value}`);
}
buttons("modes", data.modes.map((mode) => [mode.name, mode.word]),
  (mode) => { setMode(mode); remember({ mode }); });
buttons("views", Object.keys(VIEWS).map((name) => [name, name]),
  (view) => { setView(view); remember({ view }); });
$("time").onchange = () => remember({});
$("size").oninput = () => { uniforms.size.value = Number($("size").value); draw(); };
/* confidence is 1 - sigma / 0.5, of a guess below 0.5; bytes hold sigma up to 0.5 */
function setLeast(value) {
  $("least").value = value;
  $("least-text").textContent = Number(value).toFixed(2);
  $("guesses").checked = value < 0.5;
  uniforms.most.value = 1 - Number(value);
  draw();
}
$("least").oninput = () => setLeast($("least").value);

/* where a point of the reference frame is at a time; it is drawn if nothing hides it */
function moved(p, t) {
  const table = $("still").checked ? motionCamera : motion, k = 9 * labels[p];
  const turn = new THREE.Vector3(table[k], table[k + 1], table[k + 2]), angle = turn.length();
  const pivot = new THREE.Vector3(table[k + 3], table[k + 4], table[k + 5]);
  const x = new THREE.Vector3(position.getX(p), position.getY(p), position.getZ(p)).sub(pivot);
  if (angle > 1e-9) x.applyAxisAngle(turn.divideScalar(angle), t * angle);
  return x.add(pivot).addScaledVector(new THREE.Vector3(table[k + 6], table[k + 7], table[k + 8]), t);
}
const drawn = (p) => position.getZ(p) < uniforms.far.value && sigma[p] / 255 <= uniforms.most.value;

/* the nearest point to the eye within a few pixels of a place of the canvas; -1 for none */
function pick(x, y) {
  const { clientWidth, clientHeight } = $("canvas"), t = uniforms.time.value;
  eye.updateMatrixWorld();
  const all = new THREE.Matrix4().multiplyMatrices(eye.projectionMatrix, eye.matrixWorldInverse).multiply(body.matrix);
  const e = all.elements;
  let best = -1, nearest = Infinity;
  for (let p = 0; p < w * h; p++) {
    if (!drawn(p)) continue;
    const q = moved(p, t), depth = e[3] * q.x + e[7] * q.y + e[11] * q.z + e[15];
    if (!(depth > 0) || depth >= nearest) continue;
    const u = (0.5 + 0.5 * (e[0] * q.x + e[4] * q.y + e[8] * q.z + e[12]) / depth) * clientWidth;
    const v = (0.5 - 0.5 * (e[1] * q.x + e[5] * q.y + e[9] * q.z + e[13]) / depth) * clientHeight;
    if (Math.abs(u - x) < 3 && Math.abs(v - y) < 3) { best = p; nearest = depth; }
  }
  return best;
}
function tell(p) {
  if (p < 0) { $("picked").textContent = "No point is shown there."; return; }
  const i = labels[p], spread = sigma[p] < 255 ? `${(sigma[p] / 5.1).toFixed(sigma[p] < 26 ? 1 : 0)} %` : "50 % or unknown";
  const part = component[i] ? `component ${component[i]}, ${scene.origins[tie[i]]}` : "the static scene";
  const guess = sigma[p] > 127, known = guess ? "little information" : "flow and parallax";
  const source = (guess ? "a guess: " : "") + (borrowed[i] ? "depth taken from neighbours" : known);
  $("picked").textContent = `pixel (${(p % w) * scene.step}, ${Math.floor(p / w) * scene.step}): depth`
    + ` ${position.getZ(p).toPrecision(4)} ${scene.unit}, sigma ${spread}; superpixel ${i}, ${part}; ${source}`;
}
let pressed = null;
$("canvas").addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
$("canvas").addEventListener("pointerup", (event) => {
  if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 3) return;
  const box = $("canvas").getBoundingClientRect();
  tell(pick(event.clientX - box.left, event.clientY - box.top));
});

/* the points that are shown, where they are now, in their colours; of the next frame in those of the
   first picture */
function shownPoints() {
  const flatImage = document.createElement("canvas"), pen = flatImage.getContext("2d");
  [flatImage.width, flatImage.height] = [w, h];
  const on = document.querySelector("#modes .on").value, name = uniforms.fromNext.value ? data.modes[0].name : on;
  pen.drawImage(document.querySelector(`figure > img[data-name="${name}"]`), 0, 0, w, h);
  const pixels = pen.getImageData(0, 0, w, h).data, kept = [];
  for (let p = 0; p < w * h; p++) if (drawn(p)) kept.push(p);
  const places = kept.map((p) => moved(p, uniforms.time.value));
  return { kept, places, colours: kept.map((p) => pixels.subarray(4 * p, 4 * p + 3)) };
}
function ply() {
  const { kept, places, colours } = shownPoints();
  const head = `ply\nformat binary_little_endian 1.0\ncomment time ${uniforms.time.value}, x right, y down, z ahead\n`
    + `element vertex ${kept.length}\nproperty float x\nproperty float y\nproperty float z\n`
    + "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
  const rows = new DataView(new ArrayBuffer(15 * kept.length));
  places.forEach((q, k) => {
    [q.x, q.y, q.z].forEach((x, j) => rows.setFloat32(15 * k + 4 * j, x, true));
    colours[k].forEach((c, j) => rows.setUint8(15 * k + 12 + j, c));
  });
  return new Blob([head, rows.buffer]);
}
/* glTF: y up, z towards the viewer; the surface where it is shown, else points */
function glb() {
  const { kept, places, colours } = shownPoints(), count = kept.length;
  const number = new Map(kept.map((p, k) => [p, k])), index = [];
  if (mesh.visible)
    for (let k = 0; k < corners.length; k += 3) {
      const three = [...corners.subarray(k, k + 3)].map((p) => number.get(p));
      if (!three.includes(undefined)) index.push(...three);
    }
  const xyz = Float32Array.from(places.flatMap((q) => [q.x, -q.y, -q.z]));
  const tint = Uint8Array.from(colours.flatMap((c) => [...c, 255])), faces = Uint32Array.from(index);
  const least = [0, 1, 2].map((j) => places.reduce((m, q) => Math.min(m, [q.x, -q.y, -q.z][j]), Infinity));
  const most = [0, 1, 2].map((j) => places.reduce((m, q) => Math.max(m, [q.x, -q.y, -q.z][j]), -Infinity));
  const accessors = [
    { bufferView: 0, componentType: 5126, count, type: "VEC3", min: least, max: most },
    { bufferView: 1, componentType: 5121, count, type: "VEC4", normalized: true }];
  const bufferViews = [{ buffer: 0, byteLength: xyz.byteLength },
    { buffer: 0, byteOffset: xyz.byteLength, byteLength: tint.byteLength }];
  const primitive = { attributes: { POSITION: 0, COLOR_0: 1 }, mode: index.length ? 4 : 0 };
  if (index.length) {
    primitive.indices = 2;
    accessors.push({ bufferView: 2, componentType: 5125, count: index.length, type: "SCALAR" });
    bufferViews.push({ buffer: 0, byteOffset: xyz.byteLength + tint.byteLength, byteLength: faces.byteLength });
  }
  const length = xyz.byteLength + tint.byteLength + faces.byteLength;
  const text = JSON.stringify({ asset: { version: "2.0" }, scene: 0, scenes: [{ nodes: [0] }], nodes: [{ mesh: 0 }],
    meshes: [{ primitives: [primitive] }], accessors, bufferViews, buffers: [{ byteLength: length }] });
  const json = new TextEncoder().encode(text + " ".repeat(-new TextEncoder().encode(text).length & 3));
  const head = new Uint32Array([0x46546c67, 2, 28 + json.length + length, json.length, 0x4e4f534a]);
  return new Blob([head, json, new Uint32Array([length, 0x004e4942]), xyz, tint, faces]);
}
for (const [kind, make] of Object.entries({ ply, glb }))
  $(kind).onclick = () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(make());
    link.download = `${document.title || "points"}.${kind}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };

$("time").oninput = () => setTime($("time").value);
$("points").onchange = () => { cloud.visible = $("points").checked; mesh.visible = fringe.visible = !cloud.visible; draw(); };
$("guesses").onchange = () => setLeast($("guesses").checked ? 0 : 0.5);
$("cameras").onchange = () => { cameras.visible = $("cameras").checked; draw(); };
$("paths").onchange = () => { paths.visible = $("paths").checked; draw(); };
/* held: both cameras stand in one place, and everything moves as they see it */
function hold(held) {
  uniforms.motion.value = held ? raw : home;
  pose = held ? new THREE.Matrix4() : matrix(scene.camera);
  cameraNext.matrix.copy(pose);
  drawPaths(held ? motionCamera : motion);
  draw();
}
$("still").onchange = () => hold($("still").checked);
/* depths of the slider are even in their logarithm */
const near = 0.5 * m, deepest = Math.max(scene.deepest * 1.001, 1.1 * near);
function setFar(depth) {
  uniforms.far.value = depth;
  $("far").value = Math.log(depth / near) / Math.log(deepest / near);
  $("far-text").textContent = `${depth.toPrecision(3)} ${scene.unit}`;
  draw();
}
$("far").oninput = () => setFar(near * (deepest / near) ** $("far").value);

let playing = 0;
$("play").onclick = () => {
  if (playing) { cancelAnimationFrame(playing); playing = 0; $("play").textContent = "\u25b6"; return; }
  const began = performance.now() - 1000 * Number($("time").value);
  const step = (now) => {
    const t = ((now - began) / 1000) % 3;  /* there in a second, a rest, and back */
    setTime(t < 1 ? t : t < 1.5 ? 1 : t < 2.5 ? 2.5 - t : 0);
    playing = requestAnimationFrame(step);
  };
  $("play").textContent = "\u25a0";
  playing = requestAnimationFrame(step);
};

/* report.html#mode=depth_ref&time=1&view=top opens that view, also while the page is shown */
async function show() {
  const asked = new URLSearchParams(location.hash.slice(1)), mode = asked.get("mode");
  setView(asked.get("view") in VIEWS ? asked.get("view") : "aside");
  if (asked.has("time")) setTime(Math.min(Math.max(Number(asked.get("time")) || 0, 0), 1));
  else if (asked.get("view") !== "next") setTime(0);
  await setMode(data.modes.some((one) => one.name === mode) ? mode : data.modes[0].name);
}
addEventListener("hashchange", show);
setFar(scene.far);
hold(false);
view.resize();
await show();
$("message").textContent = "";
document.body.dataset.ready = "yes";
window.soupView = { setMode, setTime, setView, setFar, setLeast, pick, tell, ply, glb, eye, modes: data.modes.map((one) => one.name) };
})().catch((error) => {
  document.getElementById("message").textContent = `The 3D view failed: ${error.message}`;
  throw error;
});
