// Animated mode shapes: any test mode together with any mode of the model.
// `modetune.shapes(host, scene)` adds controls and view to an empty element.
"use strict";
(() => {
  const STEPS = 32767;     // motions are integers, this one being the largest
  const SHARE = 0.07;      // largest motion relative to the size of the structure, at 100 %
  const PERIOD = 1800;     // milliseconds
  const FARTHEST = 2.5;    // limit on the test's motion relative to the model's
  const FILM = { width: 640, pictures: 24 };
  const { unpack, colour, rgb } = modetune;

  const motion = (text) => Float32Array.from(unpack(text, Int16Array), (v) => v / STEPS);
  const scaled = (values, by) => values.map((v) => v * by);
  const product = (one, other) => one.reduce((sum, v, i) => sum + v * other[i], 0);
  const largest = (values) => {
    let most = 0;
    for (let i = 0; i < values.length; i += 3) most = Math.max(most, Math.hypot(...values.slice(i, i + 3)));
    return most;
  };

  // Whether a point is inside the surface, which then is drawn transparent.
  function hasInside(points, places, triangles, length) {
    const near = 1e-3 * length;
    const sides = (x, y, z) => {
      let hit = 0;
      const at = [x, y, z];
      for (let t = 0; t < triangles.length && hit !== 63; t += 3) {
        const [a, b, c] = [0, 1, 2].map((k) => places.subarray(3 * triangles[t + k], 3 * triangles[t + k] + 3));
        for (let k = 0; k < 3; k++) {
          if (hit >> (2 * k) === 3) continue;
          const u = (k + 1) % 3, v = (k + 2) % 3;
          const cross = (p, q) => (p[u] - at[u]) * (q[v] - at[v]) - (p[v] - at[v]) * (q[u] - at[u]);
          const [wa, wb, wc] = [cross(b, c), cross(c, a), cross(a, b)], area = wa + wb + wc;
          if (!area || wa * area < 0 || wb * area < 0 || wc * area < 0) continue;
          const far = (wa * a[k] + wb * b[k] + wc * c[k]) / area - at[k];
          if (far > near) hit |= 1 << (2 * k);
          if (far < -near) hit |= 2 << (2 * k);
        }
      }
      return hit === 63;
    };
    for (let i = 0; i < points.length; i += 3) {
      if (sides(points[i], points[i + 1], points[i + 2])) return true;
    }
    return false;
  }

  const element = (tag, properties = {}, ...children) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  };
  // Contents of the first and second panel.
  modetune.captions = (...texts) => texts.map((textContent) => element("span", { className: "caption", textContent }));
  const hertz = (value) => value.toPrecision(5) + " Hz";

  modetune.shapes = (host, scene) => {
    const canvas = element("canvas", { ariaLabel: "mode shape of test and model", role: "img" });
    const frame = element("div", { className: "frame" }, canvas);
    const told = element("span", { className: "told", role: "status" });
    const space = modetune.space(canvas);
    if (!space) {
      host.append(element("p", { textContent: "This browser has no WebGL 2, which is needed to draw mode shapes." }));
      return null;
    }
    const places = unpack(scene.coordinates, Float32Array), points = unpack(scene.points, Float32Array);
    const triangles = unpack(scene.triangles, Uint32Array), edges = unpack(scene.edges, Uint32Array);
    const wires = unpack(scene.lines, Uint32Array);
    const hasTest = points.length > 0, hasSurface = triangles.length > 0;
    const states = scene.states.map((state) => state.name);
    const known = (name) => scene.states[states.indexOf(name)];
    const inside = hasTest && hasSurface && hasInside(points, places, triangles, scene.length);
    const now = { test: 0, model: 0, state: states[states.length - 1], amplitude: 1, phase: 1, playing: false };

    const rest = space.lines(places, edges, { still: true });
    const faces = hasSurface ? space.surface(places, triangles, { panels: [1] }) : null;
    const outline = space.lines(places, edges, { panels: [1], size: hasSurface ? 1 : 3 });
    const joints = hasSurface ? null : space.points(places, { panels: [1], size: 9 });
    const wire = hasTest ? space.lines(points, wires, { panels: [0], size: 3.5, through: true }) : null;
    const dots = hasTest ? space.points(points, { panels: [0], size: 9, through: true }) : null;
    // Without a surface, the mode's motion at the sensors.
    const ghostWire = hasTest ? space.lines(points, wires, { panels: [1], size: 3.5 }) : null;
    const ghosts = hasTest ? space.points(points, { panels: [1], size: 9 }) : null;
    const modelParts = [faces, outline, joints].filter(Boolean);

    // Motions of the selected pair; the modal scale factor scales the test to the model.
    function chosen() {
      const { models, mac } = known(now.state);
      const test = scene.tests[now.test], model = models[now.model];
      const field = model && model.surface ? motion(model.surface) : null;
      const seen = model && hasTest ? motion(model.points) : new Float32Array(points.length);
      let tested = hasTest && test && test.points ? motion(test.points) : new Float32Array(points.length);
      let sign = 1;
      const length = Math.sqrt(product(tested, tested)), least = Math.sqrt(product(seen, seen));
      if (length && least) {
        const common = product(tested, seen) / length;
        if (common < 0) sign = -1;
        // The modal scale factor of uncorrelated shapes is zero: use at least a tenth.
        const own = Math.max(Math.abs(common) / least ** 2, 0.1 / least);
        tested = scaled(tested, 1 / (own * length));
        tested = scaled(tested, Math.min(1, FARTHEST / (largest(tested) || 1)));
      }
      return { test, model, tested, seen: scaled(seen, sign), field: field && scaled(field, sign),
        mac: mac && mac[now.model] ? mac[now.model][now.test] : null };
    }

    function tell({ test, model, mac }) {
      const parts = [];
      if (test) parts.push("test mode " + test.label + ": " + hertz(test.hz));
      if (model) {
        const off = test ? 100 * (model.hz / test.hz - 1) : null;
        parts.push("model " + now.state + " (mode " + model.label + "): " + hertz(model.hz) + (off === null ? "" :
          " (" + (off < 0 ? "−" : "+") + Math.abs(off).toFixed(2) + " %)"));
      }
      if (mac !== null && mac !== undefined) parts.push("MAC " + mac.toFixed(3));
      told.textContent = parts.join(", ");
    }

    function choose() {
      const pair = chosen();
      const onSurface = pair.field !== null;
      for (const part of modelParts) {
        part.visible = onSurface && boxes.model.checked;
        part.move(pair.field || new Float32Array(places.length));
      }
      if (hasTest) {
        for (const part of [wire, dots]) { part.visible = boxes.test.checked; part.move(pair.tested); }
        for (const part of [ghostWire, ghosts]) {
          part.visible = !onSurface && boxes.model.checked;
          part.move(pair.seen);
        }
      }
      rest.visible = boxes.rest.checked;
      if (faces) faces.alpha = boxes.glass.checked ? 0.45 : 1;
      space.reach = now.amplitude * SHARE * scene.length;
      tell(pair);
      move();
    }
    function move() {
      space.factor = now.phase * now.amplitude * SHARE * scene.length;
      space.ask();
    }
    function dress() {
      const blue = rgb("#0072b2");
      space.paper = rgb(colour("paper"));
      rest.low = rgb(colour("line"));
      if (faces) [faces.low, faces.high] = [rgb(colour("mesh")), blue];
      outline.low = hasSurface ? rgb(colour("edge")) : blue;
      for (const part of [ghostWire, ghosts, joints]) {
        if (part) { part.low = blue; if (part.paint) part.paint(blue); }
      }
      if (hasTest) { wire.low = rgb(colour("ink")); dots.paint(wire.low); }
      space.ask();
    }

    // Controls.
    const button = (text, action, pressed) => {
      const made = element("button", { type: "button", textContent: text });
      if (pressed !== undefined) made.setAttribute("aria-pressed", String(pressed));
      made.addEventListener("click", () => action(made));
      return made;
    };
    const group = (label, ...buttons) => {
      const made = element("span", { className: "group", role: "group" }, ...buttons);
      made.setAttribute("aria-label", label);
      return made;
    };
    const press = (one) => [...one.parentElement.children].forEach((other) =>
      other.setAttribute("aria-pressed", String(other === one)));
    const box = (text, checked) => {
      const made = element("input", { type: "checkbox", checked });
      made.addEventListener("change", choose);
      return [made, element("label", {}, made, " " + text)];
    };
    const choice = (label, change) => {
      const made = element("select", { ariaLabel: label });
      made.addEventListener("change", () => change(Number(made.value)));
      return made;
    };
    const tests = choice("test mode", (test) => show({ test }));
    const models = choice("mode of the model", (model) => show({ model }));
    scene.tests.forEach((mode, place) => tests.add(new Option(mode.label + " – " + hertz(mode.hz), place)));
    const stateButtons = states.map((name) => {
      const made = button(name, () => show({ state: name }), name === now.state);
      made.className = "state";
      made.dataset.state = name;
      return made;
    });
    const play = button("Play", () => playing(!now.playing));
    const amplitude = element("input", { type: "range", min: 0, max: 200, value: 100, ariaLabel: "amplitude" });
    amplitude.addEventListener("input", () => { now.amplitude = amplitude.value / 100; choose(); });
    const boxes = {}, labels = {};
    [boxes.model, labels.model] = box("model", true);
    [boxes.test, labels.test] = box("test", hasTest);
    [boxes.rest, labels.rest] = box("undeformed", true);
    [boxes.glass, labels.glass] = box("transparent", inside);
    const views = ["isometric", "front", "side", "top"].map((name) =>
      button(name, () => space.view(name), name === "isometric"));
    space.onTurn = () => views.forEach((one) =>
      one.setAttribute("aria-pressed", String(one.textContent === space.name)));
    const captions = modetune.captions("test", "model");
    captions.forEach((caption) => { caption.hidden = true; });
    const beside = (panels) => (one) => {
      press(one);
      space.panels = panels;
      captions.forEach((caption) => { caption.hidden = panels === 1; });
      space.ask();
    };
    const arrangement = group("arrangement", button("overlaid", beside(1), true), button("side by side", beside(2), false));
    const files = group("pictures", button("PNG", async () => save(await space.png(), "png")),
      button("GIF", async (one) => {
        one.disabled = true;
        await new Promise((done) => setTimeout(done, 30));   // let the browser update the button
        save(film(), "gif");
        one.disabled = false;
      }));

    function save(blob, kind) {
      const { test, model } = chosen();
      const name = ["mode", test && test.label, model && "model-" + model.label, now.state].filter(Boolean)
        .join("-");
      modetune.save(blob, name + "." + kind);
    }
    function film() {
      const kept = now.phase;
      const pictures = Array.from({ length: FILM.pictures }, (_, i) => {
        now.phase = Math.cos(2 * Math.PI * i / FILM.pictures);
        move();
        return space.pixels(FILM.width);
      });
      now.phase = kept;
      move();
      return modetune.gif(pictures, PERIOD / 1000 / FILM.pictures);
    }

    // Shows a test mode, a mode of the model, a state; a test mode alone selects its partner too.
    function show({ test = now.test, model, state = now.state }) {
      const { models: found, pairs } = known(state);
      const pair = pairs.find(([one]) => one === test);
      if (model === undefined) model = pair ? pair[1] : Math.min(now.model, found.length - 1);
      Object.assign(now, { test, state, model });
      models.replaceChildren(...found.map((mode, place) => {
        const option = new Option(mode.label + " – " + hertz(mode.hz), place);
        option.disabled = !mode.surface && !mode.points;
        return option;
      }));
      tests.value = String(now.test);
      models.value = String(now.model);
      stateButtons.forEach((one) => one.setAttribute("aria-pressed", String(one.dataset.state === state)));
      choose();
    }

    function playing(on) {
      now.playing = on;
      play.textContent = on ? "Pause" : "Play";
      if (!on) return;
      const begun = performance.now() - PERIOD * Math.acos(Math.max(-1, Math.min(1, now.phase))) / (2 * Math.PI);
      const step = (time) => {
        if (!now.playing) return;
        now.phase = Math.cos(2 * Math.PI * (time - begun) / PERIOD);
        move();
        requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    }

    labels.test.hidden = arrangement.hidden = !hasTest;
    labels.glass.hidden = !hasSurface;
    const labelled = (text, control) => element("label", {}, text + " ", control);
    const above = element("div", { className: "controls" });
    if (scene.tests.length) above.append(labelled("Test mode", tests));
    above.append(labelled("Model", models));
    if (states.length > 1) above.append(group("state of the model", ...stateButtons));
    above.append(play, labelled("Amplitude", amplitude), told);
    const below = element("div", { className: "controls below" },
      group("view", ...views), arrangement, labels.model, labels.test, labels.rest, labels.glass, files);
    frame.append(...captions);
    host.append(above, frame, below);
    if (dots) {
      modetune.tip(canvas, (x, y) => {
        const row = boxes.test.checked && !space.busy ? space.under(dots, x, y) : -1;
        return row < 0 ? "" : "test point " + scene.nodes[row];
      });
    }
    dress();
    show({});
    modetune.onTheme(dress);
    return { show, playing, space, now, told, dots };
  };
})();
