/* The page of a pair or a chain: rebuilds its frames from superpixels, planes, detail and motions. */
"use strict";
const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent), pairs = data.pairs, last = pairs.length;

(async () => {
/* the pictures of the first pair; those of the others follow with the time */
for (const name of Object.keys(pairs[0].pictures)) {
  const figure = document.createElement("figure"), image = document.createElement("img");
  image.dataset.name = name;
  image.onclick = () => figure.classList.toggle("large");
  figure.append(document.createElement("figcaption"), image, document.createElement("div"));
  $("gallery").append(figure);
}
function showPictures(pictures) {
  for (const { children: [caption, image, legend] } of $("gallery").children) {
    const { title, source, legend: text } = pictures[image.dataset.name];
    caption.textContent = image.alt = title;
    image.src = source;
    legend.innerHTML = text;
  }
  /* both frames one above the other, cut at an edge that can be moved */
  $("split").hidden = !pictures.image_next;
  if (pictures.image_next) [$("before").src, $("after").src] = [pictures.image_ref.source, pictures.image_next.source];
}
showPictures(pairs[0].pictures);
$("edge").oninput = () => { $("before").style.clipPath = `inset(0 ${100 - $("edge").value}% 0 0)`; };
addEventListener("keydown", (event) => {
  if (event.key === "Escape")
    document.querySelectorAll("figure.large").forEach((f) => f.classList.remove("large"));
  /* sliders and buttons have keys of their own */
  if (event.target !== document.body || !window.soupView) return;
  const step = { ArrowLeft: -0.1, ArrowRight: 0.1 }[event.key];
  if (step) setTime(Number($("time").value) + step);
  else if (event.key === " ") $("play").click();
  else return;
  event.preventDefault();
});

/* --- the empty view ------------------------------------------------------------------------------ */

let renderer;
try {
  renderer = new THREE.WebGLRenderer({ canvas: $("canvas"), antialias: true, preserveDrawingBuffer: true });
} catch (error) {
  $("message").textContent = "This browser shows no WebGL 2: the 3D view is left out, the pictures are below.";
  document.body.dataset.ready = "yes";
  return;
}
renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
renderer.setClearColor(0x20262e);
/* y up and z towards the viewer, as viewers expect */
const world = new THREE.Scene(), body = new THREE.Group(), m = data.middle;
body.matrixAutoUpdate = false;
body.matrix.makeScale(1, -1, -1);
world.add(body);
const eye = new THREE.PerspectiveCamera(50, 1, m / 200, 4 * Math.max(data.deepest, m));
const controls = new THREE.OrbitControls(eye, $("canvas"));
controls.zoomToCursor = true;
let wanted = false;
function draw() {
  if (wanted) return;
  wanted = true;
  requestAnimationFrame(() => {
    wanted = false;
    controls.update();
    /* points are as large as their pixels */
    shared.focal.value = $("canvas").height / 2 / Math.tan(eye.fov * Math.PI / 360);
    renderer.render(world, eye);
  });
}
function resize() {
  const { clientWidth, clientHeight } = $("stage");
  renderer.setSize(clientWidth, clientHeight, false);
  eye.aspect = clientWidth / clientHeight;
  eye.updateProjectionMatrix();
  draw();
}
controls.addEventListener("change", draw);
addEventListener("resize", resize);
const matrix = (rows) => new THREE.Matrix4().set(...rows.flat());
/* every two points are the ends of a line; `above` draws it over everything */
function lines(ends, colour, above = false) {
  const own = new THREE.BufferGeometry();
  own.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(ends.flat()), 3));
  const out = new THREE.LineSegments(own, new THREE.LineBasicMaterial({ color: colour, depthTest: !above }));
  out.renderOrder = Number(above);
  out.frustumCulled = false;
  return out;
}
/* a camera: its image and the rays of the corners */
function frustum(colour) {
  const { K: [[fx, , cx], [, fy, cy]], size: [width, height] } = pairs[0], s = 0.09 * m;
  const corner = (u, v) => [s * (u - cx) / fx, s * (v - cy) / fy, s];
  const [a, b, c, d] = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
  const top = corner(width / 2, -0.2 * height), o = [0, 0, 0];
  const out = lines([o, a, o, b, o, c, o, d, a, b, b, c, c, d, d, a, a, top, top, b], colour);
  out.matrixAutoUpdate = false;
  return out;
}

/* --- the points and the surface of a pair -------------------------------------------------------- */

const VERTEX = `
  in float label, seen, sigma, kind;
  uniform sampler2D motion, raw;
  uniform float time, pixel, focal, size;
  uniform vec2 grid, sizeNext;
  uniform mat3 cameraNext;
  uniform bool fromNext, still, withDrawn;
  out vec2 place;
  out float depth, hidden, unsure;
  vec3 turned(vec3 w, vec3 x) {
    float angle = length(w);
    if (angle < 1e-9) return x + cross(w, x);
    vec3 k = w / angle;
    return x * cos(angle) + cross(k, x) * sin(angle) + k * dot(k, x) * (1.0 - cos(angle));
  }
  vec3 moved(sampler2D table, int i, vec3 x, float t) {
    vec3 pivot = texelFetch(table, ivec2(1, i), 0).xyz;
    vec3 shift = texelFetch(table, ivec2(2, i), 0).xyz;
    return turned(t * texelFetch(table, ivec2(0, i), 0).xyz, x - pivot) + pivot + t * shift;
  }
  void main() {
    int p = gl_VertexID, w = int(grid.x), i = int(label + 0.5);
    vec3 x = position;
    depth = x.z;
    /* left out: what moves, of the static scene alone, and what is drawn, if so wanted */
    bool left = still && texelFetch(motion, ivec2(0, i), 0).w > 0.5 || !withDrawn && kind > 1.5;
    unsure = left ? 2.0 : sigma;
    hidden = 0.0;
    place = (vec2(p % w, p / w) + 0.5) / grid;
    if (fromNext) {
      vec3 q = cameraNext * moved(raw, i, x, 1.0);
      place = (q.xy / q.z + 0.5) / sizeNext;
      hidden = 1.0 - seen;
    }
    vec4 seenAt = modelViewMatrix * vec4(moved(motion, i, x, time), 1.0);
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
const shared = {
  focal: { value: 1 }, size: { value: 1 }, most: { value: 1 }, far: { value: data.far }, fromNext: { value: false },
  withDrawn: { value: true },
};

/* numbers that were deflated and written as base64 */
async function unpack(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Kind(await new Response(stream).arrayBuffer());
}

/* points of the reference frame; camera axes: x right, y down, z ahead */
function points({ K: [[fx, skew, cx], [, fy, cy]], grid: [w, h], step }, labels, planes, detail) {
  const out = new Float32Array(3 * w * h);
  for (let v = 0, p = 0; v < h; v++)
    for (let u = 0; u < w; u++, p++) {
      const y = (v * step - cy) / fy, x = (u * step - cx - skew * y) / fx, i = 3 * labels[p];
      const inverse = planes[i] * x + planes[i + 1] * y + planes[i + 2];
      const z = inverse > 0 ? Math.exp(detail[p] / 1000) / inverse : NaN;
      out.set([x * z, y * z, z], 3 * p);
    }
  return out;
}

/* two triangles of every four pixels that are no curtain; of a curtain its four pixels alone */
function pieces([w, h], surface) {
  const out = new Uint32Array(6 * (w - 1) * (h - 1)), edge = new Uint8Array(w * h);
  let count = 0, bit = 0;
  for (let v = 0; v < h - 1; v++)
    for (let u = 0; u < w - 1; u++, bit++) {
      const a = v * w + u, b = a + 1, c = a + w, d = c + 1;
      if ((surface[bit >> 3] >> (bit & 7)) & 1) for (const corner of [a, c, b, b, c, d]) out[count++] = corner;
      else edge[a] = edge[b] = edge[c] = edge[d] = 1;
    }
  return [out.slice(0, count), Uint32Array.from(edge.keys()).filter((p) => edge[p])];
}

/* one row of three texels per superpixel: rotation and whether it is a component, pivot, shift */
function motionTexture(values, component) {
  const texels = new Float32Array(12 * component.length);
  component.forEach((own, i) => {
    for (let part = 0; part < 3; part++)
      texels.set(values.subarray(9 * i + 3 * part, 9 * i + 3 * part + 3), 12 * i + 4 * part);
    texels[12 * i + 3] = own;
  });
  const out = new THREE.DataTexture(texels, 3, component.length, THREE.RGBAFormat, THREE.FloatType);
  out.needsUpdate = true;
  return out;
}

async function makePart(k) {
  const pair = pairs[k], [w, h] = pair.grid, kinds = {
    labels: Uint16Array, planes: Float32Array, detail: Int16Array, motion: Float32Array, motionCamera: Float32Array,
    seen: Uint8Array, surface: Uint8Array, sigma: Uint8Array, kind: Uint8Array, component: Uint16Array, origin: Uint8Array,
  };
  const part = { k, w, h, step: pair.step, pictures: pair.pictures, textures: {}, group: new THREE.Group() };
  await Promise.all(Object.keys(kinds).map(async (name) => { part[name] = await unpack(pair[name], kinds[name]); }));
  part.home = motionTexture(part.motion, part.component);
  part.raw = motionTexture(part.motionCamera, part.component);
  part.uniforms = {
    ...shared, motion: { value: part.home }, raw: { value: part.raw }, time: { value: 0 }, still: { value: false },
    grid: { value: new THREE.Vector2(w, h) }, pixel: { value: pair.step / pair.K[0][0] },
    cameraNext: { value: new THREE.Matrix3().set(...pair.KNext.flat()) },
    sizeNext: { value: new THREE.Vector2(...pair.sizeNext) }, colours: { value: null },
  };
  /* all colours are written as they are: no light, no change of colour space */
  const material = new THREE.ShaderMaterial({
    uniforms: part.uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT, glslVersion: THREE.GLSL3,
    side: THREE.DoubleSide,
  });
  const own = {
    position: [points(pair, part.labels, part.planes, part.detail), 3], label: [Float32Array.from(part.labels), 1],
    seen: [Float32Array.from(part.seen), 1], sigma: [Float32Array.from(part.sigma, (x) => x / 255), 1],
    kind: [Float32Array.from(part.kind), 1],
  };
  for (const name of Object.keys(own)) own[name] = new THREE.BufferAttribute(...own[name]);
  const geometry = (index) => {
    const out = new THREE.BufferGeometry();
    for (const name of Object.keys(own)) out.setAttribute(name, own[name]);
    if (index) out.setIndex(new THREE.BufferAttribute(index, 1));
    return out;
  };
  const [corners, rim] = pieces(pair.grid, part.surface), every = Math.ceil(last * w * h / 1e6);
  part.position = own.position;
  part.corners = corners;
  part.mesh = new THREE.Mesh(geometry(corners), material);
  /* the surface ends at the centres of its pixels: points cover the other half */
  part.fringe = new THREE.Points(geometry(rim), material);
  part.cloud = new THREE.Points(geometry(null), material);
  /* behind other frames: some of the points */
  part.some = new THREE.Points(geometry(Uint32Array.from(part.labels.keys()).filter((p) => p % every === 0)), material);
  part.every = every;
  for (const piece of [part.mesh, part.fringe, part.cloud, part.some]) {
    piece.frustumCulled = false;
    part.group.add(piece);
  }
  part.group.matrixAutoUpdate = false;
  body.add(part.group);
  return part;
}
async function colour(part) {
  /* the first picture, too: what is saved in colours of the next frame has its colours */
  for (const name of new Set([data.modes[0][0], mode])) {
    if (part.textures[name]) continue;
    const image = new Image();
    image.src = part.pictures[name].source;
    await image.decode();
    const out = part.textures[name] = new THREE.Texture(image);
    out.flipY = out.generateMipmaps = false;
    out.colorSpace = THREE.NoColorSpace;
    out.minFilter = out.magFilter = name.startsWith("image") ? THREE.LinearFilter : THREE.NearestFilter;
    out.needsUpdate = true;
  }
  part.uniforms.colours.value = part.textures[mode];
}

/* --- what is shown ------------------------------------------------------------------------------- */

const waiting = [], parts = [];
let now = null, mode = data.modes[0][0], held = false;
const load = async (k) => { waiting[k] ??= makePart(k); parts[k] = await waiting[k]; await colour(parts[k]); return parts[k]; };
const place = (k, frame = 0) => (held ? new THREE.Matrix4() : matrix(data.cameras[k][frame]));
const cameras = new THREE.Group(), paths = new THREE.Group();
const cameraRef = frustum(0x6fb7ff), cameraNext = frustum(0xffa94d);
cameras.add(cameraRef, cameraNext);
for (const { colour: tint, points: path } of data.paths)
  paths.add(lines(path.slice(1).flatMap((q, k) => [path[k], q]), tint, true));
body.add(cameras, paths);

/* place and visibility of everything, after any change */
function arrange() {
  const all = $("all").checked && !held, cloud = $("points").checked;
  for (const part of parts) {
    if (!part) continue;
    const shown = part === now;
    part.group.visible = shown || all;
    part.group.matrix.copy(place(part.k));
    part.mesh.visible = part.fringe.visible = shown && !cloud;
    part.cloud.visible = shown && cloud;
    part.some.visible = !shown;
    part.uniforms.still.value = !shown;
    part.uniforms.time.value = shown ? Number($("time").value) - part.k : 0;
    part.uniforms.motion.value = held ? part.raw : part.home;
  }
  cameraRef.matrix.copy(place(now.k));
  cameraNext.matrix.copy(place(now.k, 1));
  paths.visible = $("paths").checked && !held;
  cameras.visible = $("cameras").checked;
  draw();
}
/* the pair of a time; of several calls the last one counts */
async function setTime(value) {
  const t = Math.min(Math.max(Number(value) || 0, 0), last), k = Math.min(Math.floor(t), last - 1);
  $("time").value = t;
  const share = Math.round(100 * pairs[k].drawn);
  const names = data.names[k].slice(Math.floor(t - k), Math.ceil(t - k) + 1).join(" to ");
  $("now").textContent = `${names}, time ${Math.round(100 * t) / 100} of ${last}; ${share} % drawn`;
  if (now?.k !== k) {
    const part = await load(k);
    if (Math.min(Math.floor(Number($("time").value)), last - 1) !== k) return;
    now = part;
    showPictures(part.pictures);
    showMode();
  }
  arrange();
}
function showMode() {
  if (!now) return;
  const { title, legend } = now.pictures[mode];
  $("mode-title").textContent = title;
  $("mode-legend").innerHTML = legend || (mode === "image_next" ? "<p>On the points that it shows; dark grey = hidden there.</p>" : "");
}
async function setMode(name) {
  mode = name;
  shared.fromNext.value = name === "image_next";
  for (const button of $("modes").children) button.classList.toggle("on", button.value === name);
  await Promise.all(parts.filter(Boolean).map(colour));
  showMode();
  draw();
}
function fit(margin) {
  const { K: [[fx], [, fy]], size } = pairs[now.k], aspect = $("stage").clientWidth / $("stage").clientHeight;
  eye.fov = 2 * Math.atan(Math.max(size[1] / fy, size[0] / fx / aspect) * margin / 2) * 180 / Math.PI;
}
/* look from a point at another one, both in the axes of a camera */
function look(margin, from, at, pose = place(now.k)) {
  fit(margin);
  eye.position.set(...from).applyMatrix4(pose).applyMatrix4(body.matrix);
  controls.target.set(...at).applyMatrix4(pose).applyMatrix4(body.matrix);
}
const VIEWS = {
  aside: () => look(1, [0.2 * m, -0.17 * m, -0.45 * m], [0, 0.02 * m, m]),
  reference: () => look(1, [0, 0, 0], [0, 0, m]),
  next: () => { look(1, [0, 0, 0], [0, 0, m], place(now.k + 1)); return setTime(now.k + 1); },
  left: () => look(1.1, [-0.75 * m, -0.15 * m, 0.15 * m], [0, 0, m]),
  right: () => look(1.1, [0.75 * m, -0.15 * m, 0.15 * m], [0, 0, m]),
  top: () => {
    fit(1.3);
    const reach = Math.min(shared.far.value, 3 * m), height = 0.55 * reach / Math.tan(eye.fov * Math.PI / 360);
    /* ahead is up, whatever the camera's tilt */
    const level = new THREE.Matrix4().copyPosition(place(now.k));
    look(1.3, [0, -height, 0.5 * reach - 0.01 * m], [0, 0, 0.5 * reach], level);
  },
};
async function setView(name) {
  const moved = VIEWS[name]();
  eye.updateProjectionMatrix();
  controls.update();
  draw();
  await moved;
}
/* the address opens what is shown */
const asked = { mode, view: "aside" };
function remember(change) {
  Object.assign(asked, change);
  history.replaceState(null, "", `#mode=${asked.mode}&view=${asked.view}&time=${$("time").value}`);
}
function buttons(id, entries, act) {
  for (const [value, word] of entries) {
    const button = document.createElement("button");
    Object.assign(button, { value, textContent: word, onclick: () => act(value) });
    $(id).append(button);
  }
}
buttons("modes", data.modes, (name) => { setMode(name); remember({ mode: name }); });
buttons("views", Object.keys(VIEWS).map((name) => [name, name]), (view) => { setView(view); remember({ view }); });
/* confidence is 1 - sigma / 0.5; bytes hold sigma up to 0.5 */
function setLeast(value) {
  $("least").value = value;
  $("least-text").textContent = Number(value).toFixed(2);
  shared.most.value = 1 - Number(value);
  draw();
}
/* depths of the slider are even in their logarithm */
const near = 0.5 * m, deepest = Math.max(data.deepest * 1.001, 1.1 * near);
function setFar(depth) {
  shared.far.value = depth;
  $("far").value = Math.log(depth / near) / Math.log(deepest / near);
  $("far-text").textContent = `${depth.toPrecision(3)} ${data.unit}`;
  draw();
}
$("time").max = last;
$("all-label").hidden = last < 2;
$("time").oninput = () => setTime($("time").value);
$("time").onchange = () => remember({});
$("size").oninput = () => { shared.size.value = Number($("size").value); draw(); };
$("least").oninput = () => setLeast($("least").value);
$("drawn").onchange = () => { shared.withDrawn.value = $("drawn").checked; draw(); };
$("far").oninput = () => setFar(near * (deepest / near) ** $("far").value);
for (const id of ["points", "cameras", "paths"]) $(id).onchange = arrange;
/* held: both cameras stand in one place, and everything moves as they see it */
$("still").onchange = () => { held = $("still").checked; arrange(); };
$("all").onchange = async () => {
  for (let k = 0; k < last && $("all").checked; k++) {
    $("message").textContent = `loading ${k + 1} of ${last}`;
    await load(k);
  }
  $("message").textContent = "";
  arrange();
};
let playing = 0;
$("play").onclick = () => {
  if (playing) { cancelAnimationFrame(playing); playing = 0; $("play").textContent = "\u25b6"; return; }
  const long = last > 1 ? last / 2 : 1, began = performance.now() - 1000 * long * $("time").value / last;
  const step = (when) => {
    const t = ((when - began) / 1000) % (2 * long + 1);  /* there, a rest of half a second, and back */
    setTime(last * (t < long ? t : t < long + 0.5 ? long : t < 2 * long + 0.5 ? 2 * long + 0.5 - t : 0) / long);
    playing = requestAnimationFrame(step);
  };
  $("play").textContent = "\u25a0";
  playing = requestAnimationFrame(step);
};

/* --- a click, and what is saved ------------------------------------------------------------------ */

/* where a point of a pair is at its time, in the world; it is drawn if nothing hides it */
function moved(part, p) {
  const t = part.uniforms.time.value, table = held ? part.motionCamera : part.motion, k = 9 * part.labels[p];
  const at = (j) => new THREE.Vector3(table[k + j], table[k + j + 1], table[k + j + 2]);
  const turn = at(0), angle = turn.length(), pivot = at(3);
  const x = new THREE.Vector3().fromBufferAttribute(part.position, p).sub(pivot);
  if (angle > 1e-9) x.applyAxisAngle(turn.divideScalar(angle), t * angle);
  return x.add(pivot).addScaledVector(at(6), t).applyMatrix4(part.group.matrix);
}
const visible = (part, p) => part.position.getZ(p) < shared.far.value && part.sigma[p] / 255 <= shared.most.value
  && (shared.withDrawn.value || part.kind[p] < 2)
  && (part === now || (p % part.every === 0 && !part.component[part.labels[p]]));

/* the point of the pair nearest to the eye within a few pixels of a place of the canvas; -1 for none */
function pick(x, y) {
  const { clientWidth, clientHeight } = $("canvas");
  eye.updateMatrixWorld();
  const e = new THREE.Matrix4().multiplyMatrices(eye.projectionMatrix, eye.matrixWorldInverse).multiply(body.matrix).elements;
  let best = -1, nearest = Infinity;
  for (let p = 0; p < now.w * now.h; p++) {
    if (!visible(now, p)) continue;
    const q = moved(now, p), depth = e[3] * q.x + e[7] * q.y + e[11] * q.z + e[15];
    if (!(depth > 0) || depth >= nearest) continue;
    const u = (0.5 + 0.5 * (e[0] * q.x + e[4] * q.y + e[8] * q.z + e[12]) / depth) * clientWidth;
    const v = (0.5 - 0.5 * (e[1] * q.x + e[5] * q.y + e[9] * q.z + e[13]) / depth) * clientHeight;
    if (Math.abs(u - x) < 3 && Math.abs(v - y) < 3) { best = p; nearest = depth; }
  }
  return best;
}
function tell(p) {
  if (p < 0) { $("picked").textContent = "No point is shown there."; return; }
  const i = now.labels[p], sigma = now.sigma[p], own = now.component[i];
  const spread = sigma < 255 ? `${(sigma / 5.1).toFixed(sigma < 26 ? 1 : 0)} %` : "50 % or unknown";
  const part = own ? `component ${own}, ${data.origins[now.origin[i]]}` : "the static scene";
  $("picked").textContent = (last > 1 ? `${data.names[now.k][0]}, ` : "")
    + `pixel (${(p % now.w) * now.step}, ${Math.floor(p / now.w) * now.step}): depth`
    + ` ${now.position.getZ(p).toPrecision(4)} ${data.unit}, sigma ${spread}; superpixel ${i}, ${part}; ${data.kinds[now.kind[p]]}`;
}
let pressed = null;
$("canvas").addEventListener("pointerdown", (event) => { pressed = [event.clientX, event.clientY]; });
$("canvas").addEventListener("pointerup", (event) => {
  if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > 3) return;
  const box = $("canvas").getBoundingClientRect();
  tell(pick(event.clientX - box.left, event.clientY - box.top));
});

/* the points that are shown, where they are now, in their colours; of the next frame in those of the
   first picture. "number" is that of a pixel of the present pair */
function shownPoints() {
  const places = [], colours = [], number = new Map();
  for (const part of parts.filter((one) => one?.group.visible)) {
    const flat = document.createElement("canvas"), pen = flat.getContext("2d");
    [flat.width, flat.height] = [part.w, part.h];
    const texture = part.textures[shared.fromNext.value ? data.modes[0][0] : mode];
    pen.drawImage(texture.image, 0, 0, part.w, part.h);
    const pixels = pen.getImageData(0, 0, part.w, part.h).data;
    for (let p = 0; p < part.w * part.h; p++) {
      if (!visible(part, p)) continue;
      if (part === now) number.set(p, places.length);
      places.push(moved(part, p));
      colours.push(pixels.subarray(4 * p, 4 * p + 3));
    }
  }
  return { places, colours, number };
}
function ply() {
  const { places, colours } = shownPoints();
  const head = `ply\nformat binary_little_endian 1.0\ncomment time ${$("time").value}, x right, y down, z ahead\n`
    + `element vertex ${places.length}\nproperty float x\nproperty float y\nproperty float z\n`
    + "property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n";
  const rows = new DataView(new ArrayBuffer(15 * places.length));
  places.forEach((q, k) => {
    [q.x, q.y, q.z].forEach((x, j) => rows.setFloat32(15 * k + 4 * j, x, true));
    colours[k].forEach((c, j) => rows.setUint8(15 * k + 12 + j, c));
  });
  return new Blob([head, rows.buffer]);
}
/* glTF: y up, z towards the viewer; the surface where it is shown alone, else points */
function glb() {
  const { places, colours, number } = shownPoints(), count = places.length, index = [];
  if (now.mesh.visible && number.size === count)
    for (let k = 0; k < now.corners.length; k += 3) {
      const three = [...now.corners.subarray(k, k + 3)].map((p) => number.get(p));
      if (!three.includes(undefined)) index.push(...three);
    }
  const xyz = Float32Array.from(places.flatMap((q) => [q.x, -q.y, -q.z]));
  const tint = Uint8Array.from(colours.flatMap((c) => [...c, 255])), faces = Uint32Array.from(index);
  const { min, max } = new THREE.Box3().setFromArray(xyz);
  const accessors = [
    { bufferView: 0, componentType: 5126, count, type: "VEC3", min: min.toArray(), max: max.toArray() },
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


/* report.html#mode=depth_ref&time=1&view=top opens that view, also while the page is shown */
async function show() {
  const request = new URLSearchParams(location.hash.slice(1)), name = request.get("mode"), view = request.get("view");
  await setTime(request.get("time"));
  await setMode(data.modes.some(([one]) => one === name) ? name : data.modes[0][0]);
  await setView(view in VIEWS ? view : "aside");
  if (request.has("time")) await setTime(request.get("time"));
}
addEventListener("hashchange", show);
setFar(data.far);
resize();
await show();
$("message").textContent = "";
document.body.dataset.ready = "yes";
window.soupView = { setMode, setTime, setView, setFar, setLeast, pick, tell, ply, glb, eye, modes: data.modes.map(([one]) => one) };
})().catch((error) => {
  document.getElementById("message").textContent = `The 3D view failed: ${error.message}`;
  throw error;
});
