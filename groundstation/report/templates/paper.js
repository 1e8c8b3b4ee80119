// Figures and tables for a paper: every plot as PDF, SVG or PNG at one or two columns' width, every table as CSV or LaTeX.
// Drawn anew from the data, with axes that name quantity and unit; nothing leaves the page.
"use strict";
(() => {
  const COLUMN_PT = { 1: 252, 2: 520 }; // 3.5 in and 7.2 in: the widths of most journals
  const FONT = 8, SMALL = 7, INK = "#000000", GREY = "#767676", GRID = "#e6e6e6", BAND = "#ececec", FACE = "Helvetica, Arial, sans-serif";
  const PNG_DPI = 600, LEFT = 44, RIGHT = 6, BOTTOM = 30, GAP = 8, ROW = 11;
  const measure = document.createElement("canvas").getContext("2d");

  function width(text, size) {
    measure.font = `${size}px ${FACE}`;
    return measure.measureText(text).width;
  }

  /** Round values between two limits, about `most` of them. */
  function ticks(low, high, most) {
    const rough = (high - low) / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough) ?? 10 * power;
    const found = [];
    for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(+(k * step).toPrecision(12));
    return found;
  }

  const line = (points, stroke, w = 0.6, dash = []) => ({ points, stroke, w, dash });
  const text = (s, x, y, more = {}) => ({ text: s, x, y, size: FONT, anchor: "middle", colour: INK, angle: 0, ...more });

  /** A legend in rows above everything. Returns its items and its height. */
  function legend(entries, total) {
    const items = [];
    let [x, y] = [LEFT, ROW];
    for (const { label, colour, dash, fill } of entries) {
      const needs = 18 + width(label, SMALL) + 8;
      if (x + needs > total && x > LEFT) [x, y] = [LEFT, y + ROW];
      items.push(fill ? { points: [[x, y - 6], [x + 12, y - 6], [x + 12, y], [x, y]], fill: colour } : line([[x, y - 3], [x + 14, y - 3]], colour, 1.2, dash));
      items.push(text(label, x + 18, y, { anchor: "start", size: SMALL }));
      x += needs;
    }
    return [items, entries.length ? y + 6 : 6];
  }

  function limits(values, wish) {
    if (wish) return wish;
    let [low, high] = [Infinity, -Infinity];
    for (const v of values) if (v !== null && Number.isFinite(v)) [low, high] = [Math.min(low, v), Math.max(high, v)];
    if (low > high) return [0, 1];
    const pad = high > low ? 0.05 * (high - low) : Math.abs(high) * 0.1 || 1;
    return [low - pad, high + pad];
  }

  function unique(lines) {
    return [...new Map(lines.filter((l) => l.label).map((l) => [l.label, l])).values()];
  }

  /** Vertical lines that are in sight, at instants: [{at, label, colour, dash}]. */
  const inSight = (drawing) => (drawing.instants ?? []).filter(({ at }) => at > drawing.from && at < drawing.to);

  function instants(drawing, x, y0, y1) {
    return inSight(drawing).map(({ at, colour, dash }) => line([[x(at), y0], [x(at), y1]], colour, 0.6, dash));
  }

  /** A drawing {xLabel, from, to, instants, panels: [{label, range, marks, band, words, lines: [{label, colour, dash, dots, x, y}]}]} as items. */
  function layout(drawing, columns) {
    const total = COLUMN_PT[columns], [items, top] = legend(unique([...drawing.panels.flatMap((p) => p.lines), ...inSight(drawing)]), total - RIGHT);
    const tall = Math.min(130, 0.42 * total), right = total - RIGHT;
    const x = (v) => LEFT + ((v - drawing.from) / (drawing.to - drawing.from)) * (right - LEFT);
    let y0 = top;
    drawing.panels.forEach((panel, k) => {
      const [low, high] = limits(panel.lines.flatMap((l) => l.y), panel.range), y1 = y0 + tall;
      const y = (v) => y1 - ((v - low) / (high - low)) * tall;
      const grounds = items.length;
      for (const at of ticks(drawing.from, drawing.to, columns === 1 ? 5 : 9)) {
        items.push(line([[x(at), y0], [x(at), y1]], GRID));
        if (k === drawing.panels.length - 1) items.push(text(String(at), x(at), y1 + 10, { size: SMALL }));
      }
      for (const at of ticks(low, high, 4)) {
        items.push(line([[LEFT, y(at)], [right, y(at)]], GRID), text(String(at).replace("-", "−"), LEFT - 4, y(at) + 2.5, { anchor: "end", size: SMALL }));
      }
      if (panel.band) {
        const [a, b] = panel.band.map((v) => y(Math.min(Math.max(v, low), high)));
        items.splice(grounds, 0, { points: [[LEFT, a], [right, a], [right, b], [LEFT, b]], fill: BAND });
      }
      items.push(...instants(drawing, x, y0, y1));
      for (const mark of panel.marks ?? []) if (mark > low && mark < high) items.push(line([[LEFT, y(mark)], [right, y(mark)]], GREY, 0.7, [4, 3]));
      for (const one of panel.lines) {
        let run = [];
        const flush = () => (run.length > 1 && items.push(line(run, one.colour, 1, one.dash)), (run = []));
        one.x.forEach((at, i) => {
          const v = one.y[i];
          if (v === null || v === undefined || !Number.isFinite(v) || at < drawing.from || at > drawing.to) return flush();
          if (one.dots) items.push({ points: [[x(at) - 0.6, y(v) - 0.6], [x(at) + 0.6, y(v) - 0.6], [x(at) + 0.6, y(v) + 0.6], [x(at) - 0.6, y(v) + 0.6]], fill: one.colour });
          else run.push([x(at), Math.min(Math.max(y(v), y0), y1)]);
        });
        flush();
      }
      items.push(line([[LEFT, y0], [LEFT, y1], [right, y1]], GREY), text(panel.label, 8, (y0 + y1) / 2, { angle: -90 }));
      if (panel.words) items.push(text(panel.words, right - 2, y0 + SMALL, { anchor: "end", size: SMALL, colour: GREY }));
      y0 = y1 + GAP;
    });
    items.push(text(drawing.xLabel, (LEFT + right) / 2, y0 + BOTTOM - 14));
    return { items, width: total, height: y0 + BOTTOM - GAP };
  }

  /** Bars {xLabel, from, to, instants, rows: [[name, [{begin_s, length_s, colour, label}]]]} as items. */
  function bars(drawing, columns) {
    const total = COLUMN_PT[columns], left = 8 + Math.max(...drawing.rows.map(([name]) => width(name, SMALL))) + 4, right = total - RIGHT;
    const filled = unique(drawing.rows.flatMap(([, all]) => all)).map((bar) => ({ ...bar, fill: true }));
    const [items, top] = legend([...filled, ...unique(inSight(drawing))], right);
    const x = (v) => left + ((Math.min(Math.max(v, drawing.from), drawing.to) - drawing.from) / (drawing.to - drawing.from)) * (right - left);
    const bottom = top + 16 * drawing.rows.length;
    for (const at of ticks(drawing.from, drawing.to, columns === 1 ? 5 : 9)) items.push(line([[x(at), top], [x(at), bottom]], GRID), text(String(at), x(at), bottom + 10, { size: SMALL }));
    drawing.rows.forEach(([name, all], k) => {
      const [y0, y1] = [top + 16 * k + 2, top + 16 * k + 14];
      items.push(text(name, left - 4, y1 - 3, { anchor: "end", size: SMALL }));
      for (const bar of all) {
        const [a, b] = [x(bar.begin_s), Math.max(x(bar.begin_s + bar.length_s), x(bar.begin_s) + 0.3)];
        items.push({ points: [[a, y0], [b, y0], [b, y1], [a, y1]], fill: bar.colour });
      }
    });
    items.push(...instants(drawing, x, top, bottom), line([[left, bottom], [right, bottom]], GREY), text(drawing.xLabel, (left + right) / 2, bottom + BOTTOM - 8));
    return { items, width: total, height: bottom + BOTTOM };
  }

  /** A picture that is SVG already, as items. Beside what is shown a page has it as drawn for the other width, in a template. */
  function ofSvg(shown, columns) {
    const other = shown.parentElement.querySelector(`:scope > template[data-columns="${columns}"]`);
    if (!other) return outlines(shown, columns);
    const host = document.body.appendChild(Object.assign(document.createElement("div"), { style: "position: absolute; left: -9999px; width: 1000px" }));
    host.append(other.content.cloneNode(true));
    const items = outlines(host.querySelector("svg"), columns);
    host.remove();
    return items;
  }

  /** Outlines are followed point by point, text stays text. */
  function outlines(svg, columns) {
    const box = svg.viewBox.baseVal, by = COLUMN_PT[columns] / box.width, items = [];
    const home = svg.getScreenCTM().inverse();
    const place = (matrix, p) => {
      const q = new DOMPoint(p.x, p.y).matrixTransform(home.multiply(matrix));
      return [(q.x - box.x) * by, (q.y - box.y) * by];
    };
    const seen = (value) => (value && value !== "none" && value !== "transparent" ? hex(value) : null);
    for (const node of svg.querySelectorAll("path, use, text")) {
      if (node.closest("defs, clipPath")) continue;
      const style = getComputedStyle(node), matrix = node.getScreenCTM();
      if (node.tagName === "text") {
        const { a, b } = home.multiply(matrix), spans = [...node.querySelectorAll("tspan")]; // a power of ten is several, each with its place
        for (const part of spans.length ? spans : [node]) {
          const look = getComputedStyle(part), at = part.x.baseVal.length ? { x: part.x.baseVal[0].value, y: part.y.baseVal[0].value } : { x: 0, y: 0 };
          const [x, y] = place(matrix, at), size = parseFloat(look.fontSize) * Math.hypot(a, b) * by;
          items.push(text(part.textContent.trim(), x, y, { size, anchor: look.textAnchor, colour: seen(look.fill) ?? INK, angle: (Math.atan2(b, a) * 180) / Math.PI }));
        }
        continue;
      }
      const target = node.tagName === "use" ? svg.querySelector(node.getAttribute("href") ?? node.getAttribute("xlink:href")) : node;
      if (!(target instanceof SVGGeometryElement)) continue;
      const moved = node.tagName === "use" ? matrix.translate(node.x.baseVal.value, node.y.baseVal.value) : matrix;
      const own = (name) => (node !== target && !target.style.getPropertyValue(name) && !target.hasAttribute(name) ? style : getComputedStyle(target)).getPropertyValue(name); // what a copied outline does not say itself comes from its copy
      const [stroke, fill] = [seen(own("stroke")), seen(own("fill"))];
      const opacity = Number(style.opacity || 1) * Number(own(fill ? "fill-opacity" : "stroke-opacity") || 1);
      for (const part of (target.getAttribute("d") ?? "").split(/(?=M)/).filter((d) => d.trim())) {
        const one = document.createElementNS("http://www.w3.org/2000/svg", "path");
        one.setAttribute("d", part);
        const long = one.getTotalLength(), least = /[acqs]/i.test(part) ? 24 : 1; // a small dot is round, too
        const steps = Math.min(Math.max(Math.ceil(long / 1.5), least), 4000);
        const points = Array.from({ length: steps + 1 }, (_, k) => place(moved, one.getPointAtLength((long * k) / steps)));
        const dashes = own("stroke-dasharray");
        const dash = (dashes === "none" ? "" : dashes).split(/[ ,]+/).map(parseFloat).filter((d) => d > 0).map((d) => d * by);
        items.push({ points, stroke, fill, w: parseFloat(own("stroke-width") || "1") * by, dash, opacity });
      }
    }
    return { items, width: COLUMN_PT[columns], height: box.height * by };
  }

  function hex(colour) {
    measure.fillStyle = colour;
    const known = measure.fillStyle;
    return known.startsWith("#") ? known : `#${known.match(/\d+/g).slice(0, 3).map((v) => Number(v).toString(16).padStart(2, "0")).join("")}`;
  }

  const num = (v) => String(Math.round(v * 100) / 100);
  const clean = (s) => s.replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/"/g, "&quot;");

  function asSvg({ items, width: w, height: h }) {
    const parts = items.map((item) => {
      if (item.text !== undefined) {
        const turn = item.angle ? ` transform="rotate(${num(item.angle)} ${num(item.x)} ${num(item.y)})"` : "";
        return `<text x="${num(item.x)}" y="${num(item.y)}" font-size="${num(item.size)}" text-anchor="${item.anchor}" fill="${item.colour}"${turn}>${clean(item.text)}</text>`;
      }
      const d = item.points.map(([x, y], k) => `${k ? "L" : "M"}${num(x)} ${num(y)}`).join("");
      const dash = item.dash?.length ? ` stroke-dasharray="${item.dash.map(num).join(" ")}"` : "";
      const faint = item.opacity !== undefined && item.opacity < 1 ? ` opacity="${num(item.opacity)}"` : "";
      return `<path d="${d}${item.fill ? "Z" : ""}" fill="${item.fill ?? "none"}"${item.stroke ? ` stroke="${item.stroke}" stroke-width="${num(item.w)}"${dash}` : ""}${faint}/>`;
    });
    return `<svg xmlns="http://www.w3.org/2000/svg" width="${num(w)}pt" height="${num(h)}pt" viewBox="0 0 ${num(w)} ${num(h)}" font-family="${FACE}">\n${parts.join("\n")}\n</svg>\n`;
  }

  // of Helvetica, which every reader of PDF has: widths of the characters from the space to the tilde, in thousandths of the size
  const HELVETICA = ("278 278 355 556 556 889 667 191 333 333 389 584 278 333 278 278 556 556 556 556 556 556 556 556 556 556 278 278 584 584 584 556 1015 " +
    "667 667 722 722 667 611 778 722 278 500 667 556 833 722 778 667 778 722 667 611 722 667 944 667 667 611 278 278 278 469 556 333 " +
    "556 556 500 556 556 278 556 556 222 222 500 222 833 556 556 556 556 333 500 278 556 500 722 500 500 500 334 260 334 584").split(" ").map(Number);
  const helvetica = (s, size) => Array.from(s, (c) => HELVETICA[c.charCodeAt(0) - 32] ?? 556).reduce((a, b) => a + b, 0) * size * 1e-3;

  function asPdf({ items, width: w, height: h }) {
    const rgb = (colour, faint = 1) => [1, 3, 5].map((k) => num(1 - faint * (1 - parseInt(colour.slice(k, k + 2), 16) / 255))).join(" ");
    const latin = { "−": "-", "–": "-", "—": "-", "…": "...", "“": '"', "”": '"', "×": "\xd7" };
    const say = (s) => Array.from(s, (c) => latin[c] ?? (c.charCodeAt(0) < 256 ? c : "?")).join("").replace(/[\\()]/g, "\\$&");
    const body = items.map((item) => {
      if (item.text !== undefined) {
        const angle = (-item.angle * Math.PI) / 180, [c, s] = [Math.cos(angle), Math.sin(angle)];
        const back = { start: 0, middle: 0.5, end: 1 }[item.anchor] * helvetica(item.text, item.size);
        return `BT ${rgb(item.colour)} rg /F1 ${num(item.size)} Tf ${num(c)} ${num(s)} ${num(-s)} ${num(c)} ${num(item.x - back * c)} ${num(h - item.y - back * s)} Tm (${say(item.text)}) Tj ET`;
      }
      const way = item.points.map(([x, y], k) => `${num(x)} ${num(h - y)} ${k ? "l" : "m"}`).join(" ");
      const paint = item.fill && item.stroke ? "b" : item.fill ? "f" : "S";
      if (!item.fill && !item.stroke) return "";
      const pen = item.stroke ? `${rgb(item.stroke, item.opacity)} RG ${num(item.w)} w [${(item.dash ?? []).map(num).join(" ")}] 0 d ` : "";
      return `${item.fill ? `${rgb(item.fill, item.opacity)} rg ` : ""}${pen}${way} ${paint}`;
    }).join("\n");
    const objects = [
      "<< /Type /Catalog /Pages 2 0 R >>",
      "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
      `<< /Type /Page /Parent 2 0 R /MediaBox [0 0 ${num(w)} ${num(h)}] /Resources << /Font << /F1 5 0 R >> >> /Contents 4 0 R >>`,
      `<< /Length ${body.length} >>\nstream\n${body}\nendstream`,
      "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ];
    let [file, at] = ["%PDF-1.4\n", []];
    objects.forEach((object, k) => {
      at.push(file.length);
      file += `${k + 1} 0 obj\n${object}\nendobj\n`;
    });
    const table = at.map((offset) => `${String(offset).padStart(10, "0")} 00000 n \n`).join("");
    file += `xref\n0 ${objects.length + 1}\n0000000000 65535 f \n${table}trailer\n<< /Size ${objects.length + 1} /Root 1 0 R >>\nstartxref\n${file.length}\n%%EOF\n`;
    return Uint8Array.from(file, (c) => c.charCodeAt(0));
  }

  function asPng({ items, width: w, height: h }) {
    const by = PNG_DPI / 72, canvas = Object.assign(document.createElement("canvas"), { width: Math.round(w * by), height: Math.round(h * by) });
    const pen = canvas.getContext("2d");
    pen.scale(by, by);
    pen.fillStyle = "#ffffff";
    pen.fillRect(0, 0, w, h);
    for (const item of items) {
      pen.save();
      pen.globalAlpha = item.opacity ?? 1;
      if (item.text !== undefined) {
        pen.font = `${item.size}px ${FACE}`;
        pen.textAlign = { start: "left", middle: "center", end: "right" }[item.anchor];
        pen.fillStyle = item.colour;
        pen.translate(item.x, item.y);
        pen.rotate((item.angle * Math.PI) / 180);
        pen.fillText(item.text, 0, 0);
      } else {
        pen.beginPath();
        item.points.forEach(([x, y]) => pen.lineTo(x, y));
        if (item.fill) (pen.fillStyle = item.fill), pen.fill();
        if (item.stroke) [pen.strokeStyle, pen.lineWidth] = [item.stroke, item.w], pen.setLineDash(item.dash ?? []), pen.stroke();
      }
      pen.restore();
    }
    return new Promise((done) => canvas.toBlob(async (png) => done(await withResolution(png)), "image/png"));
  }

  /** A PNG that says how many dots it has for an inch, behind its head of 33 bytes: else programs take 72 or 96, and print it larger. */
  async function withResolution(png) {
    const chunk = new DataView(new ArrayBuffer(21)), per_m = Math.round(PNG_DPI / 0.0254);
    chunk.setUint32(0, 9);
    "pHYs".split("").forEach((c, k) => chunk.setUint8(4 + k, c.charCodeAt(0)));
    chunk.setUint32(8, per_m);
    chunk.setUint32(12, per_m);
    chunk.setUint8(16, 1);
    let crc = 0xffffffff;
    for (let k = 4; k < 17; k++) {
      crc ^= chunk.getUint8(k);
      for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
    }
    chunk.setUint32(17, ~crc >>> 0);
    return new Blob([png.slice(0, 33), chunk.buffer, png.slice(33)], { type: "image/png" });
  }

  function download(content, type, name) {
    const url = URL.createObjectURL(content instanceof Blob ? content : new Blob([content], { type }));
    Object.assign(document.createElement("a"), { href: url, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(url), 10_000);
  }

  function csvOf(rows) {
    return rows.map((row) => row.map((cell) => (/[",\n]/.test(cell) ? `"${cell.replace(/"/g, '""')}"` : cell)).join(",")).join("\n") + "\n";
  }

  /** The data of a drawing: a column of time and a value column for each line, by panel. */
  function dataOf(drawing) {
    const lines = (drawing.panels ?? []).flatMap((panel) => panel.lines.map((one) => [`${one.label || "value"}: ${panel.label}`, one]));
    const rows = [lines.flatMap(([name]) => [drawing.xLabel, name])];
    const said = (v) => (v === null || v === undefined ? "" : `${+v.toPrecision(7)}`); // a report holds them to 24 bits: more digits are none
    for (let k = 0; k < Math.max(0, ...lines.map(([, one]) => one.x.length)); k++) rows.push(lines.flatMap(([, { x, y }]) => [said(x[k]), said(y[k])]));
    return csvOf(rows);
  }

  /** Save a drawing, or a picture that is SVG, under a name. `what`: pdf-1, svg-2, png-1, csv, ... */
  async function save(drawing, name, what) {
    const [format, columns] = what.split("-");
    name = name.replace(/[^\w-]+/g, "-").replace(/-$/, ""); // LaTeX takes no other
    if (format === "csv") return download(dataOf(drawing), "text/csv", `${name}.csv`);
    const placed = drawing instanceof SVGElement ? ofSvg(drawing, Number(columns)) : drawing.rows ? bars(drawing, Number(columns)) : layout(drawing, Number(columns));
    const file = `${name}-${columns}col.${format}`;
    if (format === "svg") download(asSvg(placed), "image/svg+xml", file);
    else if (format === "pdf") download(asPdf(placed), "application/pdf", file);
    else download(await asPng(placed), "image/png", file);
  }

  const CHOICES = [["pdf-1", "PDF, one column"], ["pdf-2", "PDF, two columns"], ["svg-1", "SVG, one column"], ["svg-2", "SVG, two columns"], ["png-1", "PNG, one column"], ["png-2", "PNG, two columns"]];

  /** A menu that saves what `drawing()` gives. */
  function menu(label, choices, chosen) {
    const select = Object.assign(document.createElement("select"), { className: "save-as" });
    select.setAttribute("aria-label", label);
    for (const [value, shown] of [["", "Save …"], ...choices]) select.append(new Option(shown, value));
    select.addEventListener("change", () => {
      const what = select.value;
      select.value = "";
      if (what) chosen(what);
    });
    return select;
  }

  const cells = (row) => [...row.cells].flatMap((cell) => [cell.innerText.replace(/\s+/g, " ").trim(), ...Array(Math.max(cell.colSpan - 1, 0)).fill("")]);

  const TEX = { "&": "\\&", "%": "\\%", "#": "\\#", _: "\\_", $: "\\$", "{": "\\{", "}": "\\}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "\\": "\\textbackslash{}", "±": "$\\pm$", "×": "$\\times$", "Δ": "$\\Delta$", "–": "--", "—": "---", "°": "$^{\\circ}$", "µ": "$\\mu$", "✓": "$\\checkmark$", "✗": "$\\times$", "≤": "$\\le$", "≥": "$\\ge$", "²": "$^2$", "−": "$-$", "→": "$\\to$", "…": "\\dots{}", "<": "$<$", ">": "$>$", "|": "$|$" };
  const LONG = 48; // characters of a cell that gets lines
  const tex = (s) => Array.from(s, (c) => TEX[c] ?? c).join("");

  /** A table as LaTeX, with the packages that it needs: numbers at the right, texts at the left, long ones in lines of their own. */
  function latexOf(table) {
    const said = (cell) => tex(cell.innerText.replace(/\s+/g, " ").trim()).replace(/^\[/, "{[}"); // after a row's end it would be a length
    const row = (one) => [...one.cells].map((cell) => (cell.colSpan > 1 ? `\\multicolumn{${cell.colSpan}}{c}{${said(cell)}}` : said(cell))).join(" & ") + " \\\\";
    const [head, body] = [[...(table.tHead?.rows ?? [])], [...table.tBodies].flatMap((part) => [...part.rows])];
    const count = Math.max(...[...head, ...body].map((one) => cells(one).length));
    const cellsOf = (k) => body.map((one) => one.cells[k]).filter((cell) => cell), isLong = (k) => cellsOf(k).some((cell) => cell.innerText.length > LONG);
    const long = Array.from({ length: count }, (_, k) => isLong(k)).filter((one) => one).length;
    const column = (k) => {
      const all = cellsOf(k);
      if (isLong(k)) return `p{${num(0.6 / long)}\\linewidth}`;
      return all.every((cell) => /left|start/.test(getComputedStyle(cell).textAlign)) ? "l" : "r";
    };
    const rows = [...head.map(row), "\\midrule", ...body.map(row)];
    const packages = ["booktabs", ...(rows.some((one) => one.includes("\\checkmark")) ? ["amssymb"] : [])];
    return [`% \\usepackage{${packages.join(",")}}`, `\\begin{tabular}{${Array.from({ length: count }, (_, k) => column(k)).join("")}}`, "\\toprule", ...rows, "\\bottomrule", "\\end{tabular}", ""].join("\n");
  }

  function named(table) {
    if (table.id) return table.id;
    let node = table;
    while (node && node !== document.body) {
      for (let before = node.previousElementSibling; before; before = before.previousElementSibling) {
        if (/^H[123]$/.test(before.tagName)) return before.innerText.toLowerCase().replace(/[^a-z0-9]+/g, "-").replace(/^-|-$/g, "");
      }
      node = node.parentElement;
    }
    return "table";
  }

  /** Give every table of a page its menu. */
  function tables() {
    for (const table of document.querySelectorAll("main table")) {
      if (table.closest(".u-legend, figure") || table.rows.length < 2) continue;
      const name = named(table);
      table.before(menu(`Save the table ${name}`, [["csv", "CSV"], ["tex", "LaTeX"]], (what) => {
        const all = [...table.rows].map(cells);
        download(what === "csv" ? csvOf(all) : latexOf(table), what === "csv" ? "text/csv" : "application/x-tex", `${name}.${what}`);
      }));
    }
    for (const svg of document.querySelectorAll("main :is(figure, .card) > svg")) {
      const name = svg.closest("figure")?.id || named(svg);
      svg.before(menu(`Save the figure ${name}`, CHOICES, (what) => save(svg, name, what)));
    }
  }

  window.paper = { save, menu, tables, CHOICES };
})();
