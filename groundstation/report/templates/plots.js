// Live plots of a report: one cursor and one range of time for all of them. No request leaves the page.
// Needs uPlot, which is Copyright (c) 2022 Leon Sorokin, under the MIT licence (groundstation/web/LICENSES.txt).
"use strict";
(() => {
  const CURSOR = "time", AXIS_PX = 62, PRINTED_PX = 296 /* within a column of A4 and of letter paper */, ROW_PX = 24, GREY = "#767676", INK = "#1c2733", FAULT = "#a33b00", GRID = { stroke: "#e6e6e6", width: 1 };
  const charts = [];
  let range = null; // [from, to] in s that every plot shows; null: everything there is

  function three(value) {
    if (value === null || value === undefined || !Number.isFinite(value)) return "–";
    if (value === 0) return "0";
    const power = Number(value.toExponential(2).split("e")[1]); // after rounding: 99.96 is 100
    return value.toFixed(Math.min(Math.max(0, 2 - power), 4));
  }

  function float32(text) {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    return Array.from(new Float32Array(bytes.buffer), (v) => (Number.isNaN(v) ? null : v));
  }

  function zoom(from, to) {
    range = from === null ? null : [from, to];
    document.body.classList.toggle("zoomed", range !== null);
    for (const { chart, whole } of charts) chart.setScale("x", { min: (range ?? whole)[0], max: (range ?? whole)[1] });
  }

  function vertical(u, at_s, colour, dash) {
    const x = Math.round(u.valToPos(at_s, "x", true));
    if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
    u.ctx.save();
    u.ctx.strokeStyle = colour;
    u.ctx.lineWidth = devicePixelRatio;
    u.ctx.setLineDash(dash.map((d) => d * devicePixelRatio));
    u.ctx.beginPath();
    u.ctx.moveTo(x, u.bbox.top);
    u.ctx.lineTo(x, u.bbox.top + u.bbox.height);
    u.ctx.stroke();
    u.ctx.restore();
  }

  function level(u, value, colour) {
    const y = Math.round(u.valToPos(value, "y", true));
    if (y < u.bbox.top || y > u.bbox.top + u.bbox.height) return;
    u.ctx.save();
    u.ctx.strokeStyle = colour;
    u.ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    u.ctx.beginPath();
    u.ctx.moveTo(u.bbox.left, y);
    u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
    u.ctx.stroke();
    u.ctx.restore();
  }

  const marks = JSON.parse(document.getElementById("marks")?.textContent ?? "[]");
  function markAll(u, mark_s) {
    if (mark_s !== null && mark_s !== undefined) vertical(u, mark_s, GREY, [1, 3]);
    for (const mark of marks) vertical(u, mark.time, mark.fault ? FAULT : INK, mark.fault ? [] : [5, 3]);
  }

  function shared(last) {
    return {
      cursor: {
        sync: { key: CURSOR, scales: ["x", null] },
        drag: { x: true, y: false, setScale: false },
        points: { size: 5 },
        bind: { dblclick: () => () => zoom(null) },
      },
      xAxis: { stroke: GREY, grid: GRID, ticks: GRID, size: last ? 30 : 8, values: last ? (_, at) => at.map((t) => `${+t.toFixed(3)}`) : () => [] },
      selected: (u) => {
        if (u.select.width > 3) zoom(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
        u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
      },
    };
  }

  function add(host, options, data, whole) {
    const chart = new uPlot({ width: host.clientWidth, ms: 1, padding: [8, 8, 0, 0], ...options }, data, host);
    charts.push({ chart, whole });
    new ResizeObserver(() => host.clientWidth !== chart.width && chart.setSize({ width: host.clientWidth, height: options.height })).observe(host);
    if (range) chart.setScale("x", { min: range[0], max: range[1] });
  }

  function limits(panel, low, high) {
    for (const value of [panel.limit, panel.limit === null || low >= 0 ? null : -panel.limit, panel.floor]) {
      if (value !== null && value >= low - (high - low) && value <= high + (high - low)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (panel.floor !== null) low = Math.min(low, 0);
    const short = panel.least - (high - low);
    const pad = short > 0 ? short / 2 : 0.06 * (high - low);
    return [low - pad, high + pad];
  }

  function timePlot(figure, plot) {
    const times = plot.times.map(float32);
    const known = plot.panels.flatMap((p) => p.lines.map((l) => times[l.time])).filter((t) => t.length);
    const whole = [Math.min(...known.map((t) => t[0])), Math.max(...known.map((t) => t[t.length - 1]))];
    plot.panels.forEach((panel, index) => {
      const host = figure.appendChild(document.createElement("div"));
      const last = index === plot.panels.length - 1, common = shared(last);
      const lines = panel.lines.map((line) => [times[line.time], float32(line.values)]);
      const same = panel.lines.every((line) => line.time === panel.lines[0].time);
      const data = same ? [lines[0][0], ...lines.map((l) => l[1])] : uPlot.join(lines, lines.map(() => [1]));
      const dash = { "--": [7, 4], ":": [2, 3] };
      add(host, {
        height: plot.height + (last ? 30 : 8),
        cursor: common.cursor,
        scales: { x: { time: false, range: (_, min, max) => [min, max] }, y: { range: (_, min, max) => (min === null ? [0, 1] : limits(panel, min, max)) } },
        axes: [common.xAxis, { stroke: "#333", grid: GRID, ticks: GRID, size: AXIS_PX, label: panel.label, labelSize: 18, labelFont: "12px system-ui", space: 26 }],
        series: [
          { label: "t", value: (_, v) => (v === null ? "–" : `${v.toFixed(2)} s`) },
          ...panel.lines.map((line) => ({
            label: line.label, stroke: line.colour, width: 1.3, dash: dash[line.style],
            paths: line.style === "." ? () => null : undefined,
            points: line.style === "." ? { show: true, size: 3, fill: line.colour, stroke: line.colour, width: 0 } : { show: false },
            value: (_, v) => three(v),
          })),
        ],
        hooks: {
          setSelect: [common.selected],
          drawClear: [(u) => {
            if (panel.band === null) return;
            const [a, b] = panel.band.map((v) => Math.min(Math.max(u.valToPos(v, "y", true), u.bbox.top), u.bbox.top + u.bbox.height));
            u.ctx.fillStyle = "#ececec";
            u.ctx.fillRect(u.bbox.left, b, u.bbox.width, a - b);
          }],
          draw: [(u) => {
            markAll(u, plot.mark);
            if (panel.limit !== null) [panel.limit, -panel.limit].forEach((v) => level(u, v, GREY));
            if (panel.floor !== null) level(u, panel.floor, GREY);
          }],
        },
      }, data, whole);
      if (panel.told) host.appendChild(Object.assign(document.createElement("p"), { className: "told", textContent: panel.told }));
    });
  }

  function barPlot(figure, plot) {
    const host = figure.appendChild(document.createElement("div")), common = shared(true), n = plot.rows.length, whole = [plot.begin, plot.end];
    const wide = Math.max(...plot.rows.map(([name]) => name.length));
    add(host, {
      height: ROW_PX * n + 44,
      cursor: { ...common.cursor, y: false },
      legend: { show: false },
      scales: { x: { time: false, range: (_, min, max) => [min, max] }, y: { range: [0, n], dir: -1 } },
      axes: [common.xAxis, { stroke: "#333", grid: { show: false }, ticks: { show: false }, size: Math.max(AXIS_PX + 18, 7 * wide + 16), space: ROW_PX / 2, splits: () => plot.rows.map((_, i) => i + 0.5), values: () => plot.rows.map(([name]) => name) }],
      series: [{}, { show: true, paths: () => null, points: { show: false } }],
      hooks: {
        setSelect: [common.selected],
        draw: [(u) => {
          u.ctx.save();
          u.ctx.beginPath();
          u.ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
          u.ctx.clip();
          plot.rows.forEach(([, bars], row) => {
            const top = u.valToPos(row + 0.14, "y", true), bottom = u.valToPos(row + 0.86, "y", true);
            for (const bar of bars) {
              const from = u.valToPos(bar.begin_s, "x", true), to = u.valToPos(bar.begin_s + bar.length_s, "x", true);
              u.ctx.fillStyle = bar.colour;
              u.ctx.fillRect(from, top, Math.max(to - from, devicePixelRatio), bottom - top);
            }
          });
          u.ctx.restore();
          markAll(u, null);
        }],
      },
    }, [whole, [0, 0]], whole);
    const meanings = new Map(plot.rows.flatMap(([, bars]) => bars).filter((bar) => bar.label).map((bar) => [bar.label, bar.colour]));
    const key = figure.appendChild(document.createElement("p"));
    key.className = "key";
    for (const [label, colour] of meanings) {
      const entry = key.appendChild(document.createElement("span"));
      entry.appendChild(document.createElement("i")).style.background = colour;
      entry.append(label);
    }
  }

  // pictures that are no plots over time: the wheel zooms, dragging moves, a double click shows all
  function zoomable(svg) {
    const whole = svg.viewBox.baseVal, all = [whole.x, whole.y, whole.width, whole.height];
    let box = [...all], held = null;
    const show = () => svg.setAttribute("viewBox", box.join(" "));
    const scale = () => box[2] / svg.clientWidth;
    svg.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.shiftKey) return; // the page scrolls as ever
      event.preventDefault();
      const by = (event.deltaY || event.deltaX) > 0 ? 1.2 : 1 / 1.2, x = box[0] + event.offsetX * scale(), y = box[1] + event.offsetY * scale();
      box = [x - (x - box[0]) * by, y - (y - box[1]) * by, box[2] * by, box[3] * by];
      show();
    }, { passive: false });
    svg.addEventListener("pointerdown", (event) => { if (box[2] === all[2]) return; held = [event.clientX, event.clientY]; svg.setPointerCapture(event.pointerId); });
    svg.addEventListener("pointermove", (event) => {
      if (!held) return;
      box[0] -= (event.clientX - held[0]) * scale();
      box[1] -= (event.clientY - held[1]) * scale();
      held = [event.clientX, event.clientY];
      show();
    });
    svg.addEventListener("pointerup", () => { held = null; });
    svg.addEventListener("dblclick", () => { box = [...all]; show(); });
  }

  const TIME_LABEL = "time since the start [s]", DASHES = { "--": [5, 3], ":": [1.5, 2], "-.": [5, 2, 1.5, 2] };

  const extent = (values) => values.reduce(([low, high], v) => [Math.min(low, v), Math.max(high, v)], [Infinity, -Infinity]);

  /** A plot as paper.js draws it; what is zoomed is what is saved. */
  function onPaper(plot) {
    const instants = marks.map((mark) => ({ at: mark.time, label: mark.fault ? "fault noticed" : "fault injected or over", colour: mark.fault ? FAULT : INK, dash: mark.fault ? [] : [5, 3] }));
    if (plot.rows) return { xLabel: TIME_LABEL, from: (range ?? [plot.begin])[0], to: (range ?? [0, plot.end])[1], instants, rows: plot.rows };
    if (plot.mark !== null) instants.push({ at: plot.mark, label: `${plot.mark} s`, colour: GREY, dash: [1, 3] });
    const times = plot.times.map(float32), known = times.filter((t) => t.length);
    const whole = [Math.min(...known.map((t) => t[0])), Math.max(...known.map((t) => t[t.length - 1]))];
    const [from, to] = range ?? whole;
    const panels = plot.panels.map((panel) => {
      const lines = panel.lines.map((one) => ({ label: one.label, colour: one.colour, dash: DASHES[one.style] ?? [], dots: one.style === ".", x: times[one.time], y: float32(one.values) }));
      const [low, high] = extent(lines.flatMap(({ x, y }) => y.filter((v, k) => v !== null && x[k] >= from && x[k] <= to)));
      const marks = [panel.limit, panel.limit === null ? null : -panel.limit, panel.floor].filter((v) => v !== null);
      return { label: panel.label, range: low > high ? [0, 1] : limits(panel, low, high), marks, band: panel.band, words: panel.told, lines };
    });
    return { xLabel: TIME_LABEL, from, to, instants, panels };
  }

  function offer(figure, plot) {
    const name = figure.id || figure.querySelector("h3").innerText.toLowerCase().replace(/[^a-z0-9]+/g, "-");
    const choices = plot.rows ? paper.CHOICES : [...paper.CHOICES, ["csv", "CSV, the data"]];
    figure.querySelector("figcaption").prepend(paper.menu(`Save the figure ${name}`, choices, (what) => paper.save(onPaper(plot), name, what)));
  }

  function make(figure) {
    const data = figure.querySelector("script");
    if (!data) return;
    const plot = JSON.parse(data.textContent);
    data.remove();
    (plot.rows ? barPlot : timePlot)(figure, plot);
    offer(figure, plot);
  }

  const figures = document.querySelectorAll("figure.plot");
  const near = new IntersectionObserver((seen) => seen.forEach((e) => e.isIntersecting && make(e.target)), { rootMargin: "800px" });
  figures.forEach((figure) => near.observe(figure));
  const resize = (width) => charts.forEach(({ chart }) => chart.setSize({ width: width ?? chart.root.parentElement.clientWidth, height: chart.height }));
  addEventListener("beforeprint", () => {
    figures.forEach(make);
    resize(PRINTED_PX);
  });
  addEventListener("afterprint", () => resize());
  document.querySelectorAll("figure > svg").forEach(zoomable);
  paper.tables();
  document.querySelectorAll("[data-time]").forEach((row) => row.addEventListener("click", () => {
    const at_s = Number(row.dataset.time);
    zoom(at_s - 3, at_s + 3);
  }));
  const told = document.querySelector(".events"), fault = told?.querySelector(".bad");
  if (fault) told.scrollTop = fault.offsetTop - told.offsetTop - told.clientHeight / 2;
  document.getElementById("whole")?.addEventListener("click", () => zoom(null));
  addEventListener("keydown", (event) => { if (event.key === "Escape") zoom(null); });
})();
