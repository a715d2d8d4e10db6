// The campaign live, and pairs, poles and landmarks set by hand; the view in space is the report's.
"use strict";
(() => {
  const by = (id) => document.getElementById(id);
  const make = (tag, text = "", more = {}) => Object.assign(document.createElement(tag), { textContent: text }, more);
  const list = (id, texts) => by(id).replaceChildren(...texts.map((text) => make("li", text)));

  async function ask(path, body) {
    const options = body && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
    let answer;
    try { answer = await fetch(path, options); } catch { throw new Error("modetune view has ended; start it again"); }
    if (answer.ok) return answer.json();
    const told = await answer.text();
    let problems = [told];
    try { problems = JSON.parse(told).problems || [told]; } catch { /* a plain sentence */ }
    throw new Error(problems.join("\n"));
  }
  // Work whose trouble is told on the page, which takes no presses meanwhile.
  const told = (work) => async (...args) => {
    by("problem").hidden = true;
    document.body.setAttribute("aria-busy", "true");
    document.querySelector("main").inert = true;
    try { await work(...args); } catch (error) {
      by("problem").textContent = error.message;
      by("problem").hidden = false;
    } finally {
      document.body.removeAttribute("aria-busy");
      document.querySelector("main").inert = false;
    }
  };

  // The campaign, asked for once a second while somebody looks.
  let mark = null, frameMark = null;
  function table({ title, heads, words, rows }) {
    const made = make("table"), row = made.createTHead().insertRow();
    const kind = (at) => (words[at] ? "words" : "");
    heads.forEach((head, at) => row.append(make("th", head, { className: kind(at) })));
    const body = made.createTBody();
    for (const texts of rows) {
      const line = body.insertRow();
      texts.forEach((text, at) => line.append(make("td", text, { className: kind(at) })));
    }
    const box = make("div", "", { className: "table" });
    box.append(made);
    return [make("h3", title), box];
  }
  async function look() {
    if (!document.hidden) {
      try {
        const live = await ask("/live");
        by("name").textContent = live.name;
        by("status").textContent = live.status;
        by("reason").textContent = live.reason;
        list("jobs", live.jobs);
        by("log").textContent = live.log.join("\n");
        if (live.mark !== mark) by("tables").replaceChildren(...live.tables.flatMap(table));
        mark = live.mark;
        by("reload").hidden = mark === frameMark;
        by("shown").textContent = mark === frameMark ? "The report as the record stands." : "There is a newer iteration.";
      } catch (error) { by("status").textContent = error.message; by("reason").textContent = ""; }
    }
    setTimeout(look, 1000);
  }
  const reload = () => { frameMark = mark; by("report").src = "/report?" + encodeURIComponent(mark) + "#shapes"; };

  // A change is shown as it will stand in the file, and written on a second word.
  let shown = null;
  const propose = (asked) => told(async () => {
    const body = asked(), found = await ask("/change", body);
    shown = { ...body, base: found.base };
    by("change-file").textContent = found.file;
    by("change-problem").textContent = "";
    list("change-notes", found.notes);
    by("diff").replaceChildren(...found.diff.slice(2).map((line) => make("div", line || " ",
      { className: line[0] === "+" ? "added" : line[0] === "-" ? "gone" : "" })));
    if (!found.diff.length) by("diff").textContent = "nothing changes in the file";
    by("change").showModal();
  })();
  async function write() {
    try { await ask("/change", shown); } catch (error) { by("change-problem").textContent = error.message; return; }
    by("change").close();
    open(document.querySelector("[aria-selected=true]").dataset.tab);
  }

  // Pairs.
  let pairs = null;
  const showPairs = (solve) => told(async () => {
    const found = await ask("/pairs" + (solve ? "?solve=true" : ""));
    by("solving").hidden = !found.unsolved;
    by("mac").replaceChildren();
    if (found.unsolved) return;
    pairs = new Map(Object.entries(found.by_hand).map(([number, mode]) => [Number(number), mode]));
    by("pair-note").textContent = found.note;
    const row = by("mac").createTHead().insertRow();
    row.append(make("th", "test mode"));
    found.elastic_hz.forEach((hz, at) => row.append(make("th", `elastic ${at + 1}\n${hz.toPrecision(5)} Hz`)));
    const body = by("mac").createTBody(), cells = [];
    found.numbers.forEach((number, place) => {
      const line = body.insertRow();
      line.append(make("th", `${number}: ${found.test_hz[place].toPrecision(5)} Hz`));
      found.elastic_hz.forEach((hz, at) => {
        const off = 100 * (hz / found.test_hz[place] - 1), digits = Math.abs(off) < 100 ? 1 : 0, mac = found.mac ? found.mac[place][at] : null;
        const button = make("button", mac === null ? "" : mac.toFixed(2), { type: "button" });
        button.append(make("small", (off < 0 ? "−" : "+") + Math.abs(off).toFixed(digits) + " %"));
        button.setAttribute("aria-label", `test mode ${number} with elastic mode ${at + 1}`);
        if (mac !== null) {
          button.style.background = `color-mix(in srgb, #0072b2 ${Math.round(100 * mac)}%, var(--paper))`;
          if (mac > 0.5) button.style.color = "#fff";
        }
        button.addEventListener("click", () => {
          const undone = pairs.get(number) === at + 1;
          for (const [other, mode] of pairs) if (mode === at + 1) pairs.delete(other);
          if (undone) pairs.delete(number); else pairs.set(number, at + 1);
          paint();
        });
        line.insertCell().append(button);
        cells.push([button, number, at + 1]);
      });
    });
    const paint = () => cells.forEach(([button, number, mode]) => {
      const hand = pairs.get(number) === mode;
      button.className = hand ? "by-hand" : found.paired[number] === mode && !pairs.has(number) ? "paired" : "";
      button.setAttribute("aria-pressed", String(hand));
    });
    paint();
  })();

  // Poles.
  let diagram = null;
  const drawn = (tag, attributes, text = "") => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.textContent = text;
    return made;
  };
  function drawPoles() {
    if (!diagram) return;
    const { band: [low, high], order, sum, poles, tracks } = diagram;
    const width = by("diagram").clientWidth || 800, height = width < 600 ? 320 : 420;
    const x = (hz) => 8 + (width - 16) * (hz - low) / (high - low);
    const y = (n) => (height - 24) * (1 - n / (order + 1));
    const logs = sum.map(([, value]) => Math.log10(value || 1e-300));
    const [least, most] = [Math.min(...logs), Math.max(...logs)];
    const curve = sum.map(([hz], at) =>
      `${x(hz).toFixed(1)},${((height - 24) * (1 - (logs[at] - least) / (most - least || 1))).toFixed(1)}`).join(" ");
    const svg = drawn("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": "stabilisation diagram" });
    svg.append(drawn("polyline", { points: curve }));
    for (const track of tracks.filter((one) => one.picked)) {
      svg.append(drawn("line", { x1: x(track.hz), x2: x(track.hz), y1: 0, y2: height - 24 }));
    }
    for (const [hz, at, kind] of poles) {
      svg.append(drawn("circle", { cx: x(hz).toFixed(1), cy: y(at).toFixed(1), r: kind === 3 ? 3.2 : 2.2, class: `k${kind}` }));
    }
    for (let tick = 0; tick <= 4; tick++) {
      const hz = low + tick * (high - low) / 4;
      const anchor = tick === 0 ? "start" : tick === 4 ? "end" : "middle";
      svg.append(drawn("text", { x: x(hz), y: height - 8, "text-anchor": anchor }, `${hz.toPrecision(4)} Hz`));
    }
    svg.classList.add("hit");
    svg.addEventListener("click", (event) => {
      const at = (event.clientX - svg.getBoundingClientRect().left) * width / svg.getBoundingClientRect().width;
      const far = (track) => Math.abs(x(track.hz) - at);
      const nearest = tracks.reduce((one, other) => (far(other) < far(one) ? other : one), tracks[0]);
      if (nearest && far(nearest) < 14) pick(nearest);
    });
    by("diagram").replaceChildren(svg);
    by("tracks").replaceChildren(...[...tracks].sort((one, other) => one.hz - other.hz).map((track) => {
      const button = make("button", `${track.hz.toPrecision(5)} Hz, ${(100 * track.damping).toPrecision(2)} %`,
        { type: "button", title: `stable at ${track.stable} orders`, onclick: () => pick(track) });
      button.setAttribute("aria-pressed", String(track.picked));
      return button;
    }));
  }
  const pick = (track) => { track.picked = !track.picked; drawPoles(); };
  const showPoles = told(async () => {
    const [low, high, order] = ["low", "high", "order"].map((id) => by(id).value);
    const band = low && high ? `&low=${low}&high=${high}` : "";
    diagram = await ask(`/poles?order=${order}${band}`);
    [by("low").value, by("high").value] = diagram.band.map((hz) => Number(hz.toPrecision(6)));
    list("pole-notes", diagram.notes);
    drawPoles();
  });

  // Sensors.
  let scene = null, landmarks = new Map(), chosen = null, spaces = null;
  const unpack = (text, Kind) => modetune.unpack(text, Kind);
  // Places on a canvas with their depth: a parallel projection, so four places tell it.
  function projection(space, length) {
    const basis = { places: Float32Array.from([0, 0, 0, length, 0, 0, 0, length, 0, 0, 0, length]), motion: new Float32Array(12), still: true };
    const [origin, ...ends] = [0, 1, 2, 3].map((row) => space.where(basis, row));
    const step = ends.map((end) => end.map((value, k) => (value - origin[k]) / length));
    const [a, e] = [space.azimuth, space.elevation].map((degrees) => degrees * Math.PI / 180);
    const eye = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    return (places, row) => {
      const p = [places[3 * row], places[3 * row + 1], places[3 * row + 2]];
      const along = (values) => p[0] * values[0] + p[1] * values[1] + p[2] * values[2];
      return [0, 1].map((k) => origin[k] + along(step.map((one) => one[k]))).concat(along(eye));
    };
  }
  function extent(places) {
    const ends = [0, 1, 2].map((k) => places.filter((_, at) => at % 3 === k));
    return Math.hypot(...ends.map((values) => values.reduce((m, v) => Math.max(m, v), -Infinity) - values.reduce((m, v) => Math.min(m, v), Infinity))) || 1;
  }
  // The row next to a press; of those as near as a finger is wide, what lies in front.
  function pressed(one, px, py) {
    const place = projection(one.space, one.length), near = [];
    for (let row = 0; row < one.places.length / 3; row++) {
      const [x, y, depth] = place(one.places, row), far = Math.hypot(x - px, y - py);
      if (far < 14) near.push({ row, far, depth });
    }
    const front = near.reduce((most, item) => Math.max(most, item.depth), -Infinity) - 0.03 * one.length;
    return near.filter((item) => item.depth >= front).sort((a, b) => a.far - b.far)[0]?.row ?? -1;
  }
  function onPress(one, work) {
    let from = null;
    one.space.canvas.addEventListener("pointerdown", (event) => { from = [event.clientX, event.clientY]; });
    one.space.canvas.addEventListener("pointerup", (event) => {
      if (!from || Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 4) return;  // it was turned
      const row = pressed(one, event.offsetX, event.offsetY);
      if (row >= 0) work(row);
    });
  }
  const ink = (name) => modetune.rgb(modetune.colour(name));
  function space(id, places) {
    const fresh = by(id).cloneNode();  // no views and no listeners of an earlier scene
    by(id).replaceWith(fresh);
    const made = modetune.space(fresh);
    if (!made) throw new Error("this browser has no WebGL 2: write `test.sensors.match` by hand");
    made.paper = ink("paper");
    return { space: made, places, length: extent(places) };
  }
  function paintPoints() {
    const [test, model] = spaces, done = ink("good"), plain = ink("ink"), now = ink("outside");
    test.layer.paint(Float32Array.from(scene.points.flatMap((point) =>
      point === chosen ? now : landmarks.has(point) ? done : plain)));
    const taken = new Set(landmarks.values());
    model.layer.paint(Float32Array.from(scene.nodes.flatMap((node) => (taken.has(node) ? now : ink("mesh")))));
    [test, model].forEach((one) => one.space.ask());
    by("point").textContent = chosen === null ? "" : `point ${chosen}: now press its node`;
    const head = ["test point", "node of the model", ""], body = [...landmarks].sort(([a], [b]) => a - b);
    by("landmarks").replaceChildren();
    const row = by("landmarks").createTHead().insertRow();
    head.forEach((text) => row.append(make("th", text)));
    for (const [point, node] of body) {
      const line = by("landmarks").insertRow();
      line.append(make("th", String(point)));
      const input = make("input", "", { type: "number", min: 1, value: node });
      input.setAttribute("aria-label", `node of test point ${point}`);
      input.addEventListener("change", () => { landmarks.set(point, Number(input.value)); paintPoints(); });
      line.insertCell().append(input);
      line.insertCell().append(make("button", "remove", { type: "button", onclick: () => { landmarks.delete(point); paintPoints(); } }));
    }
  }
  const showSensors = told(async () => {
    scene = await ask("/sensors");
    landmarks = new Map(Object.entries(scene.landmarks).map(([point, node]) => [Number(point), node]));
    chosen = null;
    list("sensor-notes", scene.notes);
    const test = space("test-space", unpack(scene.places, Float32Array));
    const model = space("model-space", unpack(scene.coordinates, Float32Array));
    test.space.lines(test.places, unpack(scene.lines, Uint32Array), { low: ink("soft"), size: 1.5 });
    test.layer = test.space.points(test.places, { low: ink("ink"), size: 9 });
    model.space.surface(model.places, unpack(scene.triangles, Uint32Array), { low: ink("mesh"), alpha: 1 });
    model.space.lines(model.places, unpack(scene.edges, Uint32Array), { low: ink("soft"), size: 1 });
    model.layer = model.space.points(model.places, { low: ink("mesh"), size: 5 });
    if (scene.laid) model.space.points(unpack(scene.laid, Float32Array), { low: ink("accent"), size: 7, through: true });
    spaces = [test, model];
    onPress(test, (row) => { chosen = scene.points[row]; paintPoints(); });
    onPress(model, (row) => {
      if (chosen === null) { by("point").textContent = "press a point of the test first"; return; }
      landmarks.set(chosen, scene.nodes[row]);
      chosen = null;
      paintPoints();
    });
    paintPoints();
  });

  const tabs = { live: () => {}, shapes: reload, pairs: () => showPairs(false), poles: showPoles, sensors: showSensors };
  function open(name) {
    by("problem").hidden = true;
    for (const button of document.querySelectorAll("[data-tab]")) {
      button.setAttribute("aria-selected", String(button.dataset.tab === name));
      by(button.dataset.tab).hidden = button.dataset.tab !== name;
    }
    history.replaceState(null, "", "#" + name);
    tabs[name]();
  }
  document.querySelectorAll("[data-tab]").forEach((button) => button.addEventListener("click", () => open(button.dataset.tab)));
  by("reload").addEventListener("click", reload);
  by("solve").addEventListener("click", () => showPairs(true));
  by("identify").addEventListener("click", showPoles);
  by("pairs-change").addEventListener("click", () => propose(() => ({ pairs: Object.fromEntries(pairs || []) })));
  by("poles-change").addEventListener("click", () => propose(() => ({
    pick: diagram ? diagram.tracks.filter((one) => one.picked).map((one) => one.hz) : [],
    band: diagram && diagram.band, order: diagram ? diagram.order : 60,
  })));
  by("sensors-change").addEventListener("click", () => propose(() => ({ landmarks: Object.fromEntries(landmarks) })));
  by("write").addEventListener("click", write);
  by("cancel").addEventListener("click", () => by("change").close());
  window.addEventListener("resize", drawPoles);
  window.modetuneView = {  // where a point is on its canvas, and which one a press there finds
    found: (which, number) => {
      const [one, numbers] = which === "test" ? [spaces[0], scene.points] : [spaces[1], scene.nodes];
      const [x, y] = projection(one.space, one.length)(one.places, numbers.indexOf(number));
      return { x, y, row: numbers[pressed(one, x, y)] };
    },
  };
  open(tabs[location.hash.slice(1)] ? location.hash.slice(1) : "live");
  look();
})();
