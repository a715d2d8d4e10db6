// The page: draws a chart when it scrolls into view, the others when idle, all before printing.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  modetune.onTheme = (action) => dark.addEventListener("change", action);
  const drawn = new Set(), spaces = [];   // what is drawn, and the views in 3D
  const host = document.getElementById("shape-view");

  // A click on a cell of a MAC matrix shows that pair.
  function onCell(chart) {
    if (!modetune.player || !/^mac/.test(chart) || !data.scene.tests.length) return null;
    return (model, test, state) => {
      modetune.player.show({ test, model, state });
      host.scrollIntoView({ behavior: "smooth", block: "center" });
    };
  }
  function draw(place) {
    if (drawn.has(place)) return;
    drawn.add(place);
    const name = place.dataset.chart;
    modetune.chart(place, data.charts[name], { onCell: onCell(name) });
  }

  // COMAC at the sensors, before and after side by side.
  function comac(place) {
    if (drawn.has(place)) return;
    drawn.add(place);
    const { scene, comac: { foot, ...values } } = data, { unpack, rgb, colour } = modetune;
    const canvas = document.createElement("canvas"), space = modetune.space(canvas);
    if (!space) return;
    place.append(canvas, ...modetune.captions("before", "after"));
    spaces.push(space);
    const points = unpack(scene.points, Float32Array);
    const mesh = space.lines(unpack(scene.coordinates, Float32Array), unpack(scene.edges, Uint32Array));
    const dots = ["before", "after"].map((state, panel) => {
      const made = space.points(points, { panels: [panel], size: 11, through: true });
      made.paint(Float32Array.from(values[state].flatMap((v) => modetune.scaled("viridis", (v - foot) / (1 - foot)))));
      return made;
    });
    space.panels = 2;
    const dress = () => { space.paper = rgb(colour("paper")); mesh.low = rgb(colour("line")); space.ask(); };
    modetune.onTheme(dress);
    dress();
    modetune.tip(canvas, (x, y) => {
      const panel = space.panel(x, y), row = space.under(dots[panel], x, y);
      return row < 0 ? "" : `test point ${scene.nodes[row]}: ${values[panel ? "after" : "before"][row].toFixed(3)}`;
    });
  }

  if (host && data.scene) {
    modetune.player = modetune.shapes(host, data.scene);
    if (modetune.player) spaces.push(modetune.player.space);
    host.dataset.ready = "true";
  }
  const places = [...document.querySelectorAll("[data-chart]")];
  const seen = (action) => new IntersectionObserver((entries, watcher) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      watcher.unobserve(entry.target);
      action(entry.target);
    }
  }, { rootMargin: "300px" });
  const watcher = seen(draw);
  places.forEach((place) => watcher.observe(place));
  const onSensors = document.getElementById("comac-view");
  if (onSensors) seen(comac).observe(onSensors);
  // The rest one by one while nothing else is to do, for pictures of the whole page.
  const idle = window.requestIdleCallback || ((action) => setTimeout(action, 50));
  const drawRest = () => {
    const place = places.find((one) => !drawn.has(one) && one.offsetParent);
    if (place) { draw(place); idle(drawRest); } else if (onSensors) comac(onSensors);
  };
  window.addEventListener("load", () => idle(drawRest));
  modetune.drawAll = () => { places.forEach(draw); if (onSensors) comac(onSensors); };
  window.addEventListener("beforeprint", () => {
    document.querySelectorAll("details").forEach((one) => { one.open = true; });
    modetune.drawAll();
    spaces.forEach((space) => space.still());
  });

  // Marks the visible section in the contents.
  const links = new Map([...document.querySelectorAll("nav a")].map((a) => [a.hash.slice(1), a]));
  const reader = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      links.forEach((link) => link.classList.remove("here"));
      links.get(entry.target.id).classList.add("here");
    }
  }, { rootMargin: "-10% 0px -80% 0px" });
  document.querySelectorAll("main section[id]").forEach((section) => reader.observe(section));
})();
