// The running campaign; pairs, poles and landmarks set by the user. The 3D view is the report's.
"use strict";
(() => {
  const by = (id) => document.getElementById(id);
  const make = (tag, text = "", more = {}) => Object.assign(document.createElement(tag), { textContent: text }, more);
  const list = (id, texts) => by(id).replaceChildren(...texts.map((text) => make("li", text)));

  async function ask(path, body) {
    const options = body && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
    let answer;
    try { answer = await fetch(path, options); } catch { throw new Error("modetune view is no longer running; restart it"); }
    if (answer.ok) return answer.json();
    const text = await answer.text();
    let problems = [text];
    try { problems = JSON.parse(text).problems || [text]; } catch { /* plain text */ }
    throw new Error(problems.join("\n"));
  }
  // Run `work` with the page inert, and show its error on the page.
  const guarded = (work) => async (...args) => {
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

  // Poll the campaign once a second while the page is visible.
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
        const { text, done, asked } = live.progress || { text: "" };
        by("progress").hidden = !text;
        by("doing").textContent = text;
        if (asked) Object.assign(by("bar"), { max: asked, value: done }); else by("bar").removeAttribute("value");
        list("jobs", live.jobs);
        if (!by("configuration").length) by("configuration").append(...live.configurations.map((name) => new Option(name)));
        by("which").hidden = !live.configurations.length;
        by("log").textContent = live.log.join("\n");
        if (live.mark !== mark) by("tables").replaceChildren(...live.tables.flatMap(table));
        mark = live.mark;
        by("reload").hidden = mark === frameMark;
        by("shown").textContent = mark === frameMark ? "The report of the current record." : "A newer iteration is available.";
      } catch (error) { by("status").textContent = error.message; by("reason").textContent = ""; }
    }
    setTimeout(look, 1000);
  }
  const reload = () => { frameMark = mark; by("shapes").classList.add("waiting"); by("report").src = "/report?" + encodeURIComponent(mark) + "#shapes"; };

  // Show a change as a difference of the file, and write it after confirmation.
  let shown = null;
  const configuration = () => by("configuration").value;
  const propose = (asked) => guarded(async () => {
    const body = { ...asked(), configuration: configuration() }, found = await ask("/change", body);
    shown = { ...body, base: found.base };
    by("change-file").textContent = found.file;
    by("change-problem").textContent = "";
    list("change-notes", found.notes);
    by("diff").replaceChildren(...found.diff.slice(2).map((line) => make("div", line || " ",
      { className: line[0] === "+" ? "added" : line[0] === "-" ? "gone" : "" })));
    if (!found.diff.length) by("diff").textContent = "The file does not change.";
    by("change").showModal();
  })();
  async function write() {
    try { await ask("/change", shown); } catch (error) { by("change-problem").textContent = error.message; return; }
    by("change").close();
    open(document.querySelector("[aria-selected=true]").dataset.tab);
  }

  // Doubts.
  const TABS = { "test.pairs": "pairs", "test.sensors.match": "sensors" };   // where values are picked by hand
  const sentence = (text) => text.split("`").map((part, at) => (at % 2 ? make("code", part) : part));
  function control({ key, place, text, choices, removes }) {
    const made = make("span", "", { className: "setting" }), open_ = TABS[key];
    const button = (name, onclick) => make("button", name, { type: "button", onclick });
    if (removes) {
      made.append(make("code", key), button("Remove", () => propose(() => ({ place, text: null }))));
      return made;
    }
    if (open_ && !text) {
      made.append(make("code", key), button("Choose in " + open_, () => open(open_)));
      return made;
    }
    const field = choices.length ? make("select") : make("input", "", { value: text, placeholder: "value", size: Math.max(text.length, 8) });
    if (choices.length && !text) field.append(new Option("choose", ""));
    choices.forEach((word) => field.append(new Option(word, word, false, word === text)));
    const label = make("label");
    label.append(make("code", key + ":"), field);
    made.append(label, button("Review", () => propose(() => ({ place, text: field.value }))));
    return made;
  }
  const showDoubts = (solve) => guarded(async () => {
    by("doubt-list").replaceChildren();
    by("doubt-count").textContent = "";
    by("unsolved").hidden = true;
    const found = await ask("/doubts?" + new URLSearchParams({ solve, configuration: configuration() }));
    by("unsolved").hidden = !found.unsolved;
    by("doubt-list").replaceChildren(...found.doubts.map(({ level, subject, text, controls }) => {
      const item = make("li", "", { className: level }), line = make("p"), settings = make("p", "", { className: "settings" });
      line.append(make("strong", `${level}, ${subject}: `, { className: level === "wrong" ? "outside" : "fair" }), ...sentence(text));
      settings.append(...(controls.length ? controls.map(control) : ["No key of the campaign file resolves this: change the model or the test."]));
      item.append(line, settings);
      return item;
    }));
    by("doubt-count").textContent = `${found.doubts.length || "No"} doubt${found.doubts.length === 1 ? "" : "s"}; ${found.good} other finding${found.good === 1 ? " is" : "s are"} good.`;
  })();

  // Pairs.
  let pairs = null;
  const showPairs = (solve) => guarded(async () => {
    const found = await ask("/pairs?" + new URLSearchParams({ solve, configuration: configuration() }));
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
          button.style.background = `color-mix(in srgb, #0072b2 ${Math.round(70 * mac)}%, var(--paper))`;   // the ink stays legible
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
  function drawPoles() {
    const { chart, tracks } = diagram, picked = tracks.filter((one) => one.picked);
    for (const panel of chart.panels) {
      panel.items = panel.items.filter((item) => item.kind !== "Rule").concat(picked.map((track) =>
        ({ kind: "Rule", name: "", value: track.hz, colour: "var(--accent)", line: "-", upright: true })));
    }
    if (diagram.draw) diagram.draw();
    else diagram.draw = modetune.chart(by("diagram"), chart, { onPoint: (hz) => {
      const far = (track) => Math.abs(track.hz / hz - 1);
      const track = tracks.reduce((one, other) => (far(other) < far(one) ? other : one), tracks[0]);
      if (track && far(track) < 0.01) pick(track);
    } });
    by("tracks").replaceChildren(...tracks.map((track) => {
      const button = make("button", `${track.hz.toPrecision(5)} Hz, ${(100 * track.damping).toPrecision(2)} %`,
        { type: "button", title: `stable at ${track.stable} orders`, onclick: () => pick(track) });
      button.setAttribute("aria-pressed", String(track.picked));
      return button;
    }));
  }
  const pick = (track) => { track.picked = !track.picked; drawPoles(); };
  const showPoles = guarded(async () => {
    const [low, high, order] = ["low", "high", "order"].map((id) => by(id).value);
    by("diagram").replaceChildren();
    diagram = await ask("/poles?" + new URLSearchParams({ order, configuration: configuration(), ...(low && high ? { low, high } : {}) }));
    [by("low").value, by("high").value] = diagram.band.map((hz, end) =>
      Number((hz * (end ? 1 + 1e-5 : 1 - 1e-5)).toPrecision(6)));  // rounded outwards
    list("pole-notes", diagram.notes);
    drawPoles();
  });

  // Sensors.
  let scene = null, landmarks = new Map(), chosen = null, spaces = null;
  // A click that did not rotate the view selects the point under it.
  const found = (one, x, y) => one.space.under(one.layer, x, y, 14);
  function onPress(one, work) {
    let from = [0, 0];
    one.space.canvas.addEventListener("pointerdown", (event) => { from = [event.clientX, event.clientY]; });
    one.space.canvas.addEventListener("pointerup", (event) => {
      const turned = Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 4;
      const row = turned ? -1 : found(one, event.offsetX, event.offsetY);
      if (row >= 0) work(row);
    });
  }
  const { unpack } = modetune;
  const ink = (name) => modetune.rgb(modetune.colour(name));
  function space(id, text) {
    const fresh = by(id).cloneNode();  // without the views and listeners of the previous scene
    by(id).replaceWith(fresh);
    const made = modetune.space(fresh);
    if (!made) throw new Error("this browser has no WebGL 2: edit `test.sensors.match` in the campaign file");
    made.paper = ink("paper");
    return { space: made, places: unpack(text, Float32Array) };
  }
  function paintPoints() {
    const [test, model] = spaces, done = ink("good"), plain = ink("ink"), now = ink("outside");
    test.layer.paint(Float32Array.from(scene.points.flatMap((point) =>
      point === chosen ? now : landmarks.has(point) ? done : plain)));
    const taken = new Set(landmarks.values());
    model.layer.paint(Float32Array.from(scene.nodes.flatMap((node) => (taken.has(node) ? now : ink("mesh")))));
    [test, model].forEach((one) => one.space.ask());
    by("point").textContent = chosen === null ? "" : `point ${chosen}: now click its node`;
    const head = ["test point", "node of the model", ""], body = [...landmarks].sort(([a], [b]) => a - b);
    by("landmarks").replaceChildren();
    const row = by("landmarks").createTHead().insertRow();
    head.forEach((text) => row.append(make("th", text)));
    for (const [point, node] of body) {
      const line = by("landmarks").insertRow();
      line.append(make("th", String(point)));
      const input = make("input", "", { value: String(node) });
      input.setAttribute("aria-label", `node of test point ${point}`);
      input.addEventListener("change", () => { const numbers = input.value.split(",").map(Number);
        landmarks.set(point, numbers.length === 1 ? numbers[0] : numbers);
        paintPoints(); });
      line.insertCell().append(input);
      line.insertCell().append(make("button", "remove", { type: "button", onclick: () => { landmarks.delete(point); paintPoints(); } }));
    }
  }
  // Coordinates of the test on the model: y = s R x + t.
  const times = (matrix, [x, y, z]) => matrix.map((row) => row[0] * x + row[1] * y + row[2] * z);
  function laid(places, pose) {
    const out = new Float32Array(places.length);
    for (let at = 0; at < places.length; at += 3) {
      times(pose.rotation, places.subarray(at, at + 3)).forEach((v, k) => { out[at + k] = pose.scale * v + pose.translation[k]; });
    }
    return out;
  }
  const showSensors = guarded(async () => {
    scene = await ask("/sensors?" + new URLSearchParams({ configuration: configuration() }));
    landmarks = new Map(Object.entries(scene.landmarks).map(([point, node]) => [Number(point), node]));
    chosen = null;
    list("sensor-notes", scene.notes);
    const test = space("test-space", scene.places);
    const model = space("model-space", scene.coordinates);
    test.space.lines(test.places, unpack(scene.lines, Uint32Array), { low: ink("soft"), size: 1.5 });
    test.layer = test.space.points(test.places, { low: ink("ink"), size: 9 });
    model.space.surface(model.places, unpack(scene.triangles, Uint32Array), { low: ink("mesh"), alpha: 1 });
    model.space.lines(model.places, unpack(scene.edges, Uint32Array), { low: ink("soft"), size: 1 });
    model.layer = model.space.points(model.places, { low: ink("mesh"), size: 5 });
    const first = laid(test.places, scene.pose);
    model.space.lines(first, unpack(scene.lines, Uint32Array), { low: ink("accent"), size: 1.5, through: true });
    model.space.points(first, { low: ink("accent"), size: 7, through: true });
    model.space.factor = 1;
    spaces = [test, model];
    onPress(test, (row) => { chosen = scene.points[row]; paintPoints(); });
    onPress(model, (row) => {
      if (chosen === null) { by("point").textContent = "click a test point first"; return; }
      landmarks.set(chosen, scene.nodes[row]);
      chosen = null;
      paintPoints();
    });
    paintPoints();
  });

  const tabs = { live: () => {}, doubts: () => showDoubts(false), shapes: reload, pairs: () => showPairs(false), poles: showPoles, sensors: showSensors };
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
  by("report").addEventListener("load", () => by("shapes").classList.remove("waiting"));
  by("check").addEventListener("click", () => showDoubts(true));
  by("solve").addEventListener("click", () => showPairs(true));
  by("identify").addEventListener("click", showPoles);
  by("pairs-change").addEventListener("click", () => propose(() => ({ pairs: Object.fromEntries(pairs || []) })));
  by("poles-change").addEventListener("click", () => propose(() => ({
    pick: diagram ? diagram.tracks.filter((one) => one.picked).map((one) => one.hz) : [],
    band: diagram && diagram.band, order: diagram ? diagram.order : 60,
  })));
  by("sensors-change").addEventListener("click", () => propose(() => ({ landmarks: Object.fromEntries(landmarks) })));
  by("configuration").addEventListener("change", () => open(document.querySelector("[aria-selected=true]").dataset.tab));
  by("write").addEventListener("click", write);
  by("cancel").addEventListener("click", () => by("change").close());
  modetune.press = (which, number) => {  // the position of a point on its canvas, and the point that a click there selects
    const [one, numbers] = which === "test" ? [spaces[0], scene.points] : [spaces[1], scene.nodes];
    const [x, y] = one.space.where(one.layer, numbers.indexOf(number));
    return { x, y, number: numbers[found(one, x, y)] };
  };
  open(tabs[location.hash.slice(1)] ? location.hash.slice(1) : "live");
  look();
})();
