// Animated surfaces, lines and points in 3D with plain WebGL 2.
// Dragging rotates a view, which always fits into its canvas. Panels are side by side, on a phone
// one below the other.
"use strict";
const modetune = {};
(() => {
  const VIEWS = {   // azimuth and elevation of the eye, in degrees; z is up
    front: [-90, 0], side: [0, 0], top: [-90, 90], isometric: [-55, 28],
  };
  const HEAD = `#version 300 es
    precision highp float;
    uniform mat3 turn; uniform vec3 middle, scale; uniform vec2 pixels; uniform float factor, size;`;
  const SURFACE = [`${HEAD}
    in vec3 a, ma; out vec3 eye; out float share;
    void main() {
      eye = (turn * (a + factor * ma) - middle) * scale;
      share = min(length(ma), 1.0);
      gl_Position = vec4(eye.xy, -eye.z, 1.0);
      eye.xy *= pixels; eye.z *= pixels.y;
    }`, `${HEAD}
    uniform vec4 low, high; in vec3 eye; in float share; out vec4 ink;
    void main() {
      vec3 normal = normalize(cross(dFdx(eye), dFdy(eye)));
      float light = 0.66 + 0.26 * abs(normal.z) + 0.08 * normal.y;
      vec4 paint = mix(low, high, share);
      ink = vec4(paint.rgb * light * paint.a, paint.a);
    }`];
  const LINES = [`${HEAD}
    in vec3 a, ma, b, mb; in vec2 corner; uniform vec4 low, high; out vec4 paint;
    void main() {
      vec3 from = (turn * (a + factor * ma) - middle) * scale;
      vec3 to = (turn * (b + factor * mb) - middle) * scale;
      vec2 along = (to.xy - from.xy) * pixels;
      vec2 across = length(along) > 0.0 ? normalize(vec2(-along.y, along.x)) : vec2(0.0);
      vec3 at = mix(from, to, corner.x);
      paint = mix(low, high, min(mix(length(ma), length(mb), corner.x), 1.0));
      gl_Position = vec4(at.xy + corner.y * size * across / pixels, -at.z - 2e-3, 1.0);
    }`, `${HEAD}
    in vec4 paint; out vec4 ink;
    void main() { ink = vec4(paint.rgb * paint.a, paint.a); }`];
  const POINTS = [`${HEAD}
    in vec3 a, ma, tint; out vec3 paint;
    void main() {
      vec3 at = (turn * (a + factor * ma) - middle) * scale;
      paint = tint;
      gl_Position = vec4(at.xy, -at.z - 4e-3, 1.0);
      gl_PointSize = size;
    }`, `${HEAD}
    uniform vec4 low; in vec3 paint; out vec4 ink;
    void main() {
      float r = length(gl_PointCoord - 0.5);
      if (r > 0.5) discard;
      float alpha = low.a * (1.0 - smoothstep(0.42, 0.5, r));
      ink = vec4(paint * alpha, alpha);
    }`];

  modetune.colour = (name) =>
    getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  // "#rrggbb" as three numbers from 0 to 1.
  modetune.rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255);
  const narrow = window.matchMedia("(max-width: 600px)");   // as in page.css
  modetune.unpack = (text, Kind) =>
    new Kind(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);

  function program(gl, [vertex, fragment]) {
    const made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    const at = {};
    for (let i = 0; i < gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(made, i);
      at[name] = gl.getUniformLocation(made, name);
    }
    return { made, at, slot: (name) => gl.getAttribLocation(made, name) };
  }

  // A view in a canvas. `surface`, `lines` and `points` create layers; each has `visible`, `panels`
  // (the panels that show it) and `move(motion)`. Null without WebGL 2.
  modetune.space = (canvas) => {
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!gl) return null;
    const programs = [SURFACE, LINES, POINTS].map((source) => program(gl, source));
    const layers = [];
    const space = {
      canvas, layers, factor: 0, reach: 0, panels: 1, azimuth: 0, elevation: 0, zoom: 1, pan: [0, 0],
      paper: [1, 1, 1], onTurn: () => {}, width: 0, height: 0, grain: 1,
    };

    const buffer = (values) => {
      const made = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, made);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      return made;
    };
    const refill = (made, values) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, made);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
    };
    // Attributes as [name, buffer, numbers each, bytes from one to the next, first byte, each instance].
    function array(which, attributes) {
      const made = gl.createVertexArray();
      gl.bindVertexArray(made);
      for (const [name, source, count, stride, offset, divisor] of attributes) {
        const slot = programs[which].slot(name);
        if (slot < 0) continue;
        gl.bindBuffer(gl.ARRAY_BUFFER, source);
        gl.enableVertexAttribArray(slot);
        gl.vertexAttribPointer(slot, count, gl.FLOAT, false, stride, offset);
        gl.vertexAttribDivisor(slot, divisor);
      }
      return made;
    }
    function layer(which, places, options, fill) {
      const made = {
        which, places, motion: new Float32Array(places.length), visible: true, panels: null,
        low: [0.5, 0.5, 0.5], high: null, alpha: 1, size: 1, ...options,
        move(motion) { made.motion = motion; fill(motion); },
      };
      layers.push(made);
      return made;
    }
    space.surface = (places, triangles, options) => {
      const moving = buffer(new Float32Array(places.length));
      const rest = buffer(places);
      const made = layer(0, places, options, (motion) => refill(moving, motion));
      made.array = array(0, [["a", rest, 3, 0, 0, 0], ["ma", moving, 3, 0, 0, 0]]);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, triangles, gl.STATIC_DRAW);
      gl.bindVertexArray(null);
      made.count = triangles.length;
      return made;
    };
    space.lines = (places, ends, options) => {
      const pick = (values) => {   // both ends of each line
        const out = new Float32Array(3 * ends.length);
        for (let i = 0; i < ends.length; i++) {
          for (let k = 0; k < 3; k++) out[3 * i + k] = values[3 * ends[i] + k];
        }
        return out;
      };
      const rest = buffer(pick(places)), moving = buffer(new Float32Array(3 * ends.length));
      const corners = buffer(new Float32Array([0, -1, 0, 1, 1, -1, 1, 1]));
      const made = layer(1, places, { size: 1, ...options }, (motion) => refill(moving, pick(motion)));
      made.array = array(1, [
        ["a", rest, 3, 24, 0, 1], ["b", rest, 3, 24, 12, 1], ["ma", moving, 3, 24, 0, 1],
        ["mb", moving, 3, 24, 12, 1], ["corner", corners, 2, 0, 0, 0],
      ]);
      made.count = ends.length / 2;
      return made;
    };
    // tints: one colour, or three numbers per point.
    space.points = (places, options) => {
      const moving = buffer(new Float32Array(places.length)), tint = gl.createBuffer();
      const rest = buffer(places);
      const made = layer(2, places, { size: 8, ...options }, (motion) => refill(moving, motion));
      made.paint = (tints) => refill(tint, tints.length === places.length ? tints :
        Float32Array.from({ length: places.length }, (_, i) => tints[i % 3]));
      made.paint(Float32Array.from(made.low));
      made.array = array(2, [
        ["a", rest, 3, 0, 0, 0], ["ma", moving, 3, 0, 0, 0], ["tint", tint, 3, 0, 0, 0],
      ]);
      made.count = places.length / 3;
      return made;
    };

    // Rows: right, up, and towards the eye.
    function axes() {
      const [a, e] = [space.azimuth, space.elevation].map((degrees) => degrees * Math.PI / 180);
      const [ca, sa, ce, se] = [Math.cos(a), Math.sin(a), Math.cos(e), Math.sin(e)];
      return [[-sa, ca, 0], [-se * ca, -se * sa, ce], [ce * ca, ce * sa, se]];
    }
    const dot = (row, values, at) =>
      row[0] * values[at] + row[1] * values[at + 1] + row[2] * values[at + 2];

    // The bounding box of all layers and motions, along the axes of the view.
    function box(turned) {
      const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
      for (const { places, motion } of layers) {
        for (let at = 0; at < places.length; at += 3) {
          for (let k = 0; k < 3; k++) {
            const rest = dot(turned[k], places, at);
            const swing = space.reach * Math.abs(dot(turned[k], motion, at));
            if (rest - swing < low[k]) low[k] = rest - swing;
            if (rest + swing > high[k]) high[k] = rest + swing;
          }
        }
      }
      return [low, high];
    }
    const across = () => (narrow.matches ? 1 : space.panels), down = () => space.panels / across();
    function camera() {
      const turned = axes(), [low, high] = box(turned);
      const size = low.map((value, k) => Math.max(high[k] - value, 1e-30));
      const width = space.width / across(), height = space.height / down();
      const least = 1e-6 * Math.max(...size);
      const each = 0.9 * space.zoom *   // pixels per unit of length
        Math.min(width / Math.max(size[0], least), height / Math.max(size[1], least));
      return {
        turned, width, height,
        middle: low.map((value, k) => (value + high[k]) / 2 - (k < 2 ? space.pan[k] / each : 0)),
        scale: [2 * each / width, 2 * each / height, 0.9 / Math.max(...size)],
      };
    }

    function paint(item, camera, alpha) {
      const { made, at } = programs[item.which];
      gl.useProgram(made);
      gl.uniformMatrix3fv(at.turn, true, camera.turned.flat());
      gl.uniform3fv(at.middle, camera.middle);
      gl.uniform3fv(at.scale, camera.scale);
      if (at.pixels) gl.uniform2f(at.pixels, camera.width * space.grain / 2, camera.height * space.grain / 2);
      gl.uniform1f(at.factor, item.still ? 0 : space.factor);
      if (at.size) gl.uniform1f(at.size, (item.which === 1 ? 0.5 : 1) * item.size * space.grain);
      if (at.low) gl.uniform4f(at.low, ...item.low, alpha);
      if (at.high) gl.uniform4f(at.high, ...(item.high || item.low), alpha);
      gl.bindVertexArray(item.array);
      if (item.which === 0) gl.drawElements(gl.TRIANGLES, item.count, gl.UNSIGNED_INT, 0);
      else if (item.which === 1) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, item.count);
      else gl.drawArrays(gl.POINTS, 0, item.count);
      gl.bindVertexArray(null);
    }

    // Opaque surfaces, lines, points; then transparent surfaces; then, faintly, hidden parts of
    // layers with `through`.
    space.draw = () => {
      if (!space.width || gl.isContextLost()) return;
      gl.enable(gl.SCISSOR_TEST);
      gl.enable(gl.BLEND);
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(1, 1);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      const seen = camera(), wide = canvas.width / across(), tall = canvas.height / down();
      for (let panel = 0; panel < space.panels; panel++) {
        const corner = [panel % across() * wide, canvas.height - (Math.floor(panel / across()) + 1) * tall];
        gl.viewport(...corner, wide, tall);
        gl.scissor(...corner, wide, tall);
        gl.clearColor(...space.paper, 1);
        gl.depthMask(true);
        gl.enable(gl.DEPTH_TEST);
        gl.depthFunc(gl.LEQUAL);
        gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
        const shown = layers.filter((item) =>
          item.visible && item.count && (!item.panels || space.panels === 1 || item.panels.includes(panel)));
        shown.filter((item) => item.alpha === 1).forEach((item) => paint(item, seen, 1));
        gl.depthMask(false);
        shown.filter((item) => item.alpha < 1).forEach((item) => paint(item, seen, item.alpha));
        gl.depthFunc(gl.GREATER);
        shown.filter((item) => item.through).forEach((item) => paint(item, seen, 0.3));
      }
    };
    let asked = false;
    space.ask = () => {   // at most one drawing per frame
      if (asked) return;
      asked = true;
      requestAnimationFrame(() => { asked = false; space.draw(); });
    };

    space.resize = (width, height, grain = window.devicePixelRatio || 1) => {
      Object.assign(space, { width, height, grain });
      canvas.width = Math.max(1, Math.round(width * grain));
      canvas.height = Math.max(1, Math.round(height * grain));
      space.draw();
    };
    space.view = (name) => {
      [space.azimuth, space.elevation] = VIEWS[name];
      Object.assign(space, { zoom: 1, pan: [0, 0], name });
      space.onTurn();
      space.ask();
    };
    // Position of a layer's point on the canvas, in its panel.
    space.where = (item, row, panel = 0, seen = camera()) => {
      const [x, y, towards] = [0, 1, 2].map((k) => {
        const value = dot(seen.turned[k], item.places, 3 * row) +
          (item.still ? 0 : space.factor) * dot(seen.turned[k], item.motion, 3 * row);
        return (value - seen.middle[k]) * seen.scale[k];
      });
      return [seen.width * (panel % across() + (1 + x) / 2), seen.height * (Math.floor(panel / across()) + (1 - y) / 2), towards];
    };
    space.panel = (x, y) => Math.min(space.panels - 1,
      Math.floor(x / space.width * across()) + across() * Math.floor(y / space.height * down()));
    // The row of the layer's point under the pointer, or -1; the nearest point wins.
    space.under = (item, x, y, near = 10) => {
      const panel = space.panel(x, y), seen = camera(), found = [];
      for (let row = 0; row < item.places.length / 3; row++) {
        const [px, py, towards] = space.where(item, row, panel, seen);
        const far = Math.hypot(px - x, py - y);
        if (far < near) found.push({ row, far, towards });
      }
      const front = Math.max(...found.map((one) => one.towards)) - 0.04;
      return found.filter((one) => one.towards >= front).sort((a, b) => a.far - b.far)[0]?.row ?? -1;
    };
    // The drawing as pixels of `width` columns, rows from the top.
    space.pixels = (width) => {
      const kept = [space.width, space.height, space.grain];
      space.resize(kept[0], kept[1], width / kept[0]);
      const [w, h] = [canvas.width, canvas.height];
      const raw = new Uint8Array(4 * w * h), out = new Uint8Array(4 * w * h);
      gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, raw);
      for (let y = 0; y < h; y++) out.set(raw.subarray(4 * w * (h - 1 - y), 4 * w * (h - y)), 4 * w * y);
      space.resize(...kept);
      return { width: w, height: h, data: out };
    };
    // The drawing as a second canvas next to it, for print: WebGL's own is empty there.
    space.still = () => {
      if (!space.width) space.resize(canvas.clientWidth, canvas.clientHeight, 2);
      space.draw();
      const kept = canvas.parentElement.querySelector(".still") || Object.assign(document.createElement("canvas"), { className: "still" });
      Object.assign(kept, { width: canvas.width, height: canvas.height });
      kept.getContext("2d").drawImage(canvas, 0, 0);
      canvas.after(kept);
    };
    space.png = () => new Promise((done) => { space.draw(); canvas.toBlob(done, "image/png"); });

    // Dragging rotates, with shift or two fingers it moves; wheel and pinch zoom when in focus.
    const fingers = new Map();
    canvas.tabIndex = 0;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    }
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const others = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const now = [event.clientX, event.clientY];
      const moved = [now[0] - before[0], now[1] - before[1]];
      if (others.length) {
        const apart = (one) => Math.hypot(one[0] - others[0][0], one[1] - others[0][1]) || 1;
        space.zoom *= apart(now) / apart(before);
        space.pan = [space.pan[0] + moved[0] / 2, space.pan[1] - moved[1] / 2];
      } else if (event.shiftKey || event.buttons === 2) {
        space.pan = [space.pan[0] + moved[0], space.pan[1] - moved[1]];
      } else {
        turn(moved[0] * 0.5, moved[1] * 0.5);
      }
      fingers.set(event.pointerId, now);
      space.ask();
    });
    function turn(across, down) {
      space.azimuth -= across;
      space.elevation = Math.max(-90, Math.min(90, space.elevation + down));
      space.name = "";
      space.onTurn();
      space.ask();
    }
    const enlarge = (by) => { space.zoom = Math.max(0.2, Math.min(40, space.zoom * by)); space.ask(); };
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      enlarge(Math.exp(-event.deltaY * 0.0015));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { Object.assign(space, { zoom: 1, pan: [0, 0] }); space.ask(); });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-6, 0], ArrowRight: [6, 0], ArrowUp: [0, -6], ArrowDown: [0, 6] }[event.key];
      if (step) turn(...step);
      else if (event.key === "+") enlarge(1.2);
      else if (event.key === "-") enlarge(1 / 1.2);
      else return;
      event.preventDefault();
    });
    canvas.addEventListener("webglcontextlost", () => canvas.replaceWith(
      "The browser released the memory of this picture; reload the page to see it."));
    new ResizeObserver(() => space.resize(canvas.clientWidth, canvas.clientHeight)).observe(canvas);
    space.view("isometric");
    return space;
  };
})();
