// Charts as SVG and as CSV, from the values of `chart.py`; redrawn when their width changes.
"use strict";
(() => {
  const PIXELS = 84;          // per inch of a panel
  const NARROWEST = 290;      // pixels of a panel; a narrower page has fewer columns
  const NEAR = 24;            // pixels between pointer and a point that shows its tooltip
  const ZERO = 0.005;         // smaller values in a map are not printed
  const SCALES = {
    viridis: ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"],
    RdBu: ["#67001f", "#b2182b", "#d6604d", "#f4a582", "#f7f7f7", "#92c5de", "#4393c3", "#2166ac", "#053061"],
    Blues: ["#f7fbff", "#deebf7", "#c6dbef", "#9ecae1", "#6baed6", "#4292c6", "#2171b5", "#08519c", "#08306b"],
  };
  const DASHES = { "-": "", "--": "6 4", ":": "2 3" };
  const { rgb } = modetune;

  const svg = (tag, attributes = {}, text) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "fill" || name === "stroke") made.style[name] = value;
      else made.setAttribute(name, value);
    }
    if (text !== undefined) made.textContent = text;
    return made;
  };
  const ink = (colour) => colour === "#000000" ? "var(--ink)" : colour;   // black is the test's
  modetune.scaled = (name, share) => {
    const stops = SCALES[name], at = Math.max(0, Math.min(1, share)) * (stops.length - 1);
    const low = Math.min(stops.length - 2, Math.floor(at)), [one, other] = [rgb(stops[low]), rgb(stops[low + 1])];
    return one.map((v, k) => v + (at - low) * (other[k] - v));
  };
  const css = (shares) => `rgb(${shares.map((v) => Math.round(255 * v)).join(",")})`;
  const digits = (value) => {
    if (value === 0) return "0";
    const size = Math.abs(value);
    const text = size >= 1e5 || size < 1e-3 ? value.toExponential(1).replace(".0e", "e").replace("e+", "e") : String(Number(value.toPrecision(6)));
    return text.replace(/-/g, "−");
  };

  // Shows a tooltip; `find(x, y)` returns its text, with x and y in pixels of the element.
  const bubble = document.createElement("div");
  bubble.className = "tip";
  bubble.hidden = true;
  modetune.tip = (element, find) => {
    const look = (event) => {
      const box = element.getBoundingClientRect();
      const text = find(event.clientX - box.left, event.clientY - box.top, event);
      bubble.hidden = !text;
      if (!text) return;
      bubble.textContent = text;
      if (!bubble.parentElement) document.body.append(bubble);
      const left = Math.min(event.clientX + 14, document.documentElement.clientWidth - bubble.offsetWidth - 6);
      bubble.style.left = Math.max(6, left) + "px";
      bubble.style.top = Math.max(6, event.clientY - bubble.offsetHeight - 12) + "px";
    };
    element.addEventListener("pointermove", look);
    element.addEventListener("pointerdown", look);
    element.addEventListener("pointerleave", () => { bubble.hidden = true; });
  };

  modetune.save = (blob, name) => {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name.replace(/[^\w.-]+/g, "_") });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };

  // The numbers of a chart as CSV: a row for each point, bar, cell and rule; empty columns are left out.
  modetune.csv = (chart) => {
    const head = (side) => {
      const labels = new Set(chart.panels.map((panel) => panel[side].label));
      return labels.size === 1 && !labels.has("") ? [...labels][0] : side;
    };
    const rows = chart.panels.flatMap((panel) => panel.items.flatMap((item) => {
      const name = (side, v) => (panel[side].names.length ? panel[side].names[Math.round(v)] : v);
      const row = (x, y, value = "", half = "", note = "") => [panel.title, item.name || "", x, y, value, half, note];
      if (item.kind === "Rule") return [item.upright ? row(name("x", item.value), "") : row("", name("y", item.value))];
      if (item.kind === "Curve") {
        return item.x.map((x, i) => row(name("x", x), name("y", item.y[i]), "", "", item.labels[i] || item.tooltips[i]));
      }
      if (item.kind === "Bars") {
        return item.values.map((v, i) => row(...(panel.sideways ? [v, panel.y.names[i]] : [panel.x.names[i], v]), "",
          item.errors ? item.errors[i] : "", item.labels[i]));
      }
      return item.values.flatMap((line, i) => line.map((v, j) => row(panel.x.names[j], panel.y.names[i], v)));
    }));
    const heads = ["panel", "series", head("x"), head("y"), "value", "half width", "note"];
    const kept = heads.map((_, at) => at).filter((at) => rows.some((row) => row[at] !== "" && row[at] != null));
    const written = (v) => {
      if (v == null || typeof v === "number") return String(v ?? "");
      const text = /^[=+@-]/.test(v) && !Number.isFinite(Number(v)) ? "'" + v : v;   // no formula in a spreadsheet
      return /[",\n]/.test(text) ? `"${text.replace(/"/g, '""')}"` : text;
    };
    return [heads, ...rows].map((row) => kept.map((at) => written(row[at])).join(",") + "\n").join("");
  };

  function ticks(low, high, count, step) {
    if (!step) {
      const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
      step = power * ([1, 2, 2.5, 5].find((one) => one * power >= raw) || 10);
    }
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
    return found;
  }
  function logTicks(low, high) {
    const decades = high - low, found = [];
    const within = decades < 1.2 ? [1, 2, 3, 5, 7] : decades < 3 ? [1, 2, 5] : [1];
    const every = Math.ceil(decades / 6);
    for (let k = Math.floor(low); k <= high; k++) {
      if (decades >= 3 && k % every) continue;
      for (const one of within) {
        const at = k + Math.log10(one);
        if (at >= low - 1e-9 && at <= high + 1e-9) found.push(at);
      }
    }
    return found;
  }

  // An axis: its ends (their logarithms on a logarithmic axis) and its ticks.
  function scale(axis, values, room, zoomed) {
    if (axis.names.length) {
      const ends = [-0.6, axis.names.length - 0.4];
      return { low: ends[axis.turned ? 1 : 0], high: ends[axis.turned ? 0 : 1], of: (v) => v, marks: null };
    }
    const of = axis.log ? (v) => (v > 0 ? Math.log10(v) : NaN) : (v) => v;
    const known = values.map(of).filter(Number.isFinite);
    let [low, high] = zoomed || (axis.span ? axis.span.map(of) : [Math.min(...minmax(known)), Math.max(...minmax(known))]);
    if (!Number.isFinite(low) || !Number.isFinite(high)) [low, high] = [0, 1];
    if (low === high) [low, high] = [low - (axis.log ? 0.5 : 0.5 * Math.abs(low) || 0.5), high + (axis.log ? 0.5 : 0.5 * Math.abs(high) || 0.5)];
    if (!axis.span && !zoomed) {
      const margin = 0.06 * (high - low);
      [low, high] = [low - margin, high + margin];
    }
    const count = Math.max(2, Math.floor(room));
    let at = axis.log ? logTicks(low, high) : ticks(low, high, count, zoomed ? null : axis.step);
    if (axis.log && at.length < 2) at = ticks(10 ** low, 10 ** high, 3).map(Math.log10);
    const written = (places) => at.map((v) => digits(axis.log ? Number((10 ** v).toPrecision(places)) : v));
    let places = 3;   // as many as needed to distinguish the tick labels
    while (places < 6 && new Set(written(places)).size < at.length) places++;
    const texts = written(places), marks = at.map((v, i) => [v, texts[i]]);
    return axis.turned ? { low: high, high: low, of, marks } : { low, high, of, marks };
  }
  const minmax = (values) => values.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);

  const MARKS = {
    o: (x, y, r) => svg("circle", { cx: x, cy: y, r }),
    ring: (x, y, r) => svg("circle", { cx: x, cy: y, r, class: "open" }),
    s: (x, y, r) => svg("rect", { x: x - r, y: y - r, width: 2 * r, height: 2 * r }),
    v: (x, y, r) => svg("path", { d: `M${x - r} ${y - r}h${2 * r}l${-r} ${2 * r}z` }),
    x: (x, y, r) => svg("path", { d: `M${x - r} ${y - r}l${2 * r} ${2 * r}m0 ${-2 * r}l${-2 * r} ${2 * r}`, class: "open" }),
    "+": (x, y, r) => svg("path", { d: `M${x - r} ${y}h${2 * r}m${-r} ${-r}v${2 * r}`, class: "open" }),
  };

  function cellText(item, panel, row, column) {
    const { value } = { value: item.values[row][column] };
    return item.tooltip.replace(/\{(\w+)(?::([+]?)\.(\d)f)?\}/g, (_, name, sign, decimals) => {
      if (name === "row") return panel.y.names[row];
      if (name === "column") return panel.x.names[column];
      const text = Number(value).toFixed(decimals);
      return (sign && value >= 0 ? "+" : "") + text.replace("-", "−");
    });
  }

  // Bars in 3D: cells from back to front, three faces each.
  function towers(panel, item, width, height) {
    const group = svg("g"), rows = item.values.length, columns = item.values[0].length;
    const across = Math.min((width - 40) / ((rows + columns) * 0.87), (height - 46) / ((rows + columns) * 0.5 + Math.max(rows, columns) * 0.62));
    const tall = across * Math.max(rows, columns) * 0.62;
    const left = width / 2 + (rows - columns) * across * 0.435, top = 14 + tall;
    const at = (column, row, z) => [left + (column - row) * across * 0.87, top + (column + row) * across * 0.5 - z * tall];
    const polygon = (points, fill, shade) => svg("polygon", {
      points: points.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" "),
      fill: css(fill.map((v) => v * shade)), stroke: "rgba(0,0,0,.35)", "stroke-width": 0.5 });
    group.append(svg("polygon", { points: [[0, 0], [columns, 0], [columns, rows], [0, rows]].map(([c, r]) => at(c, r, 0).join(",")).join(" "),
      fill: "none", stroke: "var(--line)" }));
    for (let back = 0; back < rows; back++) {
      const row = rows - 1 - back;   // the first computed mode is in front
      for (let column = 0; column < columns; column++) {
        const z = Math.max(item.values[row][column], 0.004), fill = modetune.scaled("viridis", z), e = 0.16;
        const [c0, c1, r0, r1] = [column + e, column + 1 - e, back + e, back + 1 - e];
        const cell = svg("g", { class: "cell" });
        cell.tooltip = cellText(item, panel, row, column);
        cell.cell = [row, column];
        cell.append(
          polygon([at(c0, r1, 0), at(c1, r1, 0), at(c1, r1, z), at(c0, r1, z)], fill, 0.82),
          polygon([at(c1, r1, 0), at(c1, r0, 0), at(c1, r0, z), at(c1, r1, z)], fill, 0.66),
          polygon([at(c0, r0, z), at(c1, r0, z), at(c1, r1, z), at(c0, r1, z)], fill, 1));
        group.append(cell);
      }
    }
    const every = Math.ceil(Math.max(rows, columns) / 12);
    const words = (text, [x, y], anchor) => group.append(svg("text", { x, y, "text-anchor": anchor, class: "tick" }, text));
    panel.x.names.forEach((name, i) => { if (i % every === 0) words(name, at(i + 0.5, rows + 0.35, -12 / tall), "end"); });
    panel.y.names.forEach((name, i) => { if (i % every === 0) words(name, at(columns + 0.35, rows - i - 0.5, -12 / tall), "start"); });
    const [ax, ay] = at(columns / 2, rows, 0), [bx, by] = at(columns, rows / 2, 0);
    group.append(svg("text", { x: Math.max(60, ax - 30), y: Math.min(height - 4, ay + 40), "text-anchor": "middle", class: "axis" }, panel.x.label),
      svg("text", { x: Math.min(width - 62, bx + 30), y: Math.min(height - 4, by + 40), "text-anchor": "middle", class: "axis" }, panel.y.label));
    return group;
  }

  // Draws a chart of `chart.py`; clicks call options.onCell(row, column, panel title) and
  // options.onPoint(horizontal value). Returns a function that draws a changed chart.
  modetune.chart = (host, chart, options = {}) => {
    const zooms = new Map();
    let width = 0;
    const file = [chart.title, host.id.replace(/^chart-/, "")].filter(Boolean).join("-") + ".csv";
    const csv = Object.assign(document.createElement("button"), { type: "button", className: "csv", textContent: "CSV", title: "Save the numbers of this chart" });
    csv.setAttribute("aria-label", "save as CSV: " + (chart.description || file));
    csv.addEventListener("click", () => modetune.save(new Blob([modetune.csv(chart)], { type: "text/csv" }), file));

    function drawPanel(panel, place, outer, shared) {
      const heat = panel.items.find((item) => item.kind === "HeatMap");
      const tower = panel.items.find((item) => item.kind === "Towers");
      const longest = (names) => Math.max(0, ...names.map((name) => name.length));
      const labels = panel.x.names.length ? Math.min(longest(panel.x.names) * 6.2, 120) : 0;
      const lies = labels + 8 <= (outer - 80) / (panel.x.names.length + 0.2);   // names need no slant
      const degrees = lies ? 0 : panel.x.slant, slant = degrees * Math.PI / 180;
      const room = { left: 16, right: 10, top: panel.title ? 24 : 8, bottom: 22 + (panel.x.label ? 18 : 0) };
      if (slant) room.bottom = 12 + labels * Math.sin(slant) + (panel.x.label ? 18 : 0);
      const height = PIXELS * chart.size[1] + (panel.title ? 12 : 0) + Math.max(0, room.bottom - 40);
      const made = svg("svg", { width: outer, height, viewBox: `0 0 ${outer} ${height}`, role: "img", "aria-label": panel.title || chart.description });
      if (panel.title) made.append(svg("text", { x: outer / 2, y: 14, "text-anchor": "middle", class: "title" }, panel.title));
      made.targets = [];
      if (tower) {
        made.append(towers(panel, tower, outer, height));
        return made;
      }
      const curves = panel.items.filter((item) => item.kind === "Curve");
      const bars = panel.items.filter((item) => item.kind === "Bars");
      const rules = panel.items.filter((item) => item.kind === "Rule");
      const reach = bars.flatMap((item) => item.values.flatMap((v, i) => item.errors ? [v - item.errors[i], v + item.errors[i]] : [v]));
      const ofBars = bars.length ? [0, ...reach] : [];
      const xs = [...curves.flatMap((item) => item.x), ...(panel.sideways ? ofBars : []), ...rules.filter((r) => r.upright).map((r) => r.value)];
      const ys = [...curves.flatMap((item) => item.y), ...(panel.sideways ? [] : ofBars), ...rules.filter((r) => !r.upright).map((r) => r.value)];
      const y = scale(panel.y, shared.ys || ys, Math.max(4, (height - room.top - room.bottom) / 36));
      const wide = panel.y.names.length ? Math.min(longest(panel.y.names) * 6.4, 0.36 * outer) : Math.max(...y.marks.map(([, text]) => text.length)) * 6.8;
      made.left = room.left = Math.max(10 + wide + (panel.y.label ? 18 : 0), shared.left);
      const legend = heat ? 46 : 0;
      const w = outer - room.left - room.right - legend, h = height - room.top - room.bottom;
      const x = scale(panel.x, xs, w / 70, zooms.get(chart.same_x ? 0 : place));
      const X = (v) => room.left + w * (x.of(v) - x.low) / (x.high - x.low);
      const Y = (v) => room.top + h * (1 - (y.of(v) - y.low) / (y.high - y.low));
      const area = svg("g"), clip = `clip-${Math.random().toString(36).slice(2)}`;
      const cutting = svg("clipPath", { id: clip });
      cutting.append(svg("rect", { x: room.left, y: room.top - 6, width: w, height: h + 12 }));
      made.append(cutting, area);

      // Grid and ticks.
      const line = (x1, y1, x2, y2, stroke) => area.append(svg("line", { x1, y1, x2, y2, stroke: `var(--${stroke})` }));
      const nx = panel.x.names.length, ny = panel.y.names.length;
      if (x.marks) {
        for (const [v, text] of x.marks) {
          const at = room.left + w * (v - x.low) / (x.high - x.low);
          line(at, room.top, at, room.top + h, "grid");
          if (!shared.below) made.append(svg("text", { x: at, y: room.top + h + 16, "text-anchor": "middle", class: "tick" }, text));
        }
      } else {
        const each = w / (nx + 0.2), need = slant ? 11 : labels + 6, every = Math.ceil(need / each);
        panel.x.names.forEach((name, i) => {
          if (i % every) return;
          const at = [X(i), room.top + h + (slant ? 10 : 16)];
          const long = name.length > 20 ? name.slice(0, 19) + "…" : name;
          made.append(svg("text", { x: at[0], y: at[1], class: "tick", "text-anchor": slant ? "end" : "middle",
            ...(slant ? { transform: `rotate(${-degrees} ${at[0]} ${at[1]})` } : {}) }, long));
        });
      }
      if (y.marks) {
        for (const [v, text] of y.marks) {
          const at = room.top + h * (1 - (v - y.low) / (y.high - y.low));
          line(room.left, at, room.left + w, at, "grid");
          made.append(svg("text", { x: room.left - 6, y: at + 4, "text-anchor": "end", class: "tick" }, text));
        }
        if (!panel.y.log && y.low < 0 && y.high > 0) line(room.left, Y(0), room.left + w, Y(0), "soft");
      } else {
        const every = Math.ceil(14 / (h / (ny + 0.2)));
        panel.y.names.forEach((name, i) => {
          if (i % every) return;
          const most = Math.floor(0.36 * outer / 6.4);
          made.append(svg("text", { x: room.left - 6, y: Y(i) + 4, "text-anchor": "end", class: "tick" },
            name.length > most ? name.slice(0, most - 1) + "…" : name));
        });
      }
      if (panel.sideways) line(X(0), room.top, X(0), room.top + h, "soft");
      if (panel.x.label && !shared.below) made.append(svg("text", { x: room.left + w / 2, y: height - 5, "text-anchor": "middle", class: "axis" }, panel.x.label));
      if (panel.y.label) {
        made.append(svg("text", { x: 12, y: room.top + h / 2, "text-anchor": "middle", class: "axis",
          transform: `rotate(-90 12 ${room.top + h / 2})` }, panel.y.label));
      }

      const inner = svg("g", { "clip-path": `url(#${clip})` });
      made.append(inner);
      if (heat) drawHeat(heat, panel, made, inner, X, Y, w, h, room);
      rules.forEach((rule) => {
        const ends = rule.upright ? { x1: X(rule.value), x2: X(rule.value), y1: room.top, y2: room.top + h }
          : { y1: Y(rule.value), y2: Y(rule.value), x1: room.left, x2: room.left + w };
        inner.append(svg("line", { ...ends, stroke: ink(rule.colour), "stroke-dasharray": DASHES[rule.line], "stroke-width": 1.2 }));
        if (rule.name) inner.append(svg("text", rule.upright ? { x: ends.x1 + 4, y: room.top + 12, class: "tick" }
          : { x: room.left + w - 4, y: ends.y1 - 4, "text-anchor": "end", class: "tick" }, rule.name));
      });
      bars.forEach((item, which) => drawBars(item, which, bars.length, panel, made, inner, X, Y));
      curves.forEach((item) => drawCurve(item, panel, made, inner, X, Y));
      if (curves.length && !nx) zooming(made, place, room, w, x);
      return made;
    }

    function drawHeat(item, panel, made, inner, X, Y, w, h, room) {
      const shareOf = (v) => (v - item.low) / (item.high - item.low);
      const cw = Math.abs(X(1) - X(0)), ch = Math.abs(Y(1) - Y(0));
      item.values.forEach((row, i) => row.forEach((v, j) => {
        const shares = v === null ? [0.5, 0.5, 0.5] : modetune.scaled(item.scale, shareOf(v));
        const cell = svg("rect", { x: X(j) - cw / 2 + 0.5, y: Y(i) - ch / 2 + 0.5, width: Math.max(cw - 1, 0.5), height: Math.max(ch - 1, 0.5), fill: css(shares), class: "cell" });
        cell.tooltip = v === null ? "" : cellText(item, panel, i, j);
        cell.cell = [i, j];
        inner.append(cell);
        if (v !== null && item.numbered && cw >= 26 && ch >= 13 && Math.abs(v) >= ZERO) {
          const [r, g, b] = shares.map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
          const light = 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.179;   // the better contrast of the two
          inner.append(svg("text", { x: X(j), y: Y(i) + 4, "text-anchor": "middle", class: "value", fill: light ? "#000" : "#fff" }, v.toFixed(2).replace("-", "−")));
        }
      }));
      const right = room.left + w + 8, n = 24;
      for (let k = 0; k < n; k++) {
        made.append(svg("rect", { x: right, y: room.top + h * (n - 1 - k) / n, width: 10, height: h / n + 0.6, fill: css(modetune.scaled(item.scale, (k + 0.5) / n)) }));
      }
      for (const share of [0, 0.5, 1]) {
        made.append(svg("text", { x: right + 14, y: room.top + h * (1 - share) + (share === 1 ? 9 : share ? 4 : 0), class: "tick" },
          digits(item.low + share * (item.high - item.low))));
      }
      if (item.unit) made.append(svg("text", { x: right - 4, y: room.top - 5, class: "tick" }, item.unit));
    }

    function drawBars(item, which, count, panel, made, inner, X, Y) {
      const each = 0.8 / count, names = panel.sideways ? panel.y.names : panel.x.names;
      item.values.forEach((v, i) => {
        if (v === null) return;
        const middle = i + (which - (count - 1) / 2) * each, [low, high] = [middle - each / 2, middle + each / 2];
        const [x1, x2, y1, y2] = panel.sideways ? [X(0), X(v), Y(low), Y(high)] : [X(low), X(high), Y(0), Y(v)];
        const fill = ink(typeof item.colours === "string" ? item.colours : item.colours[i]);
        const cell = svg("rect", { x: Math.min(x1, x2), y: Math.min(y1, y2), width: Math.max(Math.abs(x2 - x1), 0.5), height: Math.max(Math.abs(y2 - y1), 0.5), fill });
        cell.tooltip = (item.name ? item.name + ", " : "") + names[i] + ": " + digits(Number(v.toPrecision(4))) +
          (item.errors ? " ± " + digits(Number(item.errors[i].toPrecision(2))) : "");
        inner.append(cell);
        if (item.errors) {
          const e = item.errors[i];
          const ends = panel.sideways ? { x1: X(v - e), x2: X(v + e), y1: Y(middle), y2: Y(middle) } : { x1: X(middle), x2: X(middle), y1: Y(v - e), y2: Y(v + e) };
          inner.append(svg("line", { ...ends, stroke: "var(--ink)" }));
        }
        if (item.labels.length) inner.append(svg("text", { x: (x1 + x2) / 2, y: y2 - 4, "text-anchor": "middle", class: "tick" }, item.labels[i]));
      });
    }

    function drawCurve(item, panel, made, inner, X, Y) {
      const group = svg("g", { stroke: ink(item.colour), fill: ink(item.colour), "stroke-width": item.width });
      const at = item.x.map((v, i) => [X(v), item.y[i] === null || v === null ? NaN : Y(item.y[i])]);
      if (item.line) {
        let d = "", open = false;
        for (const [x, y] of at) {
          if (!Number.isFinite(x) || !Number.isFinite(y)) { open = false; continue; }
          d += `${open ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
          open = true;
        }
        group.append(svg("path", { d, fill: "none", "stroke-dasharray": DASHES[item.line] }));
      }
      at.forEach(([x, y], i) => {
        if (!Number.isFinite(x) || !Number.isFinite(y)) return;
        if (item.mark) group.append(MARKS[item.mark](x, y, item.size / 2));
        if (item.labels.length) inner.append(svg("text", { x: x - 7, y: y - 5, "text-anchor": "end", class: "tick" }, item.labels[i]));
        if (item.tooltips.length || (item.name && item.name !== "equal")) {
          const name = panel.x.names.length ? panel.x.names[Math.round(item.x[i])] : digits(Number(item.x[i].toPrecision(5)));
          made.targets.push([x, y, item.x[i], item.tooltips[i] || `${item.name}, ${name}: ${digits(Number(item.y[i].toPrecision(4)))}`]);
        }
      });
      inner.append(group);
    }

    // Dragging zooms the horizontal axis; a double click resets it.
    function zooming(made, place, room, w, x) {
      const key = chart.same_x ? 0 : place;
      const shade = svg("rect", { y: room.top, height: 1e4, width: 0, fill: "var(--accent)", opacity: 0.15 });
      let from = null;
      const at = (event) => Math.max(room.left, Math.min(room.left + w, event.clientX - made.getBoundingClientRect().left));
      made.addEventListener("pointerdown", (event) => {
        if (event.pointerType !== "mouse" || event.button) return;
        from = at(event);
        made.append(shade);
        made.setPointerCapture(event.pointerId);
      });
      made.addEventListener("pointermove", (event) => {
        if (from === null) return;
        shade.setAttribute("x", Math.min(from, at(event)));
        shade.setAttribute("width", Math.abs(at(event) - from));
      });
      made.addEventListener("pointerup", (event) => {
        if (from === null) return;
        const ends = [from, at(event)].sort((a, b) => a - b);
        from = null;
        shade.remove();
        if (ends[1] - ends[0] < 8) return;
        zooms.set(key, ends.map((end) => x.low + (x.high - x.low) * (end - room.left) / w));
        draw();
      });
      made.addEventListener("dblclick", () => { zooms.delete(key); draw(); });
    }

    function legend() {
      const names = new Map(), made = document.createElement("div");
      made.className = "legend";
      for (const panel of chart.panels) for (const item of panel.items) {
        if (item.name && item.kind !== "Rule" && !names.has(item.name)) names.set(item.name, item);
      }
      if (names.size < 2) names.clear();
      else if (chart.legend) made.append(chart.legend + ":");
      for (const [name, item] of names) {
        const sign = svg("svg", { width: 22, height: 12 });
        const paint = typeof item.colours === "string" ? item.colours : item.colour;
        const group = svg("g", { stroke: ink(paint), fill: ink(paint), "stroke-width": item.width || 1 });
        if (item.kind === "Bars") group.append(svg("rect", { x: 5, y: 1, width: 11, height: 10 }));
        if (item.line) group.append(svg("line", { x1: 1, x2: 21, y1: 6, y2: 6, "stroke-dasharray": DASHES[item.line] }));
        if (item.mark) group.append(MARKS[item.mark](11, 6, Math.min(item.size, 8) / 2));
        sign.append(group);
        const entry = document.createElement("span");
        entry.append(sign, name);
        made.append(entry);
      }
      made.append(csv);
      return made;
    }

    function draw() {
      width = host.clientWidth;
      if (!width) return;
      const across = Math.max(1, Math.min(chart.across, Math.floor(width / NARROWEST)));
      const gap = 14, outer = Math.floor((width - gap * (across - 1)) / across);
      const isMap = chart.panels.some((panel) => panel.items.some((item) => item.kind === "HeatMap"));
      const wide = isMap ? Math.min(outer, Math.max(1.7 * PIXELS * chart.size[0], 300)) : outer;
      const grid = document.createElement("div");
      grid.className = "panels";
      const ys = chart.same_y ? chart.panels.flatMap((panel) => panel.items.flatMap((item) => item.values || item.y || [])).concat(0) : null;
      const drawn = (left) => chart.panels.map((panel, place) => drawPanel(panel, place, wide, {
        left, ys, below: chart.same_x && place + across < chart.panels.length }));
      let panels = drawn(0);
      // Panels that share an axis have the widest margin of all.
      if ((chart.same_x || across === 1) && panels.length > 1) panels = drawn(Math.max(0, ...panels.map((made) => made.left || 0)));
      panels.forEach((made, place) => {
        const panel = chart.panels[place];
        made.addEventListener("click", (event) => {
          const cell = event.target.closest && event.target.closest(".cell");
          if (cell && options.onCell) options.onCell(...cell.cell, panel.title);
          const box = made.getBoundingClientRect(), point = nearest(event.clientX - box.left, event.clientY - box.top);
          if (point && options.onPoint) options.onPoint(point[2]);
        });
        const nearest = (x, y) => {
          let found = null, best = NEAR;
          for (const point of made.targets) {
            const far = Math.hypot(point[0] - x, point[1] - y);
            if (far < best) [found, best] = [point, far];
          }
          return found;
        };
        modetune.tip(made, (x, y, event) => {
          const hit = event.target.closest && (event.target.closest(".cell") || event.target);
          return (hit && hit.tooltip) || nearest(x, y)?.[3] || "";
        });
        grid.append(made);
      });
      host.replaceChildren(legend(), grid);
      host.style.minHeight = "";
      host.classList.toggle("clicked", Boolean(options.onCell));
    }
    new ResizeObserver(() => { if (Math.abs(host.clientWidth - width) > 2) draw(); }).observe(host);
    draw();
    return draw;
  };
})();
