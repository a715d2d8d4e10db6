// Charts are drawn when they come into sight, all of them before printing.
"use strict";
const modetune = (() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const config = { displaylogo: false, responsive: true, topojsonURL: "", plotlyServerURL: "" };
  const drawn = new Map();

  const colour = (name) =>
    getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

  const axisLook = () => ({
    gridcolor: colour("grid"), zerolinecolor: colour("line"), linecolor: colour("line"),
    tickcolor: colour("line"),
  });

  // The page's colours over a chart's own layout.
  function themed(layout) {
    const out = structuredClone(layout);
    out.paper_bgcolor = out.plot_bgcolor = "rgba(0,0,0,0)";
    out.font = { family: getComputedStyle(document.body).fontFamily, size: 12, color: colour("ink") };
    out.hoverlabel = { bgcolor: colour("paper"), bordercolor: colour("line"), align: "left" };
    out.autosize = true;
    for (const key of Object.keys(out)) {
      if (/^[xy]axis\d*$/.test(key)) {
        Object.assign(out[key], axisLook());
      }
      if (/^scene\d*$/.test(key)) {
        for (const axis of ["xaxis", "yaxis", "zaxis"]) {
          out[key][axis] = Object.assign(out[key][axis] || {}, axisLook(),
            { showbackground: false, color: colour("soft") });
        }
      }
    }
    return out;
  }

  // Black is the test's colour; on dark paper it is the ink's.
  function inked(traces) {
    return structuredClone(traces).map((trace) => {
      for (const part of [trace.line, trace.marker, trace.marker && trace.marker.line]) {
        if (part && part.color === "#000000") part.color = colour("ink");
      }
      return trace;
    });
  }

  function draw(place) {
    if (drawn.has(place)) return drawn.get(place);
    const figure = data.charts[place.dataset.chart];
    const done = Plotly.newPlot(place, inked(figure.data), themed(figure.layout), config);
    drawn.set(place, done);
    return done;
  }

  const places = [...document.querySelectorAll("[data-chart]")];
  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      watcher.unobserve(entry.target);
      draw(entry.target);
    }
  }, { rootMargin: "300px" });
  places.forEach((place) => watcher.observe(place));

  dark.addEventListener("change", () => {
    for (const place of drawn.keys()) {
      const figure = data.charts[place.dataset.chart];
      Plotly.react(place, inked(figure.data), themed(figure.layout), config);
    }
  });
  window.addEventListener("beforeprint", () => {
    document.querySelectorAll("details").forEach((one) => { one.open = true; });
    places.forEach(draw);
  });

  // Which section is being read.
  const links = new Map([...document.querySelectorAll("nav a")].map((a) => [a.hash.slice(1), a]));
  const reader = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      links.forEach((link) => link.classList.remove("here"));
      links.get(entry.target.id).classList.add("here");
    }
  }, { rootMargin: "-10% 0px -80% 0px" });
  document.querySelectorAll("main section").forEach((section) => reader.observe(section));

  return { data, colour, themed, config, dark, drawAll: () => Promise.all(places.map(draw)) };
})();
