// The scene in WebGL 2: drawing, the camera, mouse and keys.
"use strict";

const canvas = document.getElementById("view");
const gl = canvas.getContext("webgl2", { alpha: false, antialias: !inSoftware() });
if (!gl) {
  document.getElementById("notes").textContent = "This browser draws no WebGL 2. Switch it on, or open the address in another one.";
  throw new Error("no WebGL 2");
}
canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
canvas.addEventListener("webglcontextrestored", () => location.reload());
function inSoftware() { // in software, smooth edges of faces cost a fifth of the frames; discs and lines are smooth by themselves
  const probe = document.createElement("canvas").getContext("webgl2");
  const told = probe && probe.getExtension("WEBGL_debug_renderer_info");
  return /swiftshader|llvmpipe|software/i.test(told ? probe.getParameter(told.UNMASKED_RENDERER_WEBGL) : "");
}
const $ = (id) => document.getElementById(id);
let scene = null, walls = [], ground = null, figures = {}, x = null, turned = null, held = null, dirty = true, frames = 0, fps = 0;
const show = { strain: false, particles: false };

// Shader programs. All of them are 3D; a 2D scene has z = 0.

const HEAD = "#version 300 es\nprecision highp float;\nuniform mat4 look; uniform vec2 size; uniform float flat2;\n";

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, HEAD + text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

// Discs, and balls in 3D: squares that face the camera. radius: in scene units; a negative one is in pixels.
const discs = program(
  `layout(location=0) in vec2 corner; layout(location=1) in vec3 center; layout(location=2) in float radius;
   layout(location=3) in vec4 color; uniform float pixels; out vec2 at; out vec4 hue;
   void main() {
     vec4 p = look * vec4(center, 1.0);
     if (radius == 0.0) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
     float r = radius > 0.0 ? max(radius * pixels / (flat2 > 0.5 ? 1.0 : p.w), 1.5) : -radius;
     at = corner * (1.0 + 1.0 / r); hue = color;
     p.xy += 2.0 * corner * (r + 1.0) / size * p.w;
     gl_Position = p;
   }`,
  `in vec2 at; in vec4 hue; out vec4 color;
   void main() {
     float rr = dot(at, at), edge = fwidth(rr);
     if (rr > 1.0 + edge) discard;
     float light = 1.0;
     if (flat2 < 0.5) light = 0.35 + 0.65 * max(0.0, dot(vec3(at, sqrt(max(0.0, 1.0 - rr))), normalize(vec3(-0.4, 0.6, 0.8))));
     else light = hue.a < 0.5 ? 0.82 : rr > 0.72 ? 0.78 : 1.0;
     color = vec4(hue.rgb * light, 1.0 - smoothstep(1.0 - edge, 1.0 + edge, rr));
   }`);

// Lines with round ends. wide: half of their width, in pixels, or, negative, in scene units; a number, or one of each line.
const lines = program(
  `layout(location=0) in vec2 corner; layout(location=1) in vec3 a; layout(location=2) in vec3 b;
   layout(location=3) in vec4 color; layout(location=4) in float wide; uniform float pixels; out vec2 at; out float len; out vec4 hue; out float r;
   void main() {
     vec4 p = look * vec4(a, 1.0), q = look * vec4(b, 1.0);
     vec2 d = (q.xy / q.w - p.xy / p.w) * size / 2.0;
     float l = length(d); vec2 t = l > 1e-6 ? d / l : vec2(1.0, 0.0), n = vec2(-t.y, t.x);
     vec4 end = corner.x > 0.0 ? q : p;
     r = max(0.6, wide > 0.0 ? wide : -wide * pixels / (flat2 > 0.5 ? 1.0 : end.w));
     at = vec2(corner.x > 0.0 ? l + r + 1.0 : -r - 1.0, corner.y * (r + 1.0)); len = l; hue = color;
     end.xy += 2.0 * ((corner.x > 0.0 ? 1.0 : -1.0) * (r + 1.0) * t + at.y * n) / size * end.w;
     end.z -= 1e-4 * end.w;
     gl_Position = end;
   }`,
  `in vec2 at; in float len; in vec4 hue; in float r; out vec4 color;
   void main() {
     float far = length(vec2(at.x - clamp(at.x, 0.0, len), at.y));
     float cover = clamp(r + 0.5 - far, 0.0, 1.0);
     if (cover <= 0.0) discard;
     color = vec4(hue.rgb, hue.a * cover);
   }`);

const faces = program(
  `layout(location=1) in vec3 place; layout(location=3) in vec3 color; out vec3 hue; out vec3 at;
   void main() { hue = color; at = place; gl_Position = look * vec4(place, 1.0); }`,
  `in vec3 hue; in vec3 at; out vec4 color; uniform vec3 eye;
   void main() {
     float light = 0.82;
     if (flat2 < 0.5) {
       vec3 n = normalize(cross(dFdx(at), dFdy(at)));
       light = 0.4 + 0.6 * abs(dot(n, normalize(normalize(eye - at) + vec3(0.2, 0.5, 0.1))));
     }
     color = vec4(hue * light, 1.0);
   }`);

const buffers = {};
function upload(name, data, kind = gl.ARRAY_BUFFER) {
  buffers[name] = buffers[name] || gl.createBuffer();
  gl.bindBuffer(kind, buffers[name]);
  gl.bufferData(kind, data, gl.DYNAMIC_DRAW);
}
function attribute(where, name, width, stride = 0, offset = 0, norm = false) {
  gl.bindBuffer(gl.ARRAY_BUFFER, buffers[name]);
  gl.enableVertexAttribArray(where);
  gl.vertexAttribPointer(where, width, norm ? gl.UNSIGNED_BYTE : gl.FLOAT, norm, stride, offset);
}

// Squares with all corners written out: in software, each instance costs as much as a draw call.
let room = 0;
function fourfold(data, width) { // repeat each row for its four corners
  const out = new data.constructor(4 * data.length);
  for (let i = 0; i < data.length; i += width) {
    for (let k = 0; k < 4; k++) for (let c = 0; c < width; c++) out[4 * i + k * width + c] = data[i + c];
  }
  return out;
}
function squares(count) {
  if (count > room) {
    room = 2 * count;
    const corners = new Float32Array(8 * room), order = new Uint32Array(6 * room);
    for (let i = 0; i < room; i++) {
      corners.set([-1, -1, 1, -1, -1, 1, 1, 1], 8 * i);
      order.set([4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 2, 4 * i + 1, 4 * i + 3], 6 * i);
    }
    upload("corners", corners);
    upload("order", order, gl.ELEMENT_ARRAY_BUFFER);
  }
  attribute(0, "corners", 2);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.order);
  gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
}

// The camera.

const eye = { center: [0, 0, 0], scale: 100, far: 3, turn: 0.5, lift: 0.35, chosen: false }; // chosen: the user has moved it
let look = new Float32Array(16), unlook = null, place = [0, 0, 1], pixels = 1;
const sub = (a, b) => a.map((v, k) => v - b[k]), add = (a, b, s = 1) => a.map((v, k) => v + s * b[k]);
const dot = (a, b) => a.reduce((t, v, k) => t + v * b[k], 0), unit = (a) => { const l = Math.hypot(...a) || 1; return a.map((v) => v / l); };
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

function axes() { // of the camera: right, up, and backwards
  const up = unit(scene.up), side = unit(cross(up, Math.abs(up[2]) < 0.9 ? [0, 0, 1] : [0, -1, 0])), front = cross(side, up);
  const out = add(add(add([0, 0, 0], up, Math.sin(eye.lift)), front, Math.cos(eye.lift) * Math.cos(eye.turn)), side, Math.cos(eye.lift) * Math.sin(eye.turn));
  const right = unit(cross(up, out));
  return [right, cross(out, right), out];
}

function fit() {
  if (!scene) return;
  const low = [...scene.low, 0].slice(0, 3), high = [...scene.high, 0].slice(0, 3), span = sub(high, low);
  eye.center = add(low, span, 0.5);
  const keys = $("keys").offsetHeight * devicePixelRatio;
  eye.scale = Math.min(canvas.width / (span[0] || 1), (canvas.height - keys) / (span[1] || 1)) * 0.88 || 100;
  if (scene.dim === 2) eye.center[1] -= keys / 2 / eye.scale * scene.up[1];
  eye.far = 1.5 * Math.hypot(...span) || 1;
  eye.turn = 0.5; eye.lift = 0.3; eye.chosen = false;
  dirty = true;
}

function keepAbove() { // neither the middle of the view nor the eye gets below the floor
  if (ground === null) return;
  const up = unit(scene.up), above = dot(eye.center, up) - ground;
  eye.center = add(eye.center, up, Math.max(0, -above));
  eye.lift = Math.max(eye.lift, Math.asin(Math.max(-1, 0.02 - Math.max(0, above) / eye.far))); // 0.02: nothing nearer is shown
}

function aim() {
  const w = canvas.width, h = canvas.height;
  if (scene.dim === 2) {
    const s = eye.scale, c = eye.center, y = scene.up[1]; // 1, or -1 where y points down
    place = [c[0], c[1], 1]; pixels = s;
    look.set([2 * s / w, 0, 0, 0, 0, 2 * s * y / h, 0, 0, 0, 0, -0.001, 0, -2 * s / w * c[0], -2 * s * y / h * c[1], 0, 1]);
  } else {
    keepAbove();
    const [r, u, o] = axes(), f = 1 / Math.tan(0.4), near = eye.far * 0.02, far = eye.far * 20;
    place = add(eye.center, o, eye.far); pixels = f * h / 2;
    const a = f * h / w, zz = -(far + near) / (far - near), zw = -2 * far * near / (far - near);
    const t = [-dot(r, place), -dot(u, place), -dot(o, place)];
    for (let k = 0; k < 3; k++) look.set([a * r[k], f * u[k], zz * o[k], -o[k]], 4 * k);
    look.set([a * t[0], f * t[1], zz * t[2] + zw, -t[2]], 12);
  }
}

function project(p) { // returns pixels on the canvas, and the distance
  const q = [0, 1, 2, 3].map((k) => look[k] * p[0] + look[4 + k] * p[1] + look[8 + k] * p[2] + look[12 + k]);
  return [(q[0] / q[3] + 1) * canvas.width / 2, (1 - q[1] / q[3]) * canvas.height / 2, q[3]];
}

function under(px, py, through) { // returns the point under the mouse at the distance of `through`
  if (scene.dim === 2) return [eye.center[0] + (px - canvas.width / 2) / eye.scale, eye.center[1] - scene.up[1] * (py - canvas.height / 2) / eye.scale, 0];
  const [r, u, o] = axes(), w = dot(sub(place, through), o) / pixels;
  return add(add(add(place, o, -w * pixels), r, (px - canvas.width / 2) * w), u, (canvas.height / 2 - py) * w);
}

const at = (i) => (scene.dim === 2 ? [x[2 * i], x[2 * i + 1], 0] : [x[3 * i], x[3 * i + 1], x[3 * i + 2]]);

function pick(px, py) { // returns the particle under the mouse, or -1
  let best = -1, least = Infinity;
  for (let i = 0; x && i < scene.radius.length; i++) {
    const [qx, qy, w] = project(at(i)), r = scene.radius[i] * pixels / (scene.dim === 2 ? 1 : w);
    const gap = Math.hypot(qx - px, qy - py) - r, miss = Math.max(0, gap);
    if (w < 0 || miss > 12 * devicePixelRatio) continue;
    const cost = scene.dim === 2 ? gap : miss * 1e3 + w;
    if (cost < least) [best, least] = [i, cost];
  }
  return best;
}

// Drawing.

function three(flat) { // returns positions with three components
  if (scene.dim === 3) return flat;
  const out = new Float32Array(flat.length / 2 * 3);
  for (let i = 0; 2 * i < flat.length; i++) { out[3 * i] = flat[2 * i]; out[3 * i + 1] = flat[2 * i + 1]; }
  return out;
}

const MARK = [24, 26, 32, 255], SPOT = 0.5; // marks that show rotation: their color, and the radius of a spot on a ball, in radii
const dark = () => matchMedia("(prefers-color-scheme: dark)").matches;

function hue(strain) { // grey at rest, blue shorter, red longer: full at a tenth, as in recordings
  const s = Math.min(1, Math.max(0, Math.log10(Math.abs(strain) / 1e-4 + 1e-9) / 3)), end = strain > 0 ? [255, 92, 48] : [64, 140, 255];
  return [170, 172, 182].map((c, k) => c + s * (end[k] - c));
}

function use(made) {
  gl.useProgram(made);
  gl.uniformMatrix4fv(gl.getUniformLocation(made, "look"), false, look);
  gl.uniform2f(gl.getUniformLocation(made, "size"), canvas.width, canvas.height);
  gl.uniform1f(gl.getUniformLocation(made, "flat2"), scene.dim === 2 ? 1 : 0);
  gl.uniform1f(gl.getUniformLocation(made, "pixels"), pixels);
  return (name) => gl.getUniformLocation(made, name);
}

function drawLines(name, ends, colors, wide) {
  if (!ends.length) return;
  upload(name, fourfold(ends, 6));
  upload(name + ".color", fourfold(colors, 4));
  use(lines);
  if (wide.length) {
    upload(name + ".wide", fourfold(wide, 1));
    attribute(4, name + ".wide", 1);
  } else {
    gl.disableVertexAttribArray(4);
    gl.vertexAttrib1f(4, wide);
  }
  attribute(1, name, 3, 24, 0);
  attribute(2, name, 3, 24, 12);
  attribute(3, name + ".color", 4, 0, 0, true);
  squares(ends.length / 6);
}

function drawDiscs(name, centers, radius, hues) {
  use(discs);
  upload(name, fourfold(centers, 3));
  attribute(1, name, 3);
  attribute(2, radius, 1);
  attribute(3, hues, 4, 0, 0, true);
  squares(centers.length / 3);
}

function drawRims(points) { // the rounded edges of bodies, in the shade of their faces
  const ends = new Float32Array(6 * scene.edges.length), colors = new Uint8Array(4 * scene.edges.length);
  scene.edges.forEach(([a, b], j) => {
    for (let c = 0; c < 3; c++) { ends[6 * j + c] = points[3 * a + c]; ends[6 * j + 3 + c] = points[3 * b + c]; }
    colors.set([...mix(a, b).map((v) => 0.82 * v), 255], 4 * j);
  });
  drawLines("rims", ends, colors, new Float32Array(scene.edge_radius.map((r) => -r)));
}

function drawMarks(points, n) { // how far particles have turned: a line to the rim of a disc, two spots on a ball, as in recordings
  const spots = new Float32Array(6 * n), flat = scene.dim === 2;
  for (let i = 0; i < n; i++) {
    const r = hidden(i) ? 0 : scene.radius[i], c = points.subarray(3 * i, 3 * i + 3);
    if (flat) {
      spots.set([...c, c[0] + r * Math.cos(turned[i]), c[1] + r * Math.sin(turned[i]), 0], 6 * i);
    } else { // the first axis, turned by the quaternion
      const [a, b, d, w] = turned.subarray(4 * i, 4 * i + 4), s = (1.02 - SPOT) * r;
      const axis = [1 - 2 * (b * b + d * d), 2 * (a * b + d * w), 2 * (a * d - b * w)];
      for (let k = 0; k < 3; k++) { spots[6 * i + k] = c[k] + s * axis[k]; spots[6 * i + 3 + k] = c[k] - s * axis[k]; }
    }
  }
  if (flat) drawLines("marks", spots, scene.marks, devicePixelRatio);
  else drawDiscs("marks", spots, "spots", "spots.color");
}

function crosses(points, a, b) { // whether two particles are nearer to each other across the periodic box
  return scene.box.some((length, c) => length && Math.abs(points[3 * a + c] - points[3 * b + c]) > length / 2);
}

function draw() {
  requestAnimationFrame(draw);
  const w = Math.round(canvas.clientWidth * devicePixelRatio), h = Math.round(canvas.clientHeight * devicePixelRatio);
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w; canvas.height = h; dirty = true;
    if (!eye.chosen) fit();
  }
  if (!dirty || !scene || !x) return;
  dirty = false;
  aim();
  gl.viewport(0, 0, w, h);
  const back = dark() ? [18, 20, 26] : [244, 245, 247];
  gl.clearColor(back[0] / 255, back[1] / 255, back[2] / 255, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  if (scene.dim === 3) gl.enable(gl.DEPTH_TEST); else gl.disable(gl.DEPTH_TEST);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  const points = three(x), n = scene.radius.length;

  if (scene.triangles.length) {
    const where = use(faces);
    gl.uniform3f(where("eye"), ...place);
    upload("points", points);
    attribute(1, "points", 3);
    attribute(3, "color", 3, 4, 0, true);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers.triangles);
    gl.drawElements(gl.TRIANGLES, 3 * scene.triangles.length, gl.UNSIGNED_INT, 0);
  }
  drawRims(points);
  for (const [k, wall] of walls.entries()) {
    if (wall.faces.length) {
      const where = use(faces);
      gl.uniform3f(where("eye"), ...place);
      upload("solid" + k, new Float32Array(wall.vertices));
      upload("sides" + k, new Uint32Array(wall.faces.flat()), gl.ELEMENT_ARRAY_BUFFER);
      attribute(1, "solid" + k, 3);
      gl.disableVertexAttribArray(3);
      gl.vertexAttrib4f(3, ...(dark() ? [0.36, 0.38, 0.45, 1] : [0.78, 0.8, 0.84, 1]));
      gl.drawElements(gl.TRIANGLES, 3 * wall.faces.length, gl.UNSIGNED_INT, 0);
      continue;
    }
    const ends = [];
    for (const strip of wall.strips) for (let i = 1; i < strip.length; i++) {
      for (const p of [strip[i - 1], strip[i]]) ends.push(p[0], p[1], p[2] || 0);
    }
    const color = new Uint8Array(ends.length / 6 * 4).map((_, j) => [120, 125, 140, 255][j % 4]);
    drawLines("wall" + k, new Float32Array(ends), color, wall.radius ? -wall.radius : 1.2 * devicePixelRatio);
  }
  let drawn = show.strain ? scene.whole : scene.loose;
  if (scene.box) drawn = drawn.filter((k) => !crosses(points, ...scene.links[k]));
  const ends = new Float32Array(6 * drawn.length), colors = new Uint8Array(4 * drawn.length);
  drawn.forEach((k, j) => {
    const [a, b] = scene.links[k];
    for (let c = 0; c < 3; c++) { ends[6 * j + c] = points[3 * a + c]; ends[6 * j + 3 + c] = points[3 * b + c]; }
    let color = mix(a, b);
    if (show.strain) {
      const d = Math.hypot(...[0, 1, 2].map((c) => ends[6 * j + c] - ends[6 * j + 3 + c]));
      color = scene.rest[k] ? hue(d / scene.rest[k] - 1) : [170, 172, 182];
    }
    colors.set([...color, 255], 4 * j);
  });
  drawLines("links", ends, colors, (show.strain ? 1.6 : 1.2) * devicePixelRatio);

  drawDiscs("centers", points, show.particles ? "radius" : "seen", "hues");
  if (turned) drawMarks(points, n);
  if (figures.target && figures.held < n) {
    gl.disable(gl.DEPTH_TEST);
    const line = new Float32Array([...at(figures.held), ...[...figures.target, 0].slice(0, 3)]);
    drawLines("hand", line, new Uint8Array(dark() ? [255, 255, 255, 230] : [20, 24, 40, 230]), 1.5 * devicePixelRatio);
  }
}

// Messages from the world.

const url = new URL("socket", location.href);
url.protocol = "ws:";
let socket = null, counted = performance.now();
const say = (message) => { if (socket.readyState === 1) socket.send(JSON.stringify(message)); };

function connect() {
  socket = new WebSocket(url);
  socket.binaryType = "arraybuffer";
  socket.onmessage = hear;
  socket.onclose = () => {
    $("notes").textContent = "The world has ended, or cannot be reached. If it was run again, open the new address.";
    setTimeout(connect, 2000);
  };
}

function hear({ data }) {
  if (typeof data !== "string") {
    requestAnimationFrame(() => say({ do: "shown" }));
    const length = new DataView(data).getUint32(0, true), count = scene.dim * scene.radius.length;
    figures = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    x = new Float32Array(data, 4 + length, count);
    const n = scene.radius.length, turns = scene.turns ? (scene.dim === 2 ? n : 4 * n) : 0;
    turned = turns ? new Float32Array(data, 4 + length + 4 * count, turns) : null;
    const end = 4 + length + 4 * (count + turns);
    if (data.byteLength > end) paint(new Uint8Array(data, end));
    frames++;
    dirty = true;
    tell();
    return;
  }
  const message = JSON.parse(data);
  if (message.kind === "scene") take(message);
  if (message.kind === "walls") { walls = message.walls; ground = message.floor; dirty = true; }
  if (message.kind === "broken") { scene.broken = new Set(message.links); sort(); }
  if (message.kind === "told") { $("named").textContent = message.text; $("named").hidden = false; }
}
connect();

function sort() { // find the links that are drawn: those that are whole, and the ones among them that no surface covers
  scene.whole = scene.links.map((_, k) => k).filter((k) => !scene.broken.has(k));
  scene.loose = scene.whole.filter((k) => !(scene.covered[scene.links[k][0]] && scene.covered[scene.links[k][1]]));
  dirty = true;
}

// Particles of a surface have its shade in 2D. In 3D they are hidden, except pinned ones.
const hidden = (i) => scene.covered[i] && !scene.pinned[i];
const mix = (a, b) => [0, 1, 2].map((k) => (scene.color[3 * a + k] + scene.color[3 * b + k]) / 2); // the colour between two

function paint(colors) { // give particles their colours: red, green and blue of each
  const hues = new Uint8Array(4 * scene.radius.length);
  for (let i = 0; 4 * i < hues.length; i++) {
    for (let k = 0; k < 3; k++) hues[4 * i + k] = colors[3 * i + k];
    hues[4 * i + 3] = hidden(i) && scene.dim === 2 ? 0 : 255;
  }
  scene.color = colors;
  upload("color", hues);
  upload("hues", fourfold(hues, 4));
}

function take(message) {
  const first = !scene;
  scene = message;
  x = null; // the next frame has the particles of this scene
  scene.up = [...scene.up, 0].slice(0, 3);
  scene.broken = new Set();
  document.title = scene.title;
  $("title").textContent = scene.title;
  sort();
  const dots = scene.radius.map((r) => r > 0 ? r : -3);
  upload("radius", fourfold(new Float32Array(dots), 1));
  upload("seen", fourfold(new Float32Array(dots.map((r, i) => hidden(i) && (scene.dim === 3 || r < 0) ? 0 : r)), 1));
  paint(scene.color);
  upload("triangles", new Uint32Array(scene.triangles.flat()), gl.ELEMENT_ARRAY_BUFFER);
  scene.marks = new Uint8Array(scene.radius.flatMap(() => MARK));
  upload("spots", fourfold(new Float32Array(scene.radius.flatMap((r, i) => Array(2).fill(hidden(i) ? 0 : SPOT * r))), 1));
  upload("spots.color", fourfold(new Uint8Array(scene.radius.flatMap(() => [...MARK, ...MARK])), 4));
  if (first) fit();
}

let last = 0;
function tell() {
  const now = performance.now();
  if (now - last < 150) return;
  if (now - counted > 1000) { fps = 1000 * frames / (now - counted); frames = 0; counted = now; }
  last = now;
  const f = figures, short = (v) => (v === null ? "not finite" : v === 0 ? "0" : Math.abs(v) >= 0.01 && Math.abs(v) < 1e4 ? v.toFixed(3) : v.toExponential(1));
  const rows = [["time", f.time.toFixed(2) + " s"], ["speed", f.paused ? "paused" : (f.rate ? (f.rate / f.slower).toFixed(2) + " x" : "...")]];
  if (f.ms) rows.push(["computing", f.ms.toFixed(1) + " ms"], ["shown", fps.toFixed(0) + " /s"]);
  if (f.substeps) rows.push(["substeps", f.substeps + (f.iterations > 1 ? " x " + f.iterations : "")]);
  if (f.residual !== 0 && f.residual !== undefined) rows.push(["residual", short(f.residual)]);
  if (f.overlap !== 0 && f.overlap !== undefined) rows.push(["overlap", short(f.overlap) + " r"]);
  if (f.energy !== undefined) rows.push(["energy", short(f.energy) + " J"]);
  $("list").replaceChildren(...rows.flatMap((row) => row.map((text, k) => {
    const part = document.createElement(k ? "dd" : "dt");
    part.textContent = text;
    return part;
  })));
  $("notes").textContent = (f.notes || []).join("\n");
}

// Mouse and keys.

const KEYS = [
  [" ", "Space", "pause", () => say({ do: "pause" })], [".", ".", "one frame", () => say({ do: "frame" })],
  ["r", "R", "restart", () => say({ do: "restart" })], ["-", "−", "slower", () => say({ do: "slower" })],
  ["+", "+", "faster", () => say({ do: "faster" })], ["f", "F", "fit", fit],
  ["s", "S", "strain", () => { show.strain = !show.strain; }], ["p", "P", "particles", () => { show.particles = !show.particles; }],
];
for (const [key, name, text, act] of KEYS) {
  const button = document.createElement("button"), cap = document.createElement("kbd");
  cap.textContent = name;
  button.append(cap, text);
  button.onclick = () => { act(); dirty = true; button.blur(); };
  $("keys").append(button);
}
for (const text of ["drag: pull", "click: name", "drag beside: move or turn", "wheel or two fingers: nearer"]) {
  const hint = document.createElement("span");
  hint.textContent = text;
  hint.style.cssText = "padding: 2px 6px; color: var(--quiet)";
  $("keys").append(hint);
}
addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === " " && event.target.closest("button")) return; // presses the button
  const found = KEYS.find(([key]) => key === event.key.toLowerCase() || (key === "+" && event.key === "="));
  if (found && event.repeat && found[0] !== ".") return;
  if (found) { event.preventDefault(); found[3](); dirty = true; }
});

const spot = (event) => [event.offsetX * devicePixelRatio, event.offsetY * devicePixelRatio];
const target = (event) => add(under(...spot(event), held.from), held.offset).slice(0, scene.dim);

// Fingers and buttons that are down. One pulls a particle or moves the view; two fingers move and zoom it.
const down = new Map();
const pinch = () => { // returns the middle of two fingers, and their distance
  const [a, b] = [...down.values()];
  return [[(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], Math.hypot(...sub(a, b)) || 1];
};

canvas.onpointerdown = (event) => {
  if (!scene || !x) return;
  canvas.setPointerCapture(event.pointerId);
  drop();
  down.set(event.pointerId, spot(event));
  if (down.size > 1) return;
  const i = event.shiftKey || event.button ? -1 : pick(...spot(event)), from = i < 0 ? eye.center : at(i);
  held = { i, from, offset: [0, 0, 0], at: spot(event), way: 0, shift: event.shiftKey || event.button > 0 };
  if (i >= 0) {
    held.offset = sub(from, under(...spot(event), from));
    canvas.classList.add("held");
    say({ do: "grab", particle: i, target: target(event) });
  }
};
canvas.onpointermove = (event) => {
  if (!down.has(event.pointerId)) return;
  const two = down.size === 2 && pinch(), now = spot(event);
  down.set(event.pointerId, now);
  if (two) {
    const [middle, wide] = pinch();
    zoom(wide / two[1], ...two[0]);
    shift(two[0], middle, eye.center);
  }
  if (!held) return;
  const step = sub(now, held.at);
  held.way += Math.hypot(...step);
  if (held.i >= 0) say({ do: "move", target: target(event) });
  else if (scene.dim === 3 && !held.shift) {
    eye.turn -= step[0] * 0.006 / devicePixelRatio;
    eye.lift = Math.min(1.55, Math.max(-1.55, eye.lift + step[1] * 0.006 / devicePixelRatio));
    eye.chosen = true;
  } else shift(held.at, now, held.from);
  held.at = now;
  dirty = true;
};
canvas.onpointerup = canvas.onpointercancel = (event) => {
  down.delete(event.pointerId);
  if (held && held.i < 0 && held.way < 4) $("named").hidden = true;
  if (held && held.i >= 0 && held.way < 4 * devicePixelRatio) say({ do: "name", particle: held.i });
  drop();
};
canvas.oncontextmenu = (event) => event.preventDefault(); // the right button moves the view

function drop() {
  if (held && held.i >= 0) say({ do: "drop" });
  canvas.classList.remove("held");
  held = null;
}

function shift(from, to, through) { // move the view, so that what was at pixels `from` is at pixels `to`
  aim();
  eye.center = sub(eye.center, sub(under(...to, through), under(...from, through)));
  eye.chosen = dirty = true;
}

function zoom(by, px, py) { // make the scene larger; in 2D the point under these pixels stays there
  const before = under(px, py, eye.center);
  eye.scale *= by; eye.far /= by;
  if (scene.dim === 2) eye.center = add(eye.center, sub(before, under(px, py, eye.center)));
  eye.chosen = dirty = true;
}

canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  if (scene) zoom(Math.exp(-event.deltaY * 0.0015), ...spot(event));
}, { passive: false });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { dirty = true; });
requestAnimationFrame(draw);
