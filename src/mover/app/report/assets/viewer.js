// The 3D view of the report: plain WebGL 2, no library, no network.
// Worlds are drawn with their floor at y = 0; +y is up, the camera of the video is above (0, 0).
"use strict";
(() => {
  const stage = document.getElementById("stage");
  if (!stage) return;
  const canvas = stage.querySelector("canvas");
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
  if (!gl) {
    stage.classList.add("blind");
    return;
  }
  const data = JSON.parse(document.getElementById("view-data").textContent);
  const packed = atob(document.getElementById("view-block").textContent.trim());
  const block = Uint8Array.from(packed, (c) => c.charCodeAt(0));
  const { people, room } = data;
  const rows = new Map((people ? people.rows : []).map(([frame, person], i) => [`${frame}:${person}`, i]));
  const show = { truth: false, people: true, labels: true };
  const state = { world: data.scenes.result ? "result" : "initial", slot: people ? people.opening : 0, mode: "orbit", playing: false };

  // ---------------------------------------------------------------- vectors
  const sub = (a, b) => a.map((v, i) => v - b[i]);
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);

  // ---------------------------------------------------------------- programs
  // Vertices are whole steps from a middle; each face has one normal.
  const PLACE = `#version 300 es
    layout(location=0) in vec3 steps;
    uniform mat4 view; uniform vec3 middle, t, scale; uniform vec2 turn; uniform float size; out vec3 at;
    void main() {
      vec3 p = (middle + size * steps) * scale;
      at = vec3(turn.x*p.x + turn.y*p.z, p.y, turn.x*p.z - turn.y*p.x) + t;
      gl_Position = view * vec4(at, 1.0);
    }`;
  const SURFACE = `#version 300 es
    precision highp float; in vec3 at; out vec4 colour; uniform vec4 tint; uniform vec3 eye;
    void main() {
      vec3 n = normalize(cross(dFdx(at), dFdy(at))), look = normalize(eye - at);
      if (dot(n, look) < 0.0) n = -n;
      float key = max(dot(n, normalize(vec3(0.45, 1.0, 0.35))), 0.0);
      colour = vec4(tint.rgb * (0.5 + 0.2 * (0.5 + 0.5 * n.y) + 0.4 * key), tint.a);
    }`;
  const FLOOR = `#version 300 es
    precision highp float; in vec3 at; out vec4 colour; uniform vec4 tint; uniform vec3 line, centre; uniform float reach;
    void main() {
      vec2 w = fwidth(at.xz), d = abs(fract(at.xz - 0.5) - 0.5) / w;
      float grid = (1.0 - min(min(d.x, d.y), 1.0)) * clamp(0.03 / max(w.x, w.y), 0.0, 1.0);
      float fade = 1.0 - smoothstep(0.55 * reach, reach, distance(at.xz, centre.xz));
      colour = vec4(mix(tint.rgb, line, grid), fade);
    }`;

  function program(fragment) {
    const made = gl.createProgram(), at = {};
    for (const [kind, text] of [[gl.VERTEX_SHADER, PLACE], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    for (let i = 0; i < (gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) || 0); i++) {
      const { name } = gl.getActiveUniform(made, i);
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at };
  }

  function buffer(kind, array) {
    const made = gl.createBuffer();
    gl.bindBuffer(kind, made);
    gl.bufferData(kind, array, gl.STATIC_DRAW);
    return made;
  }

  // All vertices and faces are in one block of bytes, which the GPU gets as it is.
  let gpu;
  function setup() {
    gl.bindVertexArray(gl.createVertexArray());
    gl.enableVertexAttribArray(0);
    gpu = {
      surface: program(SURFACE), floor: program(FLOOR),
      verts: buffer(gl.ARRAY_BUFFER, block), faces: buffer(gl.ELEMENT_ARRAY_BUFFER, block),
      ground: buffer(gl.ARRAY_BUFFER, new Int16Array([-1, 0, -1, 1, 0, -1, -1, 0, 1, 1, 0, 1])),
    };
  }

  // ---------------------------------------------------------------- viewpoints
  // The ball around the room fits between both sides; above and below, rooms fill little of it.
  const LENS = 2.6, orbit = { distance: 8 };
  let held = false; // by the user: a canvas of another shape leaves the view as it is
  function home() {
    const aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight), away = (side) => room.radius * Math.hypot(1, LENS / side);
    Object.assign(orbit, { target: [room.middle[0], Math.min(room.middle[1], 0.7), room.middle[2]], azimuth: 0.42, elevation: 0.42,
      distance: Math.max(0.88 * away(1), away(aspect)) });
    held = false;
  }

  function orbitPose() {
    const { target, azimuth: a, elevation: e, distance: d } = orbit, f = LENS;
    const z = [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
    const x = [Math.cos(a), 0, -Math.sin(a)], y = cross(z, x);
    return { eye: target.map((v, i) => v + d * z[i]), R: [...x, ...y, ...z], lens: [(f * canvas.height) / canvas.width, f, 0, 0] };
  }

  // The camera of the video; its whole image fits into the canvas.
  function cameraPose() {
    const { camera: c, floor } = data.scenes[state.world], [w, h] = c.size, R = c.R;
    const fit = Math.min(canvas.width / w, canvas.height / h), sx = (fit * w) / canvas.width, sy = (fit * h) / canvas.height;
    return { eye: [0, -floor, 0], R: [R[0], R[1], R[2], -R[3], -R[4], -R[5], -R[6], -R[7], -R[8]],
      lens: [(sx * 2 * c.f[0]) / w, (sy * 2 * c.f[1]) / h, sx * ((2 * c.c[0]) / w - 1), sy * (1 - (2 * c.c[1]) / h)] };
  }

  function matrix({ eye, R, lens: [px, py, ox, oy] }) {
    const near = 0.05, far = 200, back = -(far + near) / (far - near), depth = (-2 * far * near) / (far - near);
    const [x, y, z] = [0, 3, 6].map((r) => [R[r], R[r + 1], R[r + 2], -dot(R.slice(r, r + 3), eye)]);
    const out = new Float32Array(16);
    for (let k = 0; k < 4; k++) {
      out.set([px * x[k] - ox * z[k], py * y[k] - oy * z[k], back * z[k] + (k === 3 ? depth : 0), -z[k]], 4 * k);
    }
    return out;
  }

  // ---------------------------------------------------------------- drawing
  const theme = {};
  function readTheme() {
    const style = getComputedStyle(stage);
    for (const name of ["back", "floor", "line", "ink"]) theme[name] = rgb(style.getPropertyValue(`--view-${name}`).trim());
  }

  let pose = null, view = null;
  function use({ made, at }) {
    gl.useProgram(made);
    gl.uniformMatrix4fv(at.view, false, view);
    gl.uniform3fv(at.eye || null, pose.eye);
  }

  function place({ at }, { t, yaw, scale }, middle, size, tint) {
    gl.uniform3fv(at.t, t);
    gl.uniform3fv(at.scale, scale);
    gl.uniform2f(at.turn, Math.cos(yaw), Math.sin(yaw));
    gl.uniform3fv(at.middle, middle);
    gl.uniform1f(at.size, size);
    gl.uniform4fv(at.tint, tint);
  }

  function drawFloor() {
    use(gpu.floor);
    const reach = Math.max(room.radius * 2.2, 6), { at } = gpu.floor;
    gl.uniform3fv(at.centre, room.middle);
    gl.uniform3fv(at.line, theme.line);
    gl.uniform1f(at.reach, reach);
    place(gpu.floor, { t: [room.middle[0], 0, room.middle[2]], yaw: 0, scale: [1, 1, 1] }, [0, 0, 0], reach, [...theme.floor, 1]);
    gl.bindBuffer(gl.ARRAY_BUFFER, gpu.ground);
    gl.vertexAttribPointer(0, 3, gl.SHORT, false, 6, 0);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  function triangles(verts, { faces, n_faces, wide }) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gpu.verts);
    gl.vertexAttribPointer(0, 3, gl.SHORT, false, 6, verts);
    gl.drawElements(gl.TRIANGLES, 3 * n_faces, wide ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT, faces);
  }

  const lifted = ({ floor }, t) => [t[0], t[1] - floor, t[2]];
  function drawFurniture(scene, tintOf) {
    for (const p of scene.pieces) {
      const mesh = data.meshes[p.mesh];
      place(gpu.surface, { ...p, t: lifted(scene, p.t) }, mesh.middle, mesh.step, tintOf(p));
      triangles(mesh.verts, mesh);
    }
  }

  function drawPeople() {
    const name = people.worlds[state.world] ? state.world : Object.keys(people.worlds)[0];
    const world = people.worlds[name], frame = people.frames[moment()];
    for (const [id, tint] of Object.entries(people.colours)) {
      const row = rows.get(`${frame}:${id}`);
      if (row === undefined) continue;
      place(gpu.surface, { t: lifted(data.scenes[name], [0, 0, 0]), yaw: 0, scale: [1, 1, 1] }, world.middle, world.step, [...rgb(tint), 1]);
      triangles(world.verts + row * people.n_verts * 6, people);
    }
  }

  function render() {
    const scene = data.scenes[state.world], { truth } = data.scenes;
    pose = state.mode === "camera" ? cameraPose() : orbitPose();
    view = matrix(pose);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...theme.back, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ZERO, gl.ONE);
    gl.depthMask(false); // the floor hides nothing, and what is transparent neither
    if (pose.eye[1] > 0) drawFloor();
    gl.depthMask(true);
    use(gpu.surface);
    drawFurniture(scene, (p) => [...rgb(p.colour), 1]);
    if (people && show.people) drawPeople();
    gl.depthMask(false);
    if (show.truth && truth) drawFurniture(truth, () => [...theme.ink, 0.35]);
    gl.depthMask(true);
    drawNames(scene);
  }

  // ---------------------------------------------------------------- names over the objects
  const names = stage.querySelector(".names");
  function drawNames(scene) {
    names.replaceChildren();
    if (!show.labels) return;
    for (const p of scene.pieces) {
      const { middle, top } = data.meshes[p.mesh], c = Math.cos(p.yaw), s = Math.sin(p.yaw);
      const [x, y, z] = [middle[0] * p.scale[0], top * p.scale[1] + 0.08, middle[2] * p.scale[2]];
      const at = [c * x + s * z + p.t[0], y + p.t[1] - scene.floor, c * z - s * x + p.t[2], 1];
      const [u, v, w] = [0, 1, 3].map((r) => at.reduce((sum, a, k) => sum + a * view[4 * k + r], 0));
      if (w < 0.1) continue;
      const tag = document.createElement("span");
      tag.textContent = p.id;
      tag.style.setProperty("--tint", p.colour);
      tag.style.transform = `translate(${((u / w + 1) * canvas.clientWidth) / 2}px, ${((1 - v / w) * canvas.clientHeight) / 2}px) translate(-50%, -100%)`;
      names.append(tag);
    }
  }

  // ---------------------------------------------------------------- time
  let queued = false, last = 0;
  const moment = () => Math.min(Math.floor(state.slot + 1e-6), people.frames.length - 1);
  function redraw() { if (!queued) { queued = true; requestAnimationFrame(tick); } }
  function tick(now) {
    queued = false;
    if (state.playing) {
      const gap = (people.frames.at(-1) - people.frames[0]) / Math.max(1, people.frames.length - 1);
      const rate = people.fps ? Math.max(4, people.fps / Math.max(gap, 1)) : 2; // moments a second
      state.slot = moment() >= people.frames.length - 1 ? 0 : state.slot + rate * Math.min(0.1, (now - last) / 1000);
      timeline();
    }
    last = now;
    render();
    if (state.playing) redraw();
  }

  function timeline() {
    const bar = stage.querySelector("[name=time]"), frame = people.frames[moment()];
    bar.value = state.slot;
    stage.querySelector(".moment").textContent = people.fps ? `${(frame / people.fps).toFixed(1)} s` : `image ${frame}`;
    bar.setAttribute("aria-valuetext", `frame ${frame}`);
  }

  function play(on) {
    state.playing = on;
    const button = stage.querySelector(".play");
    button.setAttribute("aria-pressed", on);
    button.setAttribute("aria-label", on ? "Pause" : "Play");
    last = performance.now();
    redraw();
  }

  // ---------------------------------------------------------------- mouse, fingers and keys
  function leaveCamera() {
    if (state.mode === "camera") {
      const { eye, R } = cameraPose(), z = R.slice(6, 9), distance = Math.hypot(...sub(room.middle, eye));
      Object.assign(orbit, { elevation: Math.asin(clamp(z[1], -0.2, 1)), azimuth: Math.atan2(z[0], z[2]), distance,
        target: eye.map((v, i) => v - distance * z[i]) });
    }
    held = true;
    state.mode = "orbit";
    marks();
    redraw();
  }
  function turn(dx, dy) {
    leaveCamera();
    orbit.azimuth -= dx * 0.0065;
    orbit.elevation = clamp(orbit.elevation + dy * 0.0055, -0.1, 1.5607);
  }
  function pan(dx, dy) {
    leaveCamera();
    const { R } = orbitPose(), step = (orbit.distance * 2) / (LENS * canvas.clientHeight);
    orbit.target = orbit.target.map((v, k) => v - step * (dx * R[k] - dy * R[3 + k]));
  }
  function zoom(factor) {
    leaveCamera();
    orbit.distance = clamp(orbit.distance * factor, 0.4, 60);
  }

  const fingers = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    canvas.focus({ preventScroll: true });
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
  });
  canvas.addEventListener("pointermove", (e) => {
    const before = fingers.get(e.pointerId);
    if (!before) return;
    const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(...sub(a, b)); };
    const two = fingers.size === 2, width = two ? spread() : 0;
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    const dx = e.clientX - before[0], dy = e.clientY - before[1];
    if (two) { pan(dx / 2, dy / 2); zoom(width / Math.max(1, spread())); }
    else if (e.buttons & 6 || e.shiftKey) pan(dx, dy);
    else turn(dx, dy);
  });
  for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (e) => fingers.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    if (document.activeElement !== canvas && !e.ctrlKey) return; // the page scrolls until the view was touched
    e.preventDefault();
    zoom(Math.exp(clamp(e.deltaY, -120, 120) * (e.ctrlKey ? 0.01 : 0.0016)));
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const acts = { ArrowLeft: () => turn(-24, 0), ArrowRight: () => turn(24, 0), ArrowUp: () => turn(0, 24), ArrowDown: () => turn(0, -24),
      "+": () => zoom(0.88), "=": () => zoom(0.88), "-": () => zoom(1.14), " ": () => people && play(!state.playing) };
    if (acts[e.key]) { e.preventDefault(); acts[e.key](); }
  });

  function marks() {
    for (const b of stage.querySelectorAll("[data-look]")) b.setAttribute("aria-pressed", b.dataset.look === state.mode);
    for (const b of stage.querySelectorAll("[data-world]")) b.setAttribute("aria-pressed", b.dataset.world === state.world);
  }
  for (const button of stage.querySelectorAll("[data-world]")) button.addEventListener("click", () => {
    state.world = button.dataset.world;
    marks();
    redraw();
  });
  for (const button of stage.querySelectorAll("[data-look]")) button.addEventListener("click", () => {
    state.mode = button.dataset.look;
    if (state.mode !== "camera") home();
    held = state.mode !== "orbit";
    if (state.mode === "above") Object.assign(orbit, { azimuth: 0, elevation: 1.5607, distance: orbit.distance * 1.05 });
    marks();
    redraw();
  });
  for (const box of stage.querySelectorAll("[data-show]")) {
    show[box.dataset.show] = box.checked;
    box.addEventListener("change", () => { show[box.dataset.show] = box.checked; redraw(); });
  }
  if (people) {
    const bar = stage.querySelector("[name=time]");
    stage.querySelector(".play").addEventListener("click", () => play(!state.playing));
    bar.addEventListener("input", () => { play(false); state.slot = Number(bar.value); timeline(); });
    bar.max = people.frames.length - 1;
    stage.querySelector(".time").hidden = people.frames.length < 2;
    timeline();
  }
  canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => { setup(); redraw(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readTheme(); redraw(); });

  setup();
  readTheme();
  home();
  marks();
  new ResizeObserver(() => {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (!held) home();
    render(); // at once: a resized canvas is blank
  }).observe(canvas);
})();
