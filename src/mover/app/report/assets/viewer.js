// The 3D view of the report: plain WebGL 2, no library, no network.
// Worlds are drawn with their floor at y = 0; +y is up, the camera of the video stands above (0, 0).
"use strict";
(() => {
  const stage = document.getElementById("stage");
  if (!stage) return;
  const canvas = stage.querySelector("canvas");
  const gl = canvas.getContext("webgl2", { antialias: true, stencil: true, alpha: false });
  if (!gl) {
    stage.classList.add("blind");
    return;
  }
  const data = JSON.parse(document.getElementById("view-data").textContent);
  const packed = atob(document.getElementById("view-block").textContent.trim());
  const block = Uint8Array.from(packed, (c) => c.charCodeAt(0)).buffer;
  const photo = document.getElementById("photo");
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  const first = data.scenes.result || Object.values(data.scenes)[0];
  const both = Boolean(data.scenes.initial && data.scenes.result);
  const show = { truth: false, people: true, labels: true, photo: true };
  const state = { after: 1, slot: 0, mode: "orbit", playing: false };

  // ---------------------------------------------------------------- vectors
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
  const lerp = (a, b, u) => a + (b - a) * u;
  const blend = (a, b, u) => a.map((v, i) => lerp(v, b[i], u));
  const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
  const ease = (u) => (u < 0.5 ? 4 * u * u * u : 1 - (2 - 2 * u) ** 3 / 2);

  // ---------------------------------------------------------------- meshes
  // Corners get the mean normal of the faces that meet smoothly; sharp edges become lines.
  function readMesh(entry) {
    const whole = new Int16Array(block, entry.verts, entry.n_verts * 3);
    const points = [];
    for (let i = 0; i < entry.n_verts; i++) {
      points.push([0, 1, 2].map((k) => entry.middle[k] + entry.step * whole[3 * i + k]));
    }
    const Index = entry.wide ? Int32Array : Uint16Array;
    const faces = new Index(block, entry.faces, entry.n_faces * 3);
    return { ...corners(points, faces), low: extreme(points, Math.min), high: extreme(points, Math.max) };
  }

  const extreme = (points, choose) => [0, 1, 2].map((k) => points.reduce((m, p) => choose(m, p[k]), points[0][k]));

  function corners(points, faces) {
    const count = faces.length / 3, normals = [], around = points.map(() => []), beside = new Map();
    for (let f = 0; f < count; f++) {
      const [a, b, c] = [0, 1, 2].map((k) => points[faces[3 * f + k]]);
      normals.push(cross(sub(b, a), sub(c, a)));
      for (let k = 0; k < 3; k++) {
        const v = faces[3 * f + k], w = faces[3 * f + ((k + 1) % 3)];
        around[v].push(f);
        const key = v < w ? v * points.length + w : w * points.length + v;
        if (beside.has(key)) beside.get(key).push(f); else beside.set(key, [f]);
      }
    }
    const units = normals.map(unit), solid = [], lines = [];
    const sliver = (f) => { // its normal says nothing
      const [a, b, c] = [0, 1, 2].map((k) => points[faces[3 * f + k]]);
      const longest = Math.max(...[sub(b, a), sub(c, b), sub(a, c)].map((e) => dot(e, e)));
      return Math.hypot(...normals[f]) < 0.03 * longest;
    };
    for (let f = 0; f < count; f++) {
      for (let k = 0; k < 3; k++) {
        const v = faces[3 * f + k], sum = [0, 0, 0];
        for (const g of around[v]) {
          if (dot(units[f], units[g]) > 0.75) for (let i = 0; i < 3; i++) sum[i] += normals[g][i];
        }
        solid.push(...points[v], ...unit(sum));
      }
    }
    for (const [key, fs] of beside) {
      if (fs.length === 2 && Math.abs(dot(units[fs[0]], units[fs[1]])) > 0.8) continue;
      if (fs.length === 2 && fs.some(sliver)) continue;
      lines.push(...points[Math.floor(key / points.length)], ...points[key % points.length]);
    }
    return { solid: new Float32Array(solid), lines: new Float32Array(lines) };
  }

  // ---------------------------------------------------------------- programs
  const PLACE = `#version 300 es
    layout(location=0) in vec3 place; layout(location=1) in vec3 normal;
    uniform mat4 view; uniform vec3 t, scale; uniform vec2 turn; uniform vec3 sun; uniform float flat_;
    out vec3 at, n;
    vec3 turned(vec3 p) { return vec3(turn.x*p.x + turn.y*p.z, p.y, turn.x*p.z - turn.y*p.x); }
    void main() {
      vec3 p = turned(place * scale) + t;
      if (flat_ > 0.5) p = vec3(p.xz - sun.xz / sun.y * max(p.y, 0.0), 0.004).xzy;
      at = p; n = turned(normal / scale); gl_Position = view * vec4(p, 1.0);
    }`;
  const SURFACE = `#version 300 es
    precision highp float; in vec3 at, n; out vec4 colour;
    uniform vec4 tint; uniform vec3 sun, eye; uniform float soft;
    void main() {
      vec3 m = normalize(n), look = normalize(eye - at);
      if (dot(m, look) < 0.0 && soft < 0.5) m = -m;
      float key = max(dot(m, sun), 0.0), sky = 0.5 + 0.5 * m.y, rim = pow(1.0 - abs(dot(m, look)), 3.0);
      float low = smoothstep(-0.1, 0.9, at.y);
      vec3 c = tint.rgb * (0.46 + 0.25 * sky + 0.38 * key) * mix(0.9, 1.0, low) + 0.07 * rim;
      colour = vec4(c, tint.a);
    }`;
  const PLAIN = `#version 300 es
    precision highp float; uniform vec4 tint; out vec4 colour; void main() { colour = tint; }`;
  const FLOOR = `#version 300 es
    precision highp float; in vec3 at, n; out vec4 colour;
    uniform vec4 tint, line; uniform vec3 middle; uniform float reach;
    void main() {
      vec2 p = at.xz, w = fwidth(p), d = abs(fract(p - 0.5) - 0.5) / w;
      float grid = (1.0 - min(min(d.x, d.y), 1.0)) * clamp(0.35 / max(w.x, w.y) / 12.0, 0.0, 1.0);
      float fade = 1.0 - smoothstep(0.55 * reach, reach, distance(p, middle.xz));
      vec4 c = mix(tint, vec4(line.rgb, 1.0), line.a * grid);
      colour = vec4(c.rgb, max(tint.a, line.a * grid) * fade);
    }`;
  const IMAGE_V = `#version 300 es
    layout(location=0) in vec3 place; layout(location=1) in vec3 normal;
    uniform mat4 view; out vec2 uv; void main() { uv = normal.xy; gl_Position = view * vec4(place, 1.0); }`;
  const IMAGE_F = `#version 300 es
    precision highp float; in vec2 uv; uniform sampler2D image; uniform vec4 tint; out vec4 colour;
    void main() { colour = vec4(texture(image, uv).rgb, tint.a); }`;

  function program(vertex, fragment) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    const at = {};
    for (let i = 0; i < (gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS) || 0); i++) {
      const { name } = gl.getActiveUniform(made, i);
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at };
  }

  function shape(array, stride, mode, usage = gl.STATIC_DRAW) {
    const vao = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(vao);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, array, usage);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 4 * stride, 0);
    if (stride === 6) {
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 3, gl.FLOAT, false, 24, 12);
    }
    return { vao, buffer, mode, count: array.length / stride };
  }

  const meshes = data.meshes.map(readMesh);
  const people = readPeople();
  let gpu;
  function setup() {
    gpu = { surface: program(PLACE, SURFACE), plain: program(PLACE, PLAIN), floor: program(PLACE, FLOOR), image: program(IMAGE_V, IMAGE_F) };
    gpu.meshes = meshes.map((m) => ({ solid: shape(m.solid, 6, gl.TRIANGLES), lines: shape(m.lines, 3, gl.LINES) }));
    gpu.ground = shape(new Float32Array([-1, 0, -1, 1, 0, -1, -1, 0, 1, 1, 0, 1]), 3, gl.TRIANGLE_STRIP);
    gpu.cone = shape(new Float32Array(48), 3, gl.LINES, gl.DYNAMIC_DRAW);
    gpu.photo = shape(new Float32Array(24), 6, gl.TRIANGLE_STRIP, gl.DYNAMIC_DRAW);
    gpu.body = people && shape(people.buffer, 6, gl.TRIANGLES, gl.DYNAMIC_DRAW);
    gpu.texture = null;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  function texture() {
    if (gpu.texture || !photo || !photo.complete || !photo.naturalWidth) return gpu.texture;
    gpu.texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, gpu.texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, photo);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return gpu.texture;
  }

  // ---------------------------------------------------------------- people
  function readPeople() {
    const p = data.people;
    if (!p) return null;
    const faces = new Uint16Array(block, p.faces, p.n_faces * 3);
    const row = new Map(p.rows.map(([frame, person], i) => [`${frame}:${person}`, i]));
    const gap = p.frames.length > 1 ? (p.frames[p.frames.length - 1] - p.frames[0]) / (p.frames.length - 1) : 1;
    const seconds = p.fps ? gap / p.fps : 0.6;
    return { ...p, faces, row, ids: Object.keys(p.colours), buffer: new Float32Array(p.n_faces * 18),
      points: new Float32Array(p.n_verts * 3), normals: new Float32Array(p.n_verts * 3),
      rate: 1 / Math.min(seconds, p.fps ? 0.25 : 0.6), smooth: Boolean(p.fps) && seconds <= 0.7 };
  }

  function addPoints(world, row, weight, out) {
    if (weight === 0) return;
    const { middle, step, verts } = people.worlds[world];
    const whole = new Int16Array(block, verts + row * people.n_verts * 6, people.n_verts * 3);
    const { floor } = data.scenes[world];
    const shift = [middle[0], middle[1] - floor, middle[2]];
    for (let i = 0; i < out.length; i++) out[i] += weight * (shift[i % 3] + step * whole[i]);
  }

  // Some vertices of every body, to see how far people go.
  function* strides() {
    const world = people.worlds.result ? "result" : Object.keys(people.worlds)[0];
    const { middle, step, verts } = people.worlds[world], floor = data.scenes[world].floor;
    const whole = new Int16Array(block, verts, people.rows.length * people.n_verts * 3);
    for (let i = 0; i < whole.length; i += 3 * 17) {
      yield [middle[0] + step * whole[i], middle[1] - floor + step * whole[i + 1], middle[2] + step * whole[i + 2]];
    }
  }

  // Fill the buffer with the body of one person; false where nobody is seen at this moment.
  function pose(id) {
    const last = people.frames.length - 1, low = clamp(Math.floor(state.slot), 0, last), high = Math.min(low + 1, last);
    const a = people.row.get(`${people.frames[low]}:${id}`), b = people.row.get(`${people.frames[high]}:${id}`);
    const u = people.smooth && a !== undefined && b !== undefined ? clamp(state.slot - low, 0, 1) : 0;
    if (a === undefined) return false;
    const { points, normals, faces, buffer } = people, worlds = Object.keys(people.worlds);
    const after = worlds.includes("result") ? (worlds.includes("initial") ? state.after : 1) : 0;
    points.fill(0);
    for (const [world, weight] of [["initial", 1 - after], ["result", after]]) {
      if (!people.worlds[world]) continue;
      addPoints(world, a, weight * (1 - u), points);
      if (u > 0) addPoints(world, b, weight * u, points);
    }
    normals.fill(0);
    for (let f = 0; f < faces.length; f += 3) {
      const [i, j, k] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
      const ux = points[j] - points[i], uy = points[j + 1] - points[i + 1], uz = points[j + 2] - points[i + 2];
      const vx = points[k] - points[i], vy = points[k + 1] - points[i + 1], vz = points[k + 2] - points[i + 2];
      const nx = uy * vz - uz * vy, ny = uz * vx - ux * vz, nz = ux * vy - uy * vx;
      for (const o of [i, j, k]) { normals[o] += nx; normals[o + 1] += ny; normals[o + 2] += nz; }
    }
    for (let c = 0; c < faces.length; c++) {
      const o = 3 * faces[c];
      for (let k = 0; k < 3; k++) { buffer[6 * c + k] = points[o + k]; buffer[6 * c + 3 + k] = normals[o + k]; }
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, gpu.body.buffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, buffer);
    return true;
  }

  // ---------------------------------------------------------------- where things stand
  const lifted = (scene, p) => [p.t[0], p.t[1] - scene.floor, p.t[2]];

  // Objects between "before" and "after", matched by id.
  function placements() {
    if (!both) return first.pieces.map((p) => ({ ...p, t: lifted(first, p), alpha: 1 }));
    const { initial, result } = data.scenes, u = state.after;
    const old = new Map(initial.pieces.map((p) => [p.id, p]));
    const out = [];
    for (const p of result.pieces) {
      const q = old.get(p.id);
      old.delete(p.id);
      if (!q) { out.push({ ...p, t: lifted(result, p), alpha: u }); continue; }
      const turn = Math.atan2(Math.sin(p.yaw - q.yaw), Math.cos(p.yaw - q.yaw));
      out.push({ ...p, mesh: u < 0.5 ? q.mesh : p.mesh, t: blend(lifted(initial, q), lifted(result, p), u),
        yaw: q.yaw + u * turn, scale: p.scale.map((s, i) => q.scale[i] ** (1 - u) * s ** u), alpha: 1 });
    }
    for (const q of old.values()) out.push({ ...q, t: lifted(initial, q), alpha: 1 - u });
    return out.filter((p) => p.alpha > 0.01);
  }

  function orthonormal(R) {
    const z = unit(R.slice(6, 9)), x = unit(cross(R.slice(3, 6), z)), y = cross(z, x);
    return [...x, ...y, ...z];
  }

  function videoCamera() {
    const a = both ? data.scenes.initial : first, b = both ? data.scenes.result : first, u = state.after;
    return { ...b.camera, R: orthonormal(blend(a.camera.R, b.camera.R, u)), height: -lerp(a.floor, b.floor, u) };
  }

  // ---------------------------------------------------------------- looking
  const orbit = { target: [0, 0.6, -3], azimuth: 0.5, elevation: 0.45, distance: 8 };
  const room = { middle: [0, 0.6, -3], radius: 4 };

  function measure() {
    const low = [Infinity, 0, Infinity], high = [-Infinity, 0.8, -Infinity];
    for (const p of first.pieces) {
      const m = meshes[p.mesh], c = Math.cos(p.yaw), s = Math.sin(p.yaw);
      for (let i = 0; i < 8; i++) {
        const [x, y, z] = [0, 1, 2].map((k) => (i >> k & 1 ? m.high[k] : m.low[k]) * p.scale[k]);
        const at = [c * x + s * z + p.t[0], y + p.t[1] - first.floor, c * z - s * x + p.t[2]];
        for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], at[k]); high[k] = Math.max(high[k], at[k]); }
      }
    }
    for (const [x, y, z] of people ? strides() : []) {
      [x, y, z].forEach((v, k) => { low[k] = Math.min(low[k], v); high[k] = Math.max(high[k], v); });
    }
    if (!Number.isFinite(low[0])) return;
    room.middle = [0, 1, 2].map((k) => (low[k] + high[k]) / 2);
    room.radius = Math.max(1, 0.5 * Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]));
  }

  function home() {
    const aspect = canvas.clientWidth / Math.max(1, canvas.clientHeight);
    Object.assign(orbit, { target: [room.middle[0], Math.min(room.middle[1], 0.7), room.middle[2]], azimuth: 0.42, elevation: 0.42,
      distance: (room.radius * 2.45) / Math.min(1, 0.3 + 0.62 * aspect) });
  }

  function orbitPose() {
    const { target, azimuth: a, elevation: e, distance: d } = orbit;
    const z = [Math.sin(a) * Math.cos(e), Math.sin(e), Math.cos(a) * Math.cos(e)];
    const x = [Math.cos(a), 0, -Math.sin(a)], y = cross(z, x);
    const aspect = canvas.width / canvas.height, f = 2.6;
    return { eye: target.map((v, i) => v + d * z[i]), R: [...x, ...y, ...z], lens: [f / aspect, f, 0, 0] };
  }

  function cameraPose() {
    const c = videoCamera(), [w, h] = c.size, R = c.R;
    const fit = Math.min(canvas.width / w, canvas.height / h), sx = (fit * w) / canvas.width, sy = (fit * h) / canvas.height;
    return { eye: [0, c.height, 0], R: [R[0], R[1], R[2], -R[3], -R[4], -R[5], -R[6], -R[7], -R[8]],
      lens: [(sx * 2 * c.f[0]) / w, (sy * 2 * c.f[1]) / h, sx * ((2 * c.c[0]) / w - 1), sy * (1 - (2 * c.c[1]) / h)] };
  }

  let glide = null; // {from, start}: the view moves smoothly from another one
  function currentPose(now) {
    const goal = state.mode === "camera" ? cameraPose() : orbitPose();
    if (!glide) return goal;
    const u = clamp((now - glide.start) / 650, 0, 1), e = ease(u);
    if (u >= 1) glide = null;
    return mixedPose(glide ? glide.from : goal, goal, e);
  }
  const mixedPose = (a, b, u) => ({ eye: blend(a.eye, b.eye, u), R: orthonormal(blend(a.R, b.R, u)), lens: blend(a.lens, b.lens, u) });

  let shown = null;
  function go(change) {
    if (shown && !calm.matches) glide = { from: shown, start: performance.now() };
    change();
    redraw();
  }

  function matrix({ eye, R, lens: [px, py, ox, oy] }) {
    const near = 0.05, far = 200, back = -(far + near) / (far - near), depth = (-2 * far * near) / (far - near);
    const V = (r) => [R[3 * r], R[3 * r + 1], R[3 * r + 2], -dot(R.slice(3 * r, 3 * r + 3), eye)];
    const [x, y, z] = [V(0), V(1), V(2)], out = new Float32Array(16);
    for (let k = 0; k < 4; k++) {
      out[4 * k] = px * x[k] - ox * z[k];
      out[4 * k + 1] = py * y[k] - oy * z[k];
      out[4 * k + 2] = back * z[k] + (k === 3 ? depth : 0);
      out[4 * k + 3] = -z[k];
    }
    return out;
  }

  // ---------------------------------------------------------------- drawing
  const SUN = unit([0.45, 1, 0.35]), NOWHERE = { t: [0, 0, 0], yaw: 0, scale: [1, 1, 1] };
  let theme = {};
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
  function readTheme() {
    const style = getComputedStyle(stage);
    for (const name of ["back", "floor", "line", "ink"]) theme[name] = rgb(style.getPropertyValue(`--view-${name}`).trim());
  }

  let current = null, view = null;
  function use(p) {
    current = p;
    gl.useProgram(p.made);
    gl.uniformMatrix4fv(p.at.view, false, view);
    if (p.at.sun) gl.uniform3fv(p.at.sun, SUN);
    if (p.at.eye) gl.uniform3fv(p.at.eye, shown.eye);
    if (p.at.flat_) gl.uniform1f(p.at.flat_, 0);
    if (p.at.soft) gl.uniform1f(p.at.soft, 0);
  }
  function draw(thing, place, tint) {
    const { at } = current;
    if (at.t) {
      gl.uniform3fv(at.t, place.t);
      gl.uniform3fv(at.scale, place.scale);
      gl.uniform2f(at.turn, Math.cos(place.yaw), Math.sin(place.yaw));
    }
    if (at.tint) gl.uniform4fv(at.tint, tint);
    gl.bindVertexArray(thing.vao);
    gl.drawArrays(thing.mode, 0, thing.count);
  }

  function drawFloor(through) {
    use(gpu.floor);
    const reach = Math.max(room.radius * 2.2, 6), { middle } = room;
    gl.uniform3fv(gpu.floor.at.middle, middle);
    gl.uniform1f(gpu.floor.at.reach, reach);
    gl.uniform4fv(gpu.floor.at.line, [...theme.line, through ? 0.5 : 1]);
    gl.depthMask(false);
    draw(gpu.ground, { t: [middle[0], 0, middle[2]], yaw: 0, scale: [reach, 1, reach] }, [...theme.floor, through ? 0 : 1]);
    gl.depthMask(true);
  }

  function drawShadows(pieces, seen, through) {
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    gl.depthMask(false);
    use(gpu.plain);
    gl.uniform1f(gpu.plain.at.flat_, 1);
    const tint = [0, 0, 0, through ? 0.22 : theme.floor[0] < 0.5 ? 0.4 : 0.13];
    for (const p of pieces) draw(gpu.meshes[p.mesh].solid, p, tint);
    for (const id of seen) if (pose(id)) draw(gpu.body, NOWHERE, tint);
    gl.depthMask(true);
    gl.disable(gl.STENCIL_TEST);
  }

  // With alpha < 1 only the front-most surfaces show: depth first, then colour.
  function drawPieces(pieces, alpha) {
    use(gpu.surface);
    const pass = () => { for (const p of pieces) draw(gpu.meshes[p.mesh].solid, p, [...rgb(p.colour), alpha * p.alpha]); };
    if (alpha < 1) { gl.colorMask(false, false, false, false); pass(); gl.colorMask(true, true, true, true); }
    pass();
    use(gpu.plain);
    for (const p of pieces) draw(gpu.meshes[p.mesh].lines, p, [...rgb(p.colour).map((c) => 0.42 * c), 0.75 * p.alpha]);
  }

  function drawTruth() {
    const { truth } = data.scenes, pieces = truth.pieces.map((p) => ({ ...p, t: lifted(truth, p) }));
    gl.depthMask(false);
    use(gpu.surface);
    for (const p of pieces) draw(gpu.meshes[p.mesh].solid, p, [...theme.ink, 0.05]);
    gl.depthMask(true);
    use(gpu.plain);
    for (const p of pieces) draw(gpu.meshes[p.mesh].lines, p, [...theme.ink, 0.8]);
  }

  function drawPeople(seen, alpha) {
    use(gpu.surface);
    gl.uniform1f(gpu.surface.at.soft, 1);
    for (const id of seen) if (pose(id)) draw(gpu.body, NOWHERE, [...rgb(people.colours[id]), alpha]);
  }

  // Corners of the image at depth `d` of the video's camera.
  function imageCorners(d) {
    const c = videoCamera(), [w, h] = c.size;
    return [[0, 0], [w, 0], [0, h], [w, h]].map(([u, v]) => {
      const ray = [(d * (u - c.c[0])) / c.f[0], (d * (v - c.c[1])) / c.f[1], d];
      return [0, 1, 2].map((k) => c.R[k] * ray[0] + c.R[3 + k] * ray[1] + c.R[6 + k] * ray[2] + (k === 1 ? c.height : 0));
    });
  }

  function drawPhoto(depth, alpha) {
    if (!texture()) return;
    const uv = [[0, 0], [1, 0], [0, 1], [1, 1]];
    gl.bindBuffer(gl.ARRAY_BUFFER, gpu.photo.buffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, new Float32Array(imageCorners(depth).flatMap((p, i) => [...p, ...uv[i], 0])));
    use(gpu.image);
    gl.bindTexture(gl.TEXTURE_2D, gpu.texture);
    draw(gpu.photo, NOWHERE, [1, 1, 1, alpha]);
  }

  function drawCone(depth) {
    const [a, b, c, d] = imageCorners(depth), o = [0, videoCamera().height, 0];
    const lines = [o, a, o, b, o, c, o, d, a, b, b, d, d, c, c, a];
    gl.bindBuffer(gl.ARRAY_BUFFER, gpu.cone.buffer);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, new Float32Array(lines.flat()));
    use(gpu.plain);
    draw(gpu.cone, NOWHERE, [...theme.ink, 0.55]);
  }

  function render(now) {
    const pieces = placements(), seen = people && show.people ? people.ids : [];
    shown = currentPose(now);
    const through = state.mode === "camera" && !glide && show.photo && Boolean(texture());
    view = matrix(shown);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...theme.back, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ZERO, gl.ONE);
    if (through) { gl.disable(gl.DEPTH_TEST); drawPhoto(1, 1); gl.enable(gl.DEPTH_TEST); }
    if (shown.eye[1] > 0) { drawFloor(through); drawShadows(pieces, seen, through); }
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1, 1);
    drawPieces(pieces, through ? 0.72 : 1);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    drawPeople(seen, 1);
    if (show.truth && data.scenes.truth) drawTruth();
    if (state.mode !== "camera") { drawCone(0.6); if (show.photo) drawPhoto(0.6, 0.9); }
    nameThings(pieces);
  }

  // ---------------------------------------------------------------- names over the objects
  const names = new Map();
  function nameThings(pieces) {
    const tags = show.labels ? pieces.map(tagOf).filter((t) => t.w > 0.1).sort((a, b) => a.w - b.w) : [];
    for (const { tag } of names.values()) tag.hidden = true;
    const taken = [];
    for (const { tag, x, y, wide } of tags) { // nearest first; a name that would cover a nearer one is left out
      const box = [x - wide / 2, y - 20, x + wide / 2, y];
      const covered = taken.some((t) => Math.min(box[2], t[2]) - Math.max(box[0], t[0]) > 6 && Math.min(box[3], t[3]) - Math.max(box[1], t[1]) > 4);
      if (covered || x < 0 || y < 0 || x > canvas.clientWidth || y > canvas.clientHeight) continue;
      taken.push(box);
      tag.hidden = false;
      tag.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, -100%)`;
    }
  }

  // The name of an object and where the middle of its top is seen [px].
  function tagOf(p) {
    const m = meshes[p.mesh], c = Math.cos(p.yaw), s = Math.sin(p.yaw);
    const x = ((m.low[0] + m.high[0]) / 2) * p.scale[0], z = ((m.low[2] + m.high[2]) / 2) * p.scale[2];
    const at = [c * x + s * z + p.t[0], m.high[1] * p.scale[1] + p.t[1] + 0.08, c * z - s * x + p.t[2], 1];
    const [u, v, w] = [0, 1, 3].map((r) => at.reduce((sum, a, k) => sum + a * view[4 * k + r], 0));
    if (!names.has(p.id)) {
      const made = document.createElement("span");
      made.textContent = p.id;
      made.style.setProperty("--tint", p.colour);
      stage.querySelector(".names").append(made);
      names.set(p.id, { tag: made, wide: made.offsetWidth });
    }
    const { tag, wide } = names.get(p.id);
    return { tag, wide, w, x: ((u / w + 1) * canvas.clientWidth) / 2, y: ((1 - v / w) * canvas.clientHeight) / 2 };
  }

  // ---------------------------------------------------------------- time
  let queued = false, last = 0, change = null; // change: {from, to, start} of `after`
  function redraw() { if (!queued) { queued = true; requestAnimationFrame(tick); } }
  function tick(now) {
    queued = false;
    const passed = Math.min(0.1, (now - last) / 1000);
    last = now;
    if (change) {
      const u = clamp((now - change.start) / 900, 0, 1);
      state.after = lerp(change.from, change.to, ease(u));
      if (u >= 1) change = null;
    }
    if (state.playing) {
      const end = people.frames.length - 1;
      state.slot = state.slot >= end ? 0 : Math.min(end, state.slot + passed * people.rate);
      timeline();
    }
    render(now);
    if (state.playing || glide || change) redraw();
  }

  function timeline() {
    const bar = stage.querySelector("[name=time]"), slot = Math.min(Math.floor(state.slot + 1e-6), people.frames.length - 1);
    bar.value = state.slot;
    const frame = people.frames[slot];
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

  // ---------------------------------------------------------------- hands on
  function leaveCamera() {
    if (state.mode !== "camera") return;
    const { eye, R } = cameraPose(), z = R.slice(6, 9);
    go(() => {
      state.mode = "orbit";
      orbit.elevation = Math.asin(clamp(z[1], -0.2, 1));
      orbit.azimuth = Math.atan2(z[0], z[2]);
      orbit.distance = Math.hypot(...sub(room.middle, eye));
      orbit.target = eye.map((v, i) => v - orbit.distance * z[i]);
      marks();
    });
  }
  function turn(dx, dy) {
    leaveCamera();
    if (state.mode === "above") { state.mode = "orbit"; marks(); }
    orbit.azimuth -= dx * 0.0065;
    orbit.elevation = clamp(orbit.elevation + dy * 0.0055, -0.1, 1.5607);
    redraw();
  }
  function pan(dx, dy) {
    leaveCamera();
    const { R } = orbitPose(), step = (orbit.distance * 2) / (2.6 * canvas.clientHeight);
    orbit.target = orbit.target.map((v, k) => v - step * (dx * R[k] - dy * R[3 + k]));
    redraw();
  }
  function zoom(factor) {
    leaveCamera();
    orbit.distance = clamp(orbit.distance * factor, 0.4, 60);
    redraw();
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
    const spread = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
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
    for (const b of stage.querySelectorAll("[data-world]")) b.setAttribute("aria-pressed", (b.dataset.world === "result") === (change ? change.to : state.after) > 0.5);
  }
  for (const button of stage.querySelectorAll("[data-world]")) button.addEventListener("click", () => {
    const to = button.dataset.world === "result" ? 1 : 0;
    if (calm.matches) state.after = to; else change = { from: state.after, to, start: performance.now() };
    marks();
    redraw();
  });
  for (const button of stage.querySelectorAll("[data-look]")) button.addEventListener("click", () => go(() => {
    state.mode = button.dataset.look;
    if (state.mode !== "camera") home();
    if (state.mode === "above") Object.assign(orbit, { azimuth: 0, elevation: 1.5607, distance: orbit.distance * 1.05 });
    marks();
  }));
  for (const box of stage.querySelectorAll("[data-show]")) {
    show[box.dataset.show] = box.checked;
    box.addEventListener("change", () => { show[box.dataset.show] = box.checked; redraw(); });
  }
  if (people) {
    stage.querySelector(".play").addEventListener("click", () => play(!state.playing));
    stage.querySelector("[name=time]").addEventListener("input", (e) => { play(false); state.slot = Number(e.target.value); timeline(); redraw(); });
    stage.querySelector("[name=time]").max = people.frames.length - 1;
    state.slot = people.opening;
    stage.querySelector(".time").hidden = people.frames.length < 2;
  }

  canvas.addEventListener("webglcontextlost", (e) => e.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => { setup(); redraw(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readTheme(); redraw(); });
  if (photo && !photo.complete) photo.addEventListener("load", redraw);

  setup();
  measure();
  readTheme();
  home();
  if (people) timeline();
  marks();
  new ResizeObserver(() => {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    render(performance.now()); // at once: a resized canvas is blank
  }).observe(canvas);
})();
