// Mode shapes in space: vertices are moved by Plotly, a frame after the other.
"use strict";
(() => {
  const view = document.getElementById("shape-view");
  if (!view) return;
  const { data, colour, themed, config, dark } = modetune;
  const scene = data.scene;
  const STEPS = 32767;    // motions of the model are whole numbers of these
  const SHARE = 0.07;     // largest motion over the length of everything at 100 %
  const PERIOD = 1800;    // milliseconds
  const ZOOM = 2.6;       // size in the view; without perspective the camera's distance has no effect
  const MODEL = 0, EDGES = 1, REST = 2, POINTS = 3, LINES = 4;

  const unpack = (text, Kind) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return new Kind(bytes.buffer);
  };
  const coordinates = unpack(scene.coordinates, Float32Array);
  const triangles = unpack(scene.triangles, Uint32Array);
  const edges = unpack(scene.edges, Uint32Array);
  const points = unpack(scene.points, Float32Array);
  const lines = unpack(scene.lines, Uint32Array);
  const hasTest = points.length > 0;
  const hasSurface = triangles.length > 0;

  const now = { mode: 0, state: "after", amplitude: 1, phase: 1, playing: false, model: null, test: null };

  // x, y, z of places moved by a factor times a motion.
  function moved(places, motion, factor) {
    const n = places.length / 3;
    const out = [new Float32Array(n), new Float32Array(n), new Float32Array(n)];
    for (let i = 0; i < n; i++) {
      for (let k = 0; k < 3; k++) out[k][i] = places[3 * i + k] + factor * motion[3 * i + k];
    }
    return out;
  }

  // The ends of segments in one stroke, with gaps.
  function stroke(ends, xyz) {
    return xyz.map((values) => {
      const out = new Float32Array(1.5 * ends.length);
      for (let i = 0, j = 0; i < ends.length; i += 2) {
        out[j++] = values[ends[i]];
        out[j++] = values[ends[i + 1]];
        out[j++] = NaN;
      }
      return out;
    });
  }

  const unpacked = new Map();
  function motion() {
    const key = now.mode + now.state;
    if (!unpacked.has(key)) {
      const told = scene.modes[now.mode][now.state];
      const model = Float32Array.from(unpack(told.model, Int16Array), (v) => v / STEPS);
      unpacked.set(key, { model, test: unpack(told.test, Float32Array) });
    }
    return unpacked.get(key);
  }

  function positions() {
    const { model, test } = motion();
    const factor = now.phase * now.amplitude * SHARE * scene.length;
    const nodes = moved(coordinates, model, factor);
    const sensors = moved(points, test, factor);
    return [nodes, stroke(edges, nodes), sensors, stroke(lines, sensors)];
  }

  function lengths() {
    const { model } = motion();
    return Float32Array.from({ length: model.length / 3 }, (_, i) =>
      Math.hypot(model[3 * i], model[3 * i + 1], model[3 * i + 2]));
  }

  function box() {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const places of [coordinates, points]) {
      for (let i = 0; i < places.length; i++) {
        low[i % 3] = Math.min(low[i % 3], places[i]);
        high[i % 3] = Math.max(high[i % 3], places[i]);
      }
    }
    const room = 1.3 * SHARE * scene.length;
    return [0, 1, 2].map((k) => [low[k] - room, high[k] + room]);
  }

  const xyz = ([x, y, z]) => ({ x, y, z });

  function traces() {
    const [nodes, outline, sensors, wires] = positions();
    const third = (k) => Uint32Array.from({ length: triangles.length / 3 }, (_, i) => triangles[3 * i + k]);
    const rest = stroke(edges, moved(coordinates, coordinates, 0));
    const scale = [[0, colour("mesh")], [1, "#0072B2"]];
    const surface = hasSurface
      ? { type: "mesh3d", ...xyz(nodes), i: third(0), j: third(1), k: third(2), intensity: lengths(),
          cmin: 0, cmax: 1, colorscale: scale, showscale: false, flatshading: true, name: "model",
          lighting: { ambient: 0.85, diffuse: 0.55, specular: 0.08, roughness: 0.9 } }
      : { type: "scatter3d", mode: "markers", ...xyz(nodes), name: "model",
          marker: { size: 4, color: "#0072B2" } };
    return [
      { ...surface, hoverinfo: "skip", showlegend: true },
      { type: "scatter3d", mode: "lines", ...xyz(outline), hoverinfo: "skip", showlegend: false,
        line: { color: hasSurface ? "rgba(20,30,45,0.45)" : "#0072B2", width: hasSurface ? 1 : 2 } },
      { type: "scatter3d", mode: "lines", ...xyz(rest), hoverinfo: "skip", name: "at rest",
        line: { color: colour("line"), width: 1 } },
      { type: "scatter3d", mode: "markers", ...xyz(sensors), name: "test", visible: hasTest,
        text: scene.nodes.map((node) => "test point " + node), hoverinfo: "text",
        marker: { size: 5, color: colour("ink") } },
      { type: "scatter3d", mode: "lines", ...xyz(wires), hoverinfo: "skip", showlegend: false,
        visible: hasTest, line: { color: colour("ink"), width: 4 } },
    ];
  }

  function layout() {
    const ranges = box();
    const sizes = ranges.map(([low, high]) => high - low);
    const largest = Math.max(...sizes);
    const axis = (k) => ({ range: ranges[k], visible: false, autorange: false });
    return themed({
      margin: { l: 0, r: 0, t: 0, b: 0 }, uirevision: "kept", showlegend: false,
      scene: {
        xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), aspectmode: "manual", uirevision: "kept",
        aspectratio: { x: ZOOM * sizes[0] / largest, y: ZOOM * sizes[1] / largest, z: ZOOM * sizes[2] / largest },
        camera: { eye: { x: -1.0, y: -1.25, z: 0.85 }, projection: { type: "orthographic" } },
      },
    });
  }

  function tell() {
    const mode = scene.modes[now.mode];
    const state = mode[now.state];
    const off = 100 * (state.hz / mode.test_hz - 1);
    const mac = state.mac === null ? "" : ", MAC " + state.mac.toFixed(3);
    document.getElementById("shape-told").textContent =
      "test " + mode.test_hz.toPrecision(5) + " Hz, model " + state.hz.toPrecision(5) + " Hz (" +
      (off < 0 ? "−" : "+") + Math.abs(off).toFixed(2) + " %)" + mac;
  }

  // Straight to what is drawn: a restyle would take the camera from the hand that turns it. Where
  // Plotly keeps its drawing elsewhere, a restyle does.
  async function push(which, moving) {
    const drawing = view._fullLayout.scene._scene;
    if (!drawing || !drawing.traces || !drawing.glplot) {
      const [x, y, z] = [0, 1, 2].map((k) => moving.map((places) => places[k]));
      return Plotly.restyle(view, { x, y, z }, which);
    }
    which.forEach((trace, place) => {
      const full = view._fullData[trace], known = drawing.traces[full.uid];
      Object.assign(view.data[trace], xyz(moving[place]));
      Object.assign(full, xyz(moving[place]));
      if (known) known.update(full);
    });
    drawing.glplot.redraw();
  }

  let busy = false, again = false;
  async function move() {
    if (!view.dataset.ready) return;
    if (busy) { again = true; return; }
    busy = true;
    await push([MODEL, EDGES, POINTS, LINES], positions());
    busy = false;
    if (again) { again = false; move(); }
  }

  function choose() {
    tell();
    if (hasSurface && view.dataset.ready) Plotly.restyle(view, { intensity: [lengths()] }, [MODEL]).then(move);
    else move();
  }

  function frame(time) {
    if (!now.playing) return;
    now.phase = Math.cos(2 * Math.PI * (time - now.begun) / PERIOD);
    move().then(() => requestAnimationFrame(frame));
  }

  function connect() {
    const by = (id) => document.getElementById(id);
    const select = by("shape-mode"), play = by("shape-play");
    scene.modes.forEach((mode, place) => {
      select.add(new Option(mode.label + "  –  " + mode.test_hz.toPrecision(5) + " Hz", place));
    });
    select.addEventListener("change", () => { now.mode = Number(select.value); choose(); });
    document.querySelectorAll("button.state").forEach((button, _, all) => {
      button.addEventListener("click", () => {
        now.state = button.dataset.state;
        all.forEach((one) => one.setAttribute("aria-pressed", String(one === button)));
        choose();
      });
    });
    play.addEventListener("click", () => {
      now.playing = !now.playing;
      play.textContent = now.playing ? "Pause" : "Play";
      if (!now.playing) return;
      now.begun = performance.now() - PERIOD * Math.acos(Math.max(-1, Math.min(1, now.phase))) / (2 * Math.PI);
      requestAnimationFrame(frame);
    });
    by("shape-amplitude").addEventListener("input", (event) => {
      now.amplitude = event.target.value / 100;
      if (!now.playing) move();
    });
    const shown = (id, which) => by(id).addEventListener("change", (event) =>
      Plotly.restyle(view, { visible: event.target.checked }, which));
    shown("shape-model", [MODEL, EDGES]);
    shown("shape-test", [POINTS, LINES]);
    shown("shape-rest", [REST]);
    if (!hasTest) by("shape-test").parentElement.hidden = true;
  }

  function start() {
    Plotly.newPlot(view, traces(), layout(), config).then(() => { view.dataset.ready = "true"; });
  }
  connect();
  tell();
  const watcher = new IntersectionObserver((entries) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    watcher.disconnect();
    start();
  }, { rootMargin: "300px" });
  watcher.observe(view);
  const redraw = () => view.dataset.ready && Plotly.react(view, traces(), layout(), config);
  dark.addEventListener("change", redraw);
  window.addEventListener("beforeprint", () => { if (!view.dataset.ready) start(); });
})();
