/* The page of a chain: static scene, what moves, cameras and paths by frame. */
(async () => {
const frames = data.frames;
let showFrame = () => {};
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

const view = makeView(40, scene.far);
if (view) {
  const { renderer, body, draw } = view;
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
  const path = (corners, colour) => lines(corners.slice(1).flatMap((c, k) => [corners[k], c]), colour, true);
  const still = await cloud(scene.still);
  const moving = await Promise.all(scene.moving.map(cloud));
  body.add(still, ...moving);
  const paths = new THREE.Group();
  for (const track of scene.tracks) paths.add(path(track.path, track.colour));
  const cameras = new THREE.Group(), eyes = scene.cameras.map((m) => [m[0][3], m[1][3], m[2][3]]);
  const now = frustum(0xffa94d, true);
  cameras.add(path(eyes, 0xffa94d), now);
  body.add(paths, cameras);

  const m = scene.middle, [x, y, z] = eyes[eyes.length - 1];
  const VIEWS = {
    aside: () => view.look([0.26 * m, -0.27 * m, -0.48 * m], [x / 2, y / 2, 0.6 * m]),
    above: () => view.look([x / 2, -1.6 * m, m / 2 + z / 2], [x / 2, 0, m / 2 + z / 2 + 0.01 * m]),
    camera: () => view.look([0, 0, 0], [0, 0, m], matrix(scene.cameras[Number($("time").value)])),
  };
  showFrame = (k) => {
    moving.forEach((own, j) => { own.visible = j === k && $("movers").checked; });
    now.matrix.copy(matrix(scene.cameras[k]));
    if ($("follow").checked) VIEWS.camera();
    draw();
  };
  buttons("views", Object.keys(VIEWS).map((name) => [name, name]), (name) => { VIEWS[name](); draw(); });
  $("size").oninput = () => { size.value = Number($("size").value) * renderer.getPixelRatio(); draw(); };
  $("paths").onchange = () => { paths.visible = $("paths").checked; draw(); };
  $("cameras").onchange = () => { cameras.visible = $("cameras").checked; draw(); };
  $("movers").onchange = show;
  $("follow").onchange = show;
  VIEWS.aside();
  view.resize();
  if (still.geometry.attributes.position.count) $("message").remove();
  else $("message").textContent = "All depth of the static scene is a guess: nothing of it is drawn.";
}
show();
document.body.dataset.ready = "yes";
})();
