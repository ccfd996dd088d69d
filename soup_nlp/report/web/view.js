/* What the pages of a pair and of a chain share: their data, a 3D view, lines and cameras. */
"use strict";
const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent), scene = data.scene;

/* numbers that were deflated and written as base64 */
async function unpack(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Kind(await new Response(stream).arrayBuffer());
}

/* an empty view in the canvas; null where the browser has no WebGL 2 */
function makeView(degrees, farthest) {
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: $("canvas"), antialias: true, preserveDrawingBuffer: true });
  } catch (error) {
    $("message").textContent = "This browser shows no WebGL 2: the 3D view is left out, the pictures are below.";
    return null;
  }
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  renderer.setClearColor(0x20262e);
  /* y up and z towards the viewer, as viewers expect */
  const world = new THREE.Scene(), body = new THREE.Group();
  body.matrixAutoUpdate = false;
  body.matrix.makeScale(1, -1, -1);
  world.add(body);
  const eye = new THREE.PerspectiveCamera(degrees, 1, scene.middle / 200, 4 * farthest);
  const controls = new THREE.OrbitControls(eye, $("canvas"));
  const view = { renderer, body, eye, controls, before: () => {} };
  let wanted = false;
  view.draw = () => {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => { wanted = false; controls.update(); view.before(); renderer.render(world, eye); });
  };
  view.resize = () => {
    const { clientWidth, clientHeight } = $("stage");
    renderer.setSize(clientWidth, clientHeight, false);
    eye.aspect = clientWidth / clientHeight;
    eye.updateProjectionMatrix();
    view.draw();
  };
  /* look from a point at another one, both in the axes of the first camera or moved by a pose */
  view.look = (from, at, pose = new THREE.Matrix4()) => {
    eye.position.set(...from).applyMatrix4(pose).applyMatrix4(body.matrix);
    controls.target.set(...at).applyMatrix4(pose).applyMatrix4(body.matrix);
  };
  controls.addEventListener("change", view.draw);
  addEventListener("resize", view.resize);
  return view;
}

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
function frustum(colour, above = false) {
  const [[fx, , cx], [, fy, cy]] = scene.K, [width, height] = scene.size, s = 0.09 * scene.middle;
  const corner = (u, v) => [s * (u - cx) / fx, s * (v - cy) / fy, s];
  const [a, b, c, d] = [corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
  const top = corner(width / 2, -0.2 * height), o = [0, 0, 0];
  const out = lines([o, a, o, b, o, c, o, d, a, b, b, c, c, d, d, a, a, top, top, b], colour, above);
  out.matrixAutoUpdate = false;
  return out;
}
const matrix = (rows) => new THREE.Matrix4().set(...rows.flat());

function buttons(id, entries, act) {
  for (const [value, word] of entries) {
    const button = document.createElement("button");
    Object.assign(button, { value, textContent: word, onclick: () => act(value) });
    $(id).append(button);
  }
}
