/* The page of a chain: static scene, what moves, cameras and paths by frame. */
"use strict";
(async () => {
const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent), scene = data.scene, frames = data.frames;

/* numbers that were deflated and written as base64 */
async function unpack(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Kind(await new Response(stream).arrayBuffer());
}

let draw = () => {}, showFrame = () => {};
function show() {
  const k = Number($("time").value);
  $("image").src = frames[k][0];
  $("depth").src = frames[k][1];
  $("image").alt = "frame " + k;
  $("depth").alt = "depth of frame " + k;
  $("now").textContent = `frame ${k}: ${data.names[k]}, ${Math.round(100 * data.guess[k])}% a guess`;
  showFrame(k);
}
$("time").addEventListener("input", show);
let timer = null;
$("play").addEventListener("click", () => {
  if (timer) { clearInterval(timer); timer = null; $("play").textContent = "play"; return; }
  $("play").textContent = "stop";
  timer = setInterval(() => {
    $("time").value = (Number($("time").value) + 1) % frames.length;
    show();
  }, 250);
});

let renderer = null;
try {
  renderer = new THREE.WebGLRenderer({ canvas: $("canvas"), antialias: true, preserveDrawingBuffer: true });
} catch (error) {
  $("message").textContent = "This browser shows no WebGL 2: the 3D view is left out.";
}
if (renderer) {
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setClearColor(0x20262e);
  const world = new THREE.Scene(), body = new THREE.Group();
  /* y up, as viewers expect */
  body.matrixAutoUpdate = false;
  body.matrix.makeScale(1, -1, -1);
  world.add(body);
  /* colours are written as they are */
  const size = { value: 2 * renderer.getPixelRatio() };
  const material = new THREE.ShaderMaterial({
    uniforms: { size }, glslVersion: THREE.GLSL3,
    vertexShader: `in vec3 tint; out vec3 shade; uniform float size;
      void main() {
        shade = tint;
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
        gl_PointSize = size;
      }`,
    fragmentShader: `precision highp float; in vec3 shade; out vec4 colour;
      void main() { colour = vec4(shade, 1.0); }`,
  });
  const cloud = async (packed) => {
    const own = new THREE.BufferGeometry();
    const colours = new THREE.BufferAttribute(await unpack(packed.colours, Uint8Array), 3, true);
    own.setAttribute("position", new THREE.BufferAttribute(await unpack(packed.points, Float32Array), 3));
    own.setAttribute("tint", colours);
    const out = new THREE.Points(own, material);
    out.frustumCulled = false;
    return out;
  };
  const line = (corners, colour) => {
    const ends = corners.slice(1).flatMap((c, k) => [...corners[k], ...c]);
    const own = new THREE.BufferGeometry();
    own.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(ends), 3));
    const out = new THREE.LineSegments(own, new THREE.LineBasicMaterial({ color: colour, depthTest: false }));
    out.renderOrder = 1;
    out.frustumCulled = false;
    return out;
  };
  const still = await cloud(scene.still);
  const moving = await Promise.all(scene.moving.map(cloud));
  body.add(still, ...moving);
  const paths = new THREE.Group();
  for (const track of scene.tracks) paths.add(line(track.path, track.colour));
  const cameras = new THREE.Group(), eyes = scene.cameras.map((m) => [m[0][3], m[1][3], m[2][3]]);
  cameras.add(line(eyes, 0xffa94d));
  const s = 0.08 * scene.middle, [fx, fy, cx, cy] = scene.K, [width, height] = scene.size;
  const corner = (u, v) => [s * (u - cx) / fx, s * (v - cy) / fy, s];
  const [a, b, c, d] = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)], o = [0, 0, 0];
  const now = line([o, a, b, o, c, d, o, a, d, c, b], 0xffa94d);
  now.matrixAutoUpdate = false;
  cameras.add(now);
  body.add(paths, cameras);

  const eye = new THREE.PerspectiveCamera(40, 1, scene.middle / 200, scene.far * 4);
  const controls = new THREE.OrbitControls(eye, $("canvas"));
  const up = (x, y, z) => new THREE.Vector3(x, -y, -z), m = scene.middle;
  const [x, y, z] = eyes[eyes.length - 1];
  const VIEWS = {
    aside: () => { eye.position.copy(up(0.26 * m, -0.27 * m, -0.48 * m)); controls.target.copy(up(x / 2, y / 2, 0.6 * m)); },
    above: () => { eye.position.copy(up(x / 2, -1.6 * m, m / 2 + z / 2)); controls.target.copy(up(x / 2, 0, m / 2 + z / 2 + 0.01 * m)); },
    camera: () => {
      const pose = new THREE.Matrix4().set(...scene.cameras[Number($("time").value)].flat());
      eye.position.copy(new THREE.Vector3(0, 0, 0).applyMatrix4(pose).applyMatrix4(body.matrix));
      controls.target.copy(new THREE.Vector3(0, 0, m).applyMatrix4(pose).applyMatrix4(body.matrix));
    },
  };
  let wanted = false;
  draw = () => {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => { wanted = false; controls.update(); renderer.render(world, eye); });
  };
  showFrame = (k) => {
    moving.forEach((own, j) => { own.visible = j === k && $("movers").checked; });
    now.matrix.set(...scene.cameras[k].flat());
    if ($("follow").checked) VIEWS.camera();
    draw();
  };
  const resize = () => {
    const stage = $("stage");
    renderer.setSize(stage.clientWidth, stage.clientHeight, false);
    eye.aspect = stage.clientWidth / stage.clientHeight;
    eye.updateProjectionMatrix();
    draw();
  };
  for (const name of Object.keys(VIEWS)) {
    const button = document.createElement("button");
    button.textContent = name;
    button.onclick = () => { VIEWS[name](); draw(); };
    $("views").append(button);
  }
  $("size").oninput = () => { size.value = Number($("size").value) * renderer.getPixelRatio(); draw(); };
  $("paths").onchange = () => { paths.visible = $("paths").checked; draw(); };
  $("cameras").onchange = () => { cameras.visible = $("cameras").checked; draw(); };
  $("movers").onchange = () => show();
  $("follow").onchange = () => show();
  controls.addEventListener("change", draw);
  addEventListener("resize", resize);
  VIEWS.aside();
  resize();
  if (still.geometry.attributes.position.count) $("message").remove();
  else $("message").textContent = "All depth of the static scene is a guess: nothing of it is drawn.";
}
show();
document.body.dataset.ready = "yes";
})();
