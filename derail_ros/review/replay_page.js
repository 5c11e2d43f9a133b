"use strict";
(() => {
  const $ = (id) => document.getElementById(id);
  const data = JSON.parse($("data").textContent);
  const cars = data.cars, N = cars.length;
  const reduced = matchMedia("(prefers-reduced-motion: reduce)");
  const RUPTURE = 5e6, CONSERVATIVE = 10e6, GAUGE = 1.435;
  const FADE = 1.5;  // s of recorded time for which a collision stays marked

  // --- recorded states ------------------------------------------------------------------------

  let T = 0, time, series = {};

  async function unpack() {
    if (typeof DecompressionStream === "undefined") {
      throw new Error("This browser is too old for the replay: it cannot unpack the recording.");
    }
    const text = atob(data.blob);
    const packed = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    let at = 0;
    for (const part of data.parts) {
      const count = part.rows * part.columns, width = part.bytes;
      const out = new Float64Array(count);
      const limit = 2 ** (8 * width - 1), full = 2 ** (8 * width);
      const whole = new Float64Array(count);
      for (let b = 0; b < width; b++) {  // the bytes lie plane by plane
        const scale = 2 ** (8 * b);
        for (let i = 0; i < count; i++) whole[i] += bytes[at + b * count + i] * scale;
      }
      for (let c = 0; c < part.columns; c++) {
        let value = 0, rate = 0;
        for (let r = 0; r < part.rows; r++) {
          const i = r * part.columns + c;
          const change = whole[i] >= limit ? whole[i] - full : whole[i];
          if (part.order === 2) { rate += change; value += rate; }
          else if (part.order === 1) value += change;
          else value = change;
          out[i] = value * part.scale;
        }
      }
      at += width * count;
      series[part.name] = out;
    }
    time = series.time;
    T = time.length;
  }

  let now = 0, lower = 0, weight = 0;

  function locate(t) {
    let a = 0, b = T - 1;
    while (b - a > 1) { const m = (a + b) >> 1; if (time[m] <= t + 1e-9) a = m; else b = m; }
    if (T > 1 && time[b] <= t + 1e-9) a = b;
    return a;
  }

  function setTime(t) {
    now = Math.min(Math.max(t, time[0]), time[T - 1]);
    lower = locate(now);
    const next = Math.min(lower + 1, T - 1), span = time[next] - time[lower];
    weight = span > 0 ? Math.min(1, (now - time[lower]) / span) : 0;
  }

  function value(name, car) {
    const s = series[name], a = s[lower * N + car];
    return weight === 0 ? a : a + weight * (s[Math.min(lower + 1, T - 1) * N + car] - a);
  }

  const off = (car, end) => data.off[car][end] !== null && data.off[car][end] <= now + 1e-9;
  const derailed = (car) => off(car, 0) || off(car, 1);
  const parted = (car) => car < 0 || car >= N - 1 || (data.parted[car] !== null && data.parted[car] <= now + 1e-9);
  const loose = (car) => derailed(car) && parted(car - 1) && parted(car);
  const state = (car) => !derailed(car) ? 0 : loose(car) ? 2 : 1;

  const peaks = Array.from({length: N}, () => []);
  for (const c of data.contacts) {
    peaks[c.a - 1]?.push([c.peakTime, c.peak, c.b]);
    peaks[c.b - 1]?.push([c.peakTime, c.peak, c.a]);
  }
  function peakSoFar(car) {
    let best = [null, 0, 0];
    for (const p of peaks[car]) if (p[0] <= now + 1e-9 && p[1] > best[1]) best = p;
    return best;
  }

  // --- words ----------------------------------------------------------------------------------

  const seconds = (t, digits = 2) => `${t.toFixed(digits)} s`;
  const force = (f) => f >= 0.95e6 ? `${(f * 1e-6).toFixed(1)} MN` : `${(f * 1e-3).toFixed(0)} kN`;
  const speedText = (v) => `${v.toFixed(1)} m/s (${(v * 3.6).toFixed(0)} km/h)`;
  const STATES = ["on the rails", "derailed, coupled", "derailed, uncoupled"];
  const LEVELS = ["not struck", "below 5 MN", "5 to 10 MN", "above 10 MN"];
  const level = (f) => f <= 0 ? 0 : f < RUPTURE ? 1 : f < CONSERVATIVE ? 2 : 3;

  function make(tag, text, attributes) {
    const element = document.createElement(tag);
    if (text !== undefined && text !== null) element.textContent = text;
    for (const [k, v] of Object.entries(attributes || {})) element.setAttribute(k, v);
    return element;
  }

  // --- colours --------------------------------------------------------------------------------

  const PALETTES = {
    light: {
      bg: "#ffffff", ink: "#1b1e22", subtle: "#565e68", rail: "#8c939b", tie: "#ddd8d0", grid: "#dfe3e7",
      state: ["#d8dce1", "#7cc3ee", "#f0b13c"], level: ["#e9ebee", "#9ecae9", "#f0b13c", "#d55e00"],
      hatch: "rgba(20,24,28,0.55)", edge: "#1b1e22", mark: "#c94f00", halo: "#ffffff", box: "#005a8f", select: "#005a8f",
      lines: "rgba(90,98,108,0.30)", panel: "#f4f5f7",
      energy: ["#d8dce1", "#56b4e9", "#e69f00", "#f0e442", "#d55e00", "#cc79a7"],
    },
    dark: {
      bg: "#121519", ink: "#e9ecef", subtle: "#a9b2bc", rail: "#7d858e", tie: "#37342f", grid: "#343a42",
      state: ["#525b66", "#2f87bd", "#c98a17"], level: ["#3f464f", "#3d7ca3", "#c98a17", "#d2570a"],
      hatch: "rgba(8,10,12,0.60)", edge: "#e9ecef", mark: "#ff8a45", halo: "#121519", box: "#6cbcf0", select: "#6cbcf0",
      lines: "rgba(169,178,188,0.28)", panel: "#1c2026",
      energy: ["#525b66", "#2f87bd", "#c98a17", "#b9ae23", "#c4520b", "#a75c85"],
    },
  };
  let palette = PALETTES.light;

  // Hatches, so that nothing is told by colour alone: none, lines, dots, cross lines.
  function pattern(context, fill, kind) {
    if (!kind) return fill;
    const tile = document.createElement("canvas"), size = 8 * ratio;
    tile.width = tile.height = size;
    const p = tile.getContext("2d");
    p.fillStyle = fill; p.fillRect(0, 0, size, size);
    p.strokeStyle = p.fillStyle = palette.hatch; p.lineWidth = ratio;
    const stroke = (x0, y0, x1, y1) => { p.beginPath(); p.moveTo(x0, y0); p.lineTo(x1, y1); p.stroke(); };
    if (kind === "lines" || kind === "cross") {
      stroke(0, size, size, 0); stroke(-1, 1, 1, -1); stroke(size - 1, size + 1, size + 1, size - 1);
    }
    if (kind === "cross") { stroke(0, 0, size, size); }
    if (kind === "dots") {
      for (const [x, y] of [[2, 2], [6, 6]]) { p.beginPath(); p.arc(x * ratio, y * ratio, 0.9 * ratio, 0, 7); p.fill(); }
    }
    return context.createPattern(tile, "repeat");
  }
  const STATE_HATCH = ["", "lines", "dots"], LEVEL_HATCH = ["", "", "lines", "cross"];
  let fills = null, ratio = 1;

  function makeFills(context) {
    fills = {
      state: palette.state.map((c, i) => pattern(context, c, STATE_HATCH[i])),
      force: palette.level.map((c, i) => pattern(context, c, LEVEL_HATCH[i])),
      plainState: palette.state, plainForce: palette.level,
    };
  }

  // --- the camera -----------------------------------------------------------------------------

  const scene = $("scene"), pen = scene.getContext("2d", {alpha: false});
  let width = 1, height = 1;
  const camera = {x: 0, y: 0, zoom: 5};  // metres in the middle, pixels a metre
  let followed = -1, view = "site", selected = 0;

  function fitWindow(w) {
    const top = 46, bottom = 18;  // room for the clock and for the label of the break
    const zoom = Math.min(60, width / (w[1] - w[0]), (height - top - bottom) / (w[3] - w[2]));
    Object.assign(camera, {x: (w[0] + w[1]) / 2, y: (w[2] + w[3]) / 2 + (top - bottom) / 2 / zoom, zoom});
  }

  function trainWindow() {
    let w = [Infinity, -Infinity, Infinity, -Infinity];
    for (let i = 0; i < N; i++) {
      const x = value("x", i), y = value("y", i), r = cars[i].length / 2 + 4;
      w = [Math.min(w[0], x - r), Math.max(w[1], x + r), Math.min(w[2], y - r), Math.max(w[3], y + r)];
    }
    return w;
  }

  function applyView(chosen) {
    view = chosen;
    followed = chosen.startsWith("car") ? Number(chosen.slice(3)) - 1 : -1;
    if (followed >= 0) {
      if (camera.zoom < 6) camera.zoom = Math.min(9, width / 80);
      select(followed);
    }
    if (chosen === "site") fitWindow(data.site);
    if (chosen === "train") fitWindow(trainWindow());
    $("view").value = chosen;
    $("follow").setAttribute("aria-pressed", String(followed >= 0 && followed === selected));
    dirty = true;
  }

  const free = () => { if (view !== "free") { view = "free"; followed = -1; $("view").value = "free"; $("follow").setAttribute("aria-pressed", "false"); } };

  function zoomBy(factor, px = width / 2, py = height / 2) {
    const mx = camera.x + (px - width / 2) / camera.zoom, my = camera.y - (py - height / 2) / camera.zoom;
    camera.zoom = Math.min(120, Math.max(0.05, camera.zoom * factor));
    if (followed < 0) {
      free();
      camera.x = mx - (px - width / 2) / camera.zoom;
      camera.y = my + (py - height / 2) / camera.zoom;
    }
    dirty = true;
  }

  function panBy(dx, dy) {
    free();
    camera.x -= dx / camera.zoom; camera.y += dy / camera.zoom; dirty = true;
  }

  // --- drawing the scene ----------------------------------------------------------------------

  const px = (x) => (x - camera.x) * camera.zoom + width / 2;
  const py = (y) => (camera.y - y) * camera.zoom + height / 2;

  function drawTrack() {
    const {x, y} = data.track;
    if (x.length < 2) return;
    const z = camera.zoom;
    const near = (i) => {
      const m = 60 / z + 30;
      const X = [Math.min(x[i], x[i + 1]), Math.max(x[i], x[i + 1])], Y = [Math.min(y[i], y[i + 1]), Math.max(y[i], y[i + 1])];
      const hw = width / 2 / z + m, hh = height / 2 / z + m;
      return X[0] < camera.x + hw && X[1] > camera.x - hw && Y[0] < camera.y + hh && Y[1] > camera.y - hh;
    };
    for (let i = 0; i + 1 < x.length; i++) {
      if (!near(i)) continue;
      const dx = x[i + 1] - x[i], dy = y[i + 1] - y[i], size = Math.hypot(dx, dy) || 1;
      const ux = dx / size, uy = dy / size, nx = -uy, ny = ux;
      if (z > 4) {
        const from = Math.max(0, (camera.x - width / z - x[i]) * ux + (camera.y - y[i]) * uy * (uy * uy > 0.5 ? 1 : 0));
        const start = size > 500 ? Math.max(0, Math.floor(from / 1.2) * 1.2) : 0;
        const stop = size > 500 ? Math.min(size, start + 2.5 * (width + height) / z) : size;
        pen.strokeStyle = palette.tie; pen.lineWidth = Math.max(1.5, 0.22 * z); pen.beginPath();
        for (let s = start; s < stop; s += 1.2) {
          const cx = x[i] + s * ux, cy = y[i] + s * uy;
          pen.moveTo(px(cx - 1.25 * nx), py(cy - 1.25 * ny)); pen.lineTo(px(cx + 1.25 * nx), py(cy + 1.25 * ny));
        }
        pen.stroke();
      }
    }
    pen.strokeStyle = palette.rail;
    for (const side of z * GAUGE > 3 ? [-0.5, 0.5] : [0]) {
      pen.lineWidth = z * GAUGE > 3 ? Math.max(1, 0.08 * z) : 1.2;
      pen.beginPath();
      for (let i = 0; i < x.length; i++) {
        const a = Math.max(0, i - 1), b = Math.min(x.length - 1, i + 1);
        const dx = x[b] - x[a], dy = y[b] - y[a], size = Math.hypot(dx, dy) || 1;
        const X = px(x[i] - side * GAUGE * dy / size), Y = py(y[i] + side * GAUGE * dx / size);
        if (i) pen.lineTo(X, Y); else pen.moveTo(X, Y);
      }
      pen.stroke();
    }
    for (const b of data.track.breaks) {
      if (b.time > now + 1e-9) continue;
      const nx = -Math.sin(b.heading), ny = Math.cos(b.heading), r = Math.max(2.6, 9 / z);
      pen.strokeStyle = palette.mark; pen.lineWidth = 3;
      pen.beginPath(); pen.moveTo(px(b.x - r * nx), py(b.y - r * ny)); pen.lineTo(px(b.x + r * nx), py(b.y + r * ny)); pen.stroke();
      const x = px(b.x);
      if (x < 0 || x > width || py(b.y) < 0 || py(b.y) > height) continue;
      pen.setLineDash([2, 4]); pen.lineWidth = 1;
      pen.beginPath(); pen.moveTo(x, py(b.y)); pen.lineTo(x, height - 24); pen.stroke(); pen.setLineDash([]);
      label(Math.min(Math.max(x, 36), width - 36), height - 14, "rail break", palette.mark, 12, "600");
    }
  }

  function label(x, y, text, colour, size, weightName = "700") {
    pen.font = `${weightName} ${size}px system-ui, "DejaVu Sans", sans-serif`;
    pen.textAlign = "center"; pen.textBaseline = "middle";
    pen.lineJoin = "round"; pen.lineWidth = Math.max(3, size / 3.5); pen.strokeStyle = palette.halo;
    pen.strokeText(text, x, y);
    pen.fillStyle = colour; pen.fillText(text, x, y);
  }

  function corners(i, x, y, yaw, grow = 0) {
    const c = Math.cos(yaw), s = Math.sin(yaw), l = cars[i].length / 2 + grow, w = cars[i].width / 2 + grow;
    return [[l, w], [l, -w], [-l, -w], [-l, w]].map(([a, b]) => [x + a * c - b * s, y + a * s + b * c]);
  }

  function drawCars() {
    const z = camera.zoom, detailed = z > 2.2;
    const scheme = $("colour").value;
    const set = scheme === "force" ? (detailed ? fills.force : fills.plainForce) : (detailed ? fills.state : fills.plainState);
    const shown = [];
    for (let i = 0; i < N; i++) {
      const x = value("x", i), y = value("y", i), reach = cars[i].length;
      const X = px(x), Y = py(y), m = reach * z;
      if (X < -m || X > width + m || Y < -m || Y > height + m) continue;
      shown.push([i, x, y, value("yaw", i), X, Y]);
    }
    if (z > 1.2) drawCouplers(shown);
    for (const [i, x, y, yaw] of shown) {
      const points = corners(i, x, y, yaw);
      const stands = cars[i].represents > 1;
      pen.beginPath();
      points.forEach(([a, b], k) => k ? pen.lineTo(px(a), py(b)) : pen.moveTo(px(a), py(b)));
      pen.closePath();
      const kind = scheme === "force" ? level(peakSoFar(i)[1]) : state(i);
      pen.fillStyle = stands ? palette.bg : set[kind];
      pen.fill();
      pen.setLineDash(stands ? [5, 4] : []);
      pen.strokeStyle = stands ? palette.subtle : palette.edge;
      pen.lineWidth = detailed ? 1.2 : 0.6;
      pen.stroke(); pen.setLineDash([]);
      if (detailed && !stands) {  // the dark end is the front
        const share = Math.min(0.7 / cars[i].length, 0.5);
        const [fl, fr, rr, rl] = points;
        const mix = (p, q) => [p[0] + share * (q[0] - p[0]), p[1] + share * (q[1] - p[1])];
        pen.beginPath();
        [fl, fr, mix(fr, rr), mix(fl, rl)].forEach(([a, b], k) => k ? pen.lineTo(px(a), py(b)) : pen.moveTo(px(a), py(b)));
        pen.closePath(); pen.fillStyle = palette.edge; pen.fill();
      }
    }
    for (const [i, x, y, yaw] of shown) {
      if (i !== selected || !chosenByUser) continue;
      const points = corners(i, x, y, yaw, Math.max(0.5, 3 / z));
      pen.beginPath();
      points.forEach(([a, b], k) => k ? pen.lineTo(px(a), py(b)) : pen.moveTo(px(a), py(b)));
      pen.closePath(); pen.strokeStyle = palette.select; pen.lineWidth = 3; pen.stroke();
    }
    const size = Math.min(15, Math.max(10, 1.7 * z));
    const pitch = (cars[0].length + 1) * z;
    const every = [1, 2, 5, 10, 20, 50, 100].find((e) => e * pitch > 30) || 200;
    const taken = [];
    for (const [i, , , , X, Y] of shown) {
      const important = i === selected && chosenByUser;
      if (cars[i].represents > 1) { if (pitch > 6) label(X, Y, `${cars[i].represents} cars`, palette.subtle, 11, "400"); continue; }
      if (!important && (i + 1) % every && i !== 0) continue;
      const text = String(i + 1), peak = scheme === "force" ? peakSoFar(i)[1] : 0;
      if (peak > 0.95e6 && z > 3) {
        label(X, Y - 0.55 * size, text, palette.ink, size);
        label(X, Y + 0.55 * size, (peak * 1e-6).toFixed(1), palette.ink, size * 0.8, "500");
      } else if (z >= 3) label(X, Y, text, palette.ink, size);
      else {  // beside a car that is smaller than its number: whole, and clear of the others
        const half = 0.35 * size * text.length + 1, x = Math.min(width - half, Math.max(half, X));
        if (!important && taken.some(([a, b, reach]) => Math.abs(a - x) < half + reach && Math.abs(b - Y) < size)) continue;
        taken.push([x, Y, half]);
        label(x, Y - 9, text, palette.ink, size);
      }
    }
  }

  function drawCouplers(shown) {
    const z = camera.zoom, at = new Map(shown.map((row) => [row[0], row]));
    const face = (row, end) => {
      const [i, x, y, yaw] = row, sign = end ? -1 : 1;
      const angle = value(end ? "beta" : "alpha", i), arm = cars[i].coupler[end];
      const hx = x + sign * cars[i].pivot * Math.cos(yaw), hy = y + sign * cars[i].pivot * Math.sin(yaw);
      return [hx, hy, hx + sign * arm * Math.cos(angle), hy + sign * arm * Math.sin(angle)];
    };
    pen.strokeStyle = palette.edge; pen.lineWidth = Math.min(4, Math.max(1, 0.28 * z));
    const crosses = [];
    for (const row of shown) {
      if (cars[row[0]].represents > 1) continue;
      for (const end of [0, 1]) {
        const [hx, hy, fx, fy] = face(row, end);
        pen.beginPath(); pen.moveTo(px(hx), py(hy)); pen.lineTo(px(fx), py(fy)); pen.stroke();
        const pair = end ? row[0] : row[0] - 1;
        if (pair < 0 || pair >= N - 1) continue;
        if (parted(pair)) crosses.push([px(fx), py(fy)]);
        else if (end) { pen.beginPath(); pen.arc(px(fx), py(fy), Math.max(1.5, 0.3 * z), 0, 7); pen.fillStyle = palette.edge; pen.fill(); }
      }
    }
    pen.strokeStyle = palette.mark; pen.lineWidth = 2;
    const r = Math.min(5, Math.max(2.5, 0.5 * z));
    for (const [x, y] of crosses) {
      pen.beginPath(); pen.moveTo(x - r, y - r); pen.lineTo(x + r, y + r); pen.moveTo(x - r, y + r); pen.lineTo(x + r, y - r); pen.stroke();
    }
  }

  // Marks appear and fade slowly and are small: nothing flashes.
  function drawCollisions() {
    const mode = $("marks").value;
    if (mode === "off") return;
    const marks = [];
    for (const c of data.contacts) {
      if (c.peak < 0.2e6 || c.peakTime > now + 1e-9) continue;
      const age = now - Math.max(c.peakTime, Math.min(c.end ?? c.peakTime, c.peakTime + 0.5));
      let strength = reduced.matches ? (age < FADE ? 1 : 0) : Math.min(1, Math.max(0, 1 - age / FADE));
      if (mode === "all") strength = Math.max(strength, 0.85);
      if (strength > 0) marks.push([c, strength, age < FADE]);
    }
    marks.sort((p, q) => p[0].peak - q[0].peak);
    const small = camera.zoom < 1.5 ? 0.6 : 1;
    for (const [c, strength, recent] of marks) {
      const r = small * (recent ? 1 : 0.6) * (6 + 11 * Math.sqrt(Math.min(1, c.peak / 25e6)));
      pen.globalAlpha = strength;
      star(px(c.x), py(c.y), r);
      pen.globalAlpha = 1;
    }
    const taken = [];
    for (const [c, strength] of marks.reverse()) {
      if (c.peak < 2e6 || strength < 0.3 || taken.length === 6) continue;
      const text = force(c.peak), x = Math.min(width - 36, Math.max(36, px(c.x))), y = py(c.y) - 24, box = [x - 34, y - 10, x + 34, y + 10];
      if (taken.some((t) => t[0] < box[2] && t[2] > box[0] && t[1] < box[3] && t[3] > box[1])) continue;
      taken.push(box);
      pen.globalAlpha = Math.min(1, 0.3 + strength); label(x, y, text, palette.mark, 14); pen.globalAlpha = 1;
    }
  }

  function star(x, y, r) {
    pen.beginPath();
    for (let k = 0; k < 16; k++) {
      const q = k % 2 ? 0.5 * r : r, a = k * Math.PI / 8;
      if (k) pen.lineTo(x + q * Math.cos(a), y + q * Math.sin(a)); else pen.moveTo(x + q, y);
    }
    pen.closePath(); pen.fillStyle = palette.mark; pen.fill();
    pen.strokeStyle = "#ffffff"; pen.lineWidth = 1.5; pen.stroke();
  }

  function drawScale() {
    const most = Math.min(220, width * 0.3) / camera.zoom;
    const power = 10 ** Math.floor(Math.log10(most));
    const bar = [5, 2, 1].map((m) => m * power).find((b) => b <= most) || power;
    const x1 = width - 16, x0 = x1 - bar * camera.zoom, y = 26;
    pen.fillStyle = palette.ink; pen.fillRect(x0, y, x1 - x0, 4);
    pen.fillStyle = palette.bg; pen.fillRect((x0 + x1) / 2, y + 1, (x1 - x0) / 2 - 1, 2);
    label((x0 + x1) / 2, y - 11, `${bar >= 1 ? bar : bar.toFixed(2)} m`, palette.ink, 12, "600");
    if (width <= 560) return;
    const [ux, uy] = travel(), cx = x1 - 14, cy = y + 20, half = 12;
    label(cx - half - 58, cy, "direction of travel", palette.subtle, 11, "400");
    const tip = [cx + half * ux, cy - half * uy];
    pen.strokeStyle = pen.fillStyle = palette.subtle; pen.lineWidth = 1.5;
    pen.beginPath(); pen.moveTo(cx - half * ux, cy + half * uy); pen.lineTo(cx + 0.6 * half * ux, cy - 0.6 * half * uy); pen.stroke();
    pen.beginPath(); pen.moveTo(...tip);
    for (const side of [-1, 1]) pen.lineTo(tip[0] - 8 * ux - side * 4 * uy, tip[1] + 8 * uy - side * 4 * ux);
    pen.closePath(); pen.fill();
  }

  // Along the track at the piece of it that is nearest to the middle of the view.
  function travel() {
    const {x, y} = data.track;
    let best = Infinity, way = [1, 0];
    for (let i = 0; i + 1 < x.length; i++) {
      const dx = x[i + 1] - x[i], dy = y[i + 1] - y[i], size = Math.hypot(dx, dy);
      if (!size) continue;
      const share = Math.min(1, Math.max(0, ((camera.x - x[i]) * dx + (camera.y - y[i]) * dy) / (size * size)));
      const apart = Math.hypot(x[i] + share * dx - camera.x, y[i] + share * dy - camera.y);
      if (apart < best) { best = apart; way = [dx / size, dy / size]; }
    }
    return way;
  }

  function drawScene() {
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.fillStyle = palette.bg; pen.fillRect(0, 0, width, height);
    if (followed >= 0) { camera.x = value("x", followed); camera.y = value("y", followed); }
    if (view === "train") fitWindow(trainWindow());
    if (!fills) makeFills(pen);
    drawTrack(); drawCars(); drawCollisions(); drawScale();
  }

  function legend() {
    const list = $("legend"), byForce = $("colour").value === "force";
    list.replaceChildren();
    const entry = (text, draw) => {
      const item = make("li"), swatch = document.createElement("canvas");
      swatch.width = 26 * ratio; swatch.height = 15 * ratio; swatch.setAttribute("aria-hidden", "true");
      const p = swatch.getContext("2d"); p.scale(ratio, ratio); draw(p);
      item.append(swatch, text); list.append(item);
    };
    const box = (fill, kind) => (p) => {
      p.setTransform(1, 0, 0, 1, 0, 0); p.fillStyle = pattern(p, fill, kind); p.fillRect(ratio, ratio, 24 * ratio, 13 * ratio);
      p.scale(ratio, ratio); p.strokeStyle = palette.edge; p.strokeRect(1, 1, 24, 13);
    };
    if (byForce) LEVELS.forEach((t, i) => entry(t, box(palette.level[i], LEVEL_HATCH[i])));
    else STATES.forEach((t, i) => entry(t, box(palette.state[i], STATE_HATCH[i])));
    entry("front", (p) => { p.fillStyle = palette.edge; p.fillRect(19, 1, 6, 13); p.strokeStyle = palette.edge; p.strokeRect(1, 1, 24, 13); });
    entry("parted", (p) => { p.strokeStyle = palette.mark; p.lineWidth = 2; p.beginPath(); p.moveTo(8, 3); p.lineTo(18, 13); p.moveTo(8, 13); p.lineTo(18, 3); p.stroke(); });
    entry("collision, by force", (p) => {
      p.beginPath();
      for (let k = 0; k < 16; k++) { const q = k % 2 ? 3.5 : 7, a = k * Math.PI / 8; p.lineTo(13 + q * Math.cos(a), 7.5 + q * Math.sin(a)); }
      p.closePath(); p.fillStyle = palette.mark; p.fill();
    });
  }

  // --- charts ---------------------------------------------------------------------------------

  const M = {left: 46, right: 12, top: 8, bottom: 22};

  class Chart {
    constructor(id, top, unit, paint, describe) {
      Object.assign(this, {canvas: $(id), top, unit, paint, describe, still: null});
      this.pen = this.canvas.getContext("2d");
      this.canvas.setAttribute("aria-label", describe());
      const seekHere = (event) => {
        const box = this.canvas.getBoundingClientRect();
        const share = (event.clientX - box.left - M.left) / (box.width - M.left - M.right);
        jump(time[0] + share * (time[T - 1] - time[0]), false);
      };
      this.canvas.addEventListener("pointerdown", (e) => { this.canvas.setPointerCapture(e.pointerId); seekHere(e); });
      this.canvas.addEventListener("pointermove", (e) => { if (e.buttons & 1) seekHere(e); });
      this.canvas.addEventListener("pointerup", () => announce());
      new ResizeObserver(() => { this.still = null; dirty = true; }).observe(this.canvas);
    }
    x(t) { return M.left + (t - time[0]) / Math.max(1e-9, time[T - 1] - time[0]) * (this.w - M.left - M.right); }
    y(v) { return this.h - M.bottom - v / this.top() * (this.h - M.top - M.bottom); }
    draw() {
      const w = this.canvas.clientWidth, h = this.canvas.clientHeight;
      if (!w) return;
      if (!this.still || this.w !== w || this.h !== h) {
        this.w = w; this.h = h;
        this.canvas.width = w * ratio; this.canvas.height = h * ratio;
        this.still = document.createElement("canvas");
        this.still.width = w * ratio; this.still.height = h * ratio;
        const p = this.still.getContext("2d");
        p.scale(ratio, ratio); this.axes(p); this.paint(this, p);
      }
      const p = this.pen;
      p.setTransform(1, 0, 0, 1, 0, 0); p.clearRect(0, 0, this.canvas.width, this.canvas.height);
      p.drawImage(this.still, 0, 0);
      p.setTransform(ratio, 0, 0, ratio, 0, 0);
      const x = this.x(now);
      p.strokeStyle = palette.ink; p.lineWidth = 1.5;
      p.beginPath(); p.moveTo(x, M.top); p.lineTo(x, h - M.bottom); p.stroke();
      p.fillStyle = palette.ink; p.beginPath(); p.moveTo(x - 5, M.top - 6); p.lineTo(x + 5, M.top - 6); p.lineTo(x, M.top + 2); p.fill();
    }
    axes(p) {
      const top = this.top();
      p.font = `11px system-ui, "DejaVu Sans", sans-serif`; p.lineWidth = 1;
      const step = nice(top / 4), digits = step < 1 ? (step < 0.1 ? 2 : 1) : 0;
      p.textAlign = "right"; p.textBaseline = "middle";
      for (let v = 0; v <= top * 1.0001; v += step) {
        p.strokeStyle = palette.grid; p.beginPath(); p.moveTo(M.left, this.y(v)); p.lineTo(this.w - M.right, this.y(v)); p.stroke();
        p.fillStyle = palette.subtle; p.fillText(v.toFixed(digits), M.left - 6, this.y(v));
      }
      p.textAlign = "center"; p.textBaseline = "top";
      const long = time[T - 1] - time[0], every = nice(long / 7);
      for (let t = Math.ceil(time[0] / every) * every; t <= time[T - 1]; t += every) {
        p.fillText(String(Math.round(t * 100) / 100), this.x(t), this.h - M.bottom + 5);
      }
      p.textAlign = "right"; p.fillText("s", this.w - 2, this.h - M.bottom + 5);
      p.textAlign = "left"; p.textBaseline = "top"; p.fillText(this.unit, 2, 0);
    }
  }

  function nice(raw) {
    const power = 10 ** Math.floor(Math.log10(Math.max(raw, 1e-9)));
    return [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999) || raw;
  }

  let charts = [];
  const at = (name, car, r) => series[name][r * N + car];

  function line(chart, p, get, rows) {
    p.beginPath();
    for (let k = 0; k < rows.length; k++) {
      const X = chart.x(time[rows[k]]), Y = chart.y(get(rows[k]));
      if (k) p.lineTo(X, Y); else p.moveTo(X, Y);
    }
    p.stroke();
  }

  function makeCharts() {
    const rows = [];
    for (let r = 0, step = Math.max(1, Math.floor(T / 700)); r < T; r += step) rows.push(r);
    if (rows[rows.length - 1] !== T - 1) rows.push(T - 1);
    let fastest = 1;
    for (const v of series.speed) if (v > fastest) fastest = v;
    const hardest = Math.max(12, ...data.contacts.map((c) => c.peak * 1e-6 * 1.1));
    const offTimes = data.off.map((o) => o[0] === null ? o[1] : o[1] === null ? o[0] : Math.min(o[0], o[1]))
      .map((t, i) => [t, i]).filter(([t, i]) => t !== null && cars[i].represents === 1).sort((a, b) => a[0] - b[0]);
    const energy = data.energy;
    const giga = energy && energy.initial >= 1e9, scale = giga ? 1e-9 : 1e-6;

    charts = [
      new Chart("chart-speed", () => fastest * 1.05, "m/s", (chart, p) => {
        p.strokeStyle = palette.lines; p.lineWidth = 1;
        for (let i = 0; i < N; i++) line(chart, p, (r) => at("speed", i, r), rows);
        p.strokeStyle = palette.select; p.lineWidth = 2.5;
        line(chart, p, (r) => at("speed", selected, r), rows);
      }, () => `Speed of each car over time; car ${selected + 1} is drawn bold. The table below holds the numbers.`),
      new Chart("chart-force", () => hardest, "MN", (chart, p) => {
        const limits = [[5, "5 MN: has ruptured tank cars"], [10, "10 MN"]].filter(([value]) => value <= hardest);
        for (const [value] of limits) {
          p.strokeStyle = palette.subtle; p.setLineDash([6, 4]); p.beginPath();
          p.moveTo(M.left, chart.y(value)); p.lineTo(chart.w - M.right, chart.y(value)); p.stroke(); p.setLineDash([]);
        }
        for (const c of data.contacts) {
          const mine = chosenByUser && (c.a === selected + 1 || c.b === selected + 1);
          const x = chart.x(c.peakTime), y = chart.y(c.peak * 1e-6);
          p.strokeStyle = p.fillStyle = mine ? palette.select : palette.mark; p.lineWidth = mine ? 2.5 : 1.2;
          p.beginPath(); p.moveTo(x, chart.y(0)); p.lineTo(x, y); p.stroke();
          p.beginPath();
          if (mine) p.rect(x - 4, y - 4, 8, 8); else p.arc(x, y, 2.6, 0, 7);
          p.fill();
        }
        p.textAlign = "right"; p.textBaseline = "bottom"; p.lineJoin = "round"; p.lineWidth = 3;
        for (const [value, text] of limits) {
          p.strokeStyle = palette.halo; p.strokeText(text, chart.w - M.right, chart.y(value) - 2);
          p.fillStyle = palette.subtle; p.fillText(text, chart.w - M.right, chart.y(value) - 2);
        }
      }, () => `Largest corner force of each of ${data.contacts.length} collisions, at its time. The table below holds the numbers.`),
      new Chart("chart-derailed", () => Math.max(4, offTimes.length * 1.1), "cars", (chart, p) => {
        p.strokeStyle = palette.select; p.lineWidth = 2; p.beginPath(); p.moveTo(chart.x(time[0]), chart.y(0));
        offTimes.forEach(([t], k) => { p.lineTo(chart.x(Math.max(t, time[0])), chart.y(k)); p.lineTo(chart.x(Math.max(t, time[0])), chart.y(k + 1)); });
        p.lineTo(chart.x(time[T - 1]), chart.y(offTimes.length)); p.stroke();
      }, () => `Number of derailed cars over time, ${offTimes.length} at the end. The table below holds the numbers.`),
    ];
    if (energy) {
      charts.push(new Chart("chart-energy", () => energy.initial * scale * 1.02, giga ? "GJ" : "MJ", (chart, p) => {
        let below = energy.time.map(() => 0);
        energy.parts.forEach((part, k) => {
          const above = below.map((b, j) => b + part.values[j] * scale);
          p.beginPath();
          above.forEach((v, j) => { const X = chart.x(energy.time[j]), Y = chart.y(v); if (j) p.lineTo(X, Y); else p.moveTo(X, Y); });
          for (let j = below.length - 1; j >= 0; j--) p.lineTo(chart.x(energy.time[j]), chart.y(below[j]));
          p.closePath();
          p.save(); p.setTransform(1, 0, 0, 1, 0, 0);
          p.fillStyle = pattern(p, palette.energy[k], ["", "", "dots", "lines", "cross", ""][k]);
          p.setTransform(ratio, 0, 0, ratio, 0, 0); p.fill(); p.restore();
          p.strokeStyle = palette.edge; p.lineWidth = 0.7; p.stroke();
          const j = Math.floor(below.length * (k === 0 ? 0.18 : 0.8)), high = chart.y(below[j]) - chart.y(above[j]);
          if (high > 15) {
            p.font = `600 12px system-ui, "DejaVu Sans", sans-serif`; p.textAlign = "center"; p.textBaseline = "middle";
            const X = chart.x(energy.time[j]), Y = (chart.y(below[j]) + chart.y(above[j])) / 2;
            p.lineJoin = "round"; p.strokeStyle = palette.halo; p.lineWidth = 3.5; p.strokeText(part.label, X, Y);
            p.fillStyle = palette.ink; p.fillText(part.label, X, Y);
          }
          below = above;
        });
      }, () => "Where the energy of the start has gone over time: motion, brakes, ground, collisions. The table below holds the numbers."));
    } else $("chart-energy").closest("figure").hidden = true;

    const whole = [];
    for (let t = Math.ceil(time[0]), step = Math.max(1, nice((time[T - 1] - time[0]) / 60)); t <= time[T - 1]; t += step) whole.push(t);
    const near = (t) => locate(t);
    const few = () => [...new Set([selected, 0, N - 1])];  // no car twice
    table("table-speed", () => "The selected, the first and the last car", () => ["time, s", ...few().map((i) => `car ${i + 1}, m/s`)],
      () => whole.map((t) => { const r = near(t); return [time[r].toFixed(2), ...few().map((i) => at("speed", i, r).toFixed(2))]; }));
    table("table-force", () => "Collisions in order of time", ["time, s", "striking", "struck", "force, MN", "closing, m/s", "angle, °"],
      () => [...data.contacts].sort((a, b) => a.peakTime - b.peakTime).map((c) => [c.peakTime.toFixed(3), c.a, c.b, (c.peak * 1e-6).toFixed(3), c.closing.toFixed(2), c.angle.toFixed(0)]));
    table("table-derailed", () => "First derailment of each car", ["time, s", "car", "cars derailed"],
      () => offTimes.map(([t, i], k) => [t.toFixed(3), i + 1, k + 1]));
    if (energy) {
      table("table-energy", () => `Energy, ${giga ? "GJ" : "MJ"}`, ["time, s", ...energy.parts.map((p) => p.label)],
        () => {
          const step = Math.max(1, Math.floor(energy.time.length / 60)), rows = [];
          for (let j = 0; j < energy.time.length; j += step) rows.push(j);
          if (rows[rows.length - 1] !== energy.time.length - 1) rows.push(energy.time.length - 1);
          return rows.map((j) => [energy.time[j].toFixed(2), ...energy.parts.map((p) => (p.values[j] * scale).toFixed(3))]);
        });
    }
  }

  // Tables are made when they are opened.
  const tables = [];
  function table(id, caption, heads, rows) {
    const details = $(id);
    const fill = () => {
      if (!details.open) return;
      details.querySelector(".scroll")?.remove();
      const box = make("div", null, {class: "scroll", tabindex: "0", role: "region", "aria-label": caption()});
      const grid = make("table"), head = make("tr"), body = make("tbody");
      grid.append(make("caption", caption()));
      for (const h of typeof heads === "function" ? heads() : heads) head.append(make("th", h, {scope: "col"}));
      const thead = make("thead"); thead.append(head); grid.append(thead, body);
      for (const row of rows()) { const tr = make("tr"); row.forEach((v) => tr.append(make("td", v))); body.append(tr); }
      box.append(grid); details.append(box);
    };
    details.addEventListener("toggle", fill);
    tables.push(fill);
  }

  function chartNotes() {
    $("note-speed").textContent = `car ${selected + 1}: ${speedText(value("speed", selected))}`;
    let hard = 0;
    for (const c of data.contacts) if (c.peakTime <= now + 1e-9) hard = Math.max(hard, c.peak);
    $("note-force").textContent = hard ? `largest so far ${force(hard)}` : "none yet";
    $("note-derailed").textContent = `${countDerailed()} now`;
    const e = data.energy;
    if (e) {
      let j = 0;
      while (j + 1 < e.time.length && e.time[j + 1] <= now + 1e-9) j++;
      $("note-energy").textContent = `${(100 * e.parts[0].values[j] / e.initial).toFixed(0)} % still motion`;
    }
  }

  function countDerailed() {
    let n = 0;
    for (let i = 0; i < N; i++) if (cars[i].represents === 1 && derailed(i)) n++;
    return n;
  }

  // --- lists ----------------------------------------------------------------------------------

  const ICONS = {truck_derailed: "▼", coupler_parted: "✕", collision: "✱", brakes_triggered: "◉", brake_signal_reached: "◉", car_at_rest: "■", rail_break_set: "╱"};
  let rowsOfEvents = [];

  function eventRow(t, icon, text, go) {
    const item = make("li"), button = make("button", null, {type: "button"});
    button.append(make("span", seconds(t), {class: "t"}), make("span", icon, {"aria-hidden": "true"}), make("span", text));
    button.addEventListener("click", go);
    item.append(button);
    return [item, button];
  }

  function listEvents() {
    const chosen = $("filter").value, list = $("events"), known = ["truck_derailed", "coupler_parted", "collision"];
    list.replaceChildren();
    rowsOfEvents = [];
    for (const e of data.timeline) {
      if (chosen && (chosen === "other" ? known.includes(e.kind) : e.kind !== chosen)) continue;
      const [item, button] = eventRow(e.time, ICONS[e.kind] || "•", e.text, () => {
        if (e.cars.length && e.cars.length < 3) select(e.cars[0] - 1);
        jump(e.kind === "collision" ? Math.max(time[0], e.time - 0.4) : e.time);
      });
      rowsOfEvents.push({time: e.time, item, button});
      list.append(item);
    }
    currentRow = -2;
    markEvents();
  }

  function listCollisions() {
    const list = $("collisions");
    for (const c of data.contacts.slice().sort((a, b) => b.peak - a.peak)) {
      const text = `${force(c.peak)}: car ${c.a} strikes car ${c.b}, closing at ${c.closing.toFixed(1)} m/s, ${c.angle.toFixed(0)}° between the cars; ${c.touch}`;
      const [item] = eventRow(c.peakTime, "✱", text, () => { select(c.a - 1); jump(Math.max(time[0], c.start - 0.25)); });
      list.append(item);
    }
    if (!data.contacts.length) list.append(make("li", "No collisions."));
  }

  let currentRow = -2;
  function markEvents() {
    let last = -1;
    rowsOfEvents.forEach((row, k) => { if (row.time <= now + 1e-9) last = k; });
    if (last === currentRow) return;
    currentRow = last;
    rowsOfEvents.forEach((row, k) => {
      row.item.classList.toggle("past", k <= last);
      if (k === last) row.button.setAttribute("aria-current", "true"); else row.button.removeAttribute("aria-current");
    });
    const list = $("events");
    if (last >= 0 && !list.matches(":hover") && !list.contains(document.activeElement)) {
      const item = rowsOfEvents[last].item;
      list.scrollTop = item.offsetTop - list.clientHeight / 2 + item.offsetHeight / 2;
    }
  }

  // --- the selected car -----------------------------------------------------------------------

  let chosenByUser = false;
  function select(i) {
    selected = Math.min(N - 1, Math.max(0, i));
    chosenByUser = true;
    $("car").value = String(selected + 1);
    if (followed >= 0 && followed !== selected) applyView(`car${selected + 1}`);
    $("follow").setAttribute("aria-pressed", String(followed === selected));
    for (const chart of charts) { chart.still = null; chart.canvas.setAttribute("aria-label", chart.describe()); }
    tables.forEach((fill) => fill());
    showCar(); dirty = true;
  }

  function facts(rows) {
    const list = make("dl");
    for (const [k, v] of rows) if (v !== null && v !== "") list.append(make("dt", k), make("dd", v));
    return list;
  }

  let fastFacts = null;
  function showCar() {
    const i = selected, car = cars[i], box = $("details");
    box.replaceChildren();
    box.append(make("h3", `Car ${i + 1}${car.name && car.name !== `car ${i + 1}` ? `: ${car.name}` : ""}`));
    box.append(facts([
      ["carries", car.contents], ["type", car.kind], ["stands for", car.represents > 1 ? `${car.represents} cars` : ""],
      ["mass", `${(car.mass * 1e-3).toFixed(1)} t`], ["length × width", `${car.length.toFixed(2)} m × ${car.width.toFixed(2)} m`],
      ["couplers", car.couplers.filter(Boolean).join(" in front, ") + (car.couplers.filter(Boolean).length === 2 ? " behind" : "")],
    ]));
    box.append(make("h3", "Now"));
    fastFacts = make("div"); box.append(fastFacts);
    box.append(make("h3", "What happened to it"));
    const list = make("ol");
    for (const e of data.carEvents[i]) {
      const [item] = eventRow(e.time, ICONS[e.kind] || "•", e.text, () => jump(e.kind === "collision" ? Math.max(time[0], e.time - 0.3) : e.time));
      list.append(item);
    }
    if (!data.carEvents[i].length) list.append(make("li", "Nothing: it stayed on the rails, coupled."));
    box.append(list);
    updateCar();
  }

  function updateCar() {
    if (!fastFacts || $("panel-car").hidden) return;
    const i = selected, peak = peakSoFar(i), held = (k) => k < 0 || k >= N - 1 ? "end of the train" : parted(k) ? "parted" : "coupled";
    fastFacts.replaceChildren(facts([
      ["speed", speedText(value("speed", i))],
      ["place", `x = ${value("x", i).toFixed(2)} m, y = ${value("y", i).toFixed(2)} m`],
      ["heading", `${(value("yaw", i) * 180 / Math.PI).toFixed(1)}°`],
      ["state", STATES[state(i)]],
      ["trucks", `front ${off(i, 0) ? "derailed" : "on the rails"}, rear ${off(i, 1) ? "derailed" : "on the rails"}`],
      ["couplings", `front ${held(i - 1)}, rear ${held(i)}`],
      ["force at a corner", force(value("force", i))],
      ["largest so far", peak[1] ? `${force(peak[1])} with car ${peak[2]} at ${seconds(peak[0])}` : "none"],
    ]));
  }

  // --- playing --------------------------------------------------------------------------------

  let playing = false, dirty = true, last = 0, listed = 0;
  const rate = () => Number($("rate").value);

  function setPlaying(on) {
    if (on && now >= time[T - 1] - 1e-9) setTime(time[0]);
    playing = on; last = performance.now();
    const button = $("play");
    button.textContent = on ? "Pause" : "Play";
    button.setAttribute("aria-label", on ? "Pause" : "Play");
    if (!on) announce(); else $("live").textContent = `Playing at ${rate()} times real time.`;
    dirty = true;
  }

  function jump(t, tell = true) {
    setTime(t); dirty = true;
    if (tell && !playing) announce();
  }

  function summaryNow() {
    const parts = [`${seconds(now)}.`, `${countDerailed()} cars derailed.`];
    const row = currentRow >= 0 ? rowsOfEvents[currentRow] : null;
    if (row) parts.push(row.button.lastChild.textContent + ".");
    return parts.join(" ");
  }

  function announce() {
    markEvents();
    const text = summaryNow();
    $("live").textContent = text;
    scene.setAttribute("aria-label", `Scene from above at ${text}`);
  }

  function stepBy(n) {
    if (playing) setPlaying(false);
    const at = n < 0 && now > time[lower] + 1e-9 ? lower + 1 : lower;
    jump(time[Math.min(T - 1, Math.max(0, at + n))]);
  }

  function eventBy(n) {
    const times = data.timeline.map((e) => e.time);
    const found = n > 0 ? times.find((t) => t > now + 1e-3) : times.filter((t) => t < now - 1e-3).pop();
    if (found !== undefined) jump(found);
  }

  function refresh() {
    drawScene();
    for (const chart of charts) chart.draw();
    $("clock").textContent = seconds(now);
    const n = countDerailed();
    let fast = 0, hard = 0;
    for (let i = 0; i < N; i++) fast = Math.max(fast, value("speed", i));
    for (const c of data.contacts) if (c.peakTime <= now + 1e-9) hard = Math.max(hard, c.peak);
    $("facts").textContent = `${n} derailed · fastest car ${fast.toFixed(1)} m/s${hard ? ` · largest force ${force(hard)}` : ""}`;
    const scrub = $("scrub");
    scrub.value = String(now);
    const stamp = performance.now();
    if (!playing || stamp - listed > 120) {
      listed = stamp;
      scrub.setAttribute("aria-valuetext", `${now.toFixed(2)} seconds of ${time[T - 1].toFixed(2)}`);
      $("readout").textContent = `${now.toFixed(2)} of ${time[T - 1].toFixed(2)} s`;
      markEvents(); chartNotes(); updateCar();
    }
  }

  let frames = 0;
  function frame(stamp) {
    if (playing) {
      const elapsed = Math.min(0.25, Math.max(0, (stamp - last) / 1000));
      last = stamp;
      const to = now + elapsed * rate();
      if (to >= time[T - 1]) {
        if ($("loop").checked) setTime(time[0]); else { setTime(time[T - 1]); setPlaying(false); }
      } else setTime(to);
      dirty = true; frames++;
    }
    if (dirty) { dirty = false; refresh(); }
    requestAnimationFrame(frame);
  }

  // --- sizes, theme, input --------------------------------------------------------------------

  function resize() {
    ratio = Math.min(3, window.devicePixelRatio || 1);
    width = Math.max(50, scene.clientWidth); height = Math.max(50, scene.clientHeight);
    scene.width = Math.round(width * ratio); scene.height = Math.round(height * ratio);
    fills = null;
    if (view === "site") fitWindow(data.site);
    drawTicks(); dirty = true;
  }

  function drawTicks() {
    const canvas = $("ticks"), w = canvas.clientWidth, h = canvas.clientHeight;
    if (!w) return;
    canvas.width = w * ratio; canvas.height = h * ratio;
    const p = canvas.getContext("2d"); p.scale(ratio, ratio);
    const x = (t) => 8 + (t - time[0]) / Math.max(1e-9, time[T - 1] - time[0]) * (w - 16);
    for (const e of data.timeline) {
      if (e.kind !== "truck_derailed") continue;
      p.fillStyle = palette.subtle; p.fillRect(x(e.time) - 0.5, h - 5, 1, 5);
    }
    for (const c of data.contacts) {
      const tall = 3 + 12 * Math.sqrt(Math.min(1, c.peak / 25e6));
      if (c.peak < 0.95e6) continue;
      p.fillStyle = palette.mark; p.fillRect(x(c.peakTime) - 1, h - tall, 2, tall);
    }
  }

  function setTheme(name) {
    document.documentElement.dataset.theme = name;
    palette = PALETTES[name]; fills = null;
    $("theme").setAttribute("aria-pressed", String(name === "dark"));
    charts.forEach((c) => { c.still = null; });
    legend(); drawTicks(); dirty = true;
  }

  function setTab(name) {
    for (const n of ["events", "collisions", "car"]) {
      const on = n === name, tab = $(`tab-${n}`);
      tab.setAttribute("aria-selected", String(on)); tab.tabIndex = on ? 0 : -1;
      $(`panel-${n}`).hidden = !on;
    }
    if (name === "car") showCar();
    if (name === "events") { currentRow = -2; markEvents(); }
  }

  function pick(X, Y) {
    const x = camera.x + (X - width / 2) / camera.zoom, y = camera.y - (Y - height / 2) / camera.zoom;
    const slack = 5 / camera.zoom;
    for (let i = N - 1; i >= 0; i--) {
      const yaw = value("yaw", i), dx = x - value("x", i), dy = y - value("y", i);
      const a = dx * Math.cos(yaw) + dy * Math.sin(yaw), b = -dx * Math.sin(yaw) + dy * Math.cos(yaw);
      if (Math.abs(a) <= cars[i].length / 2 + slack && Math.abs(b) <= cars[i].width / 2 + slack) return i;
    }
    return -1;
  }

  function bind() {
    const on = (id, kind, act) => $(id).addEventListener(kind, act);
    on("play", "click", () => setPlaying(!playing));
    on("home", "click", () => jump(time[0]));
    on("back", "click", () => stepBy(-1));
    on("step", "click", () => stepBy(1));
    on("previous", "click", () => eventBy(-1));
    on("next", "click", () => eventBy(1));
    on("scrub", "input", () => jump(Number($("scrub").value), false));
    on("scrub", "change", () => { if (!playing) announce(); });
    on("zoom-in", "click", () => zoomBy(1.35));
    on("zoom-out", "click", () => zoomBy(1 / 1.35));
    on("fit", "click", () => applyView("site"));
    on("view", "change", () => applyView($("view").value));
    on("colour", "change", () => { legend(); dirty = true; });
    on("marks", "change", () => { dirty = true; });
    on("filter", "change", listEvents);
    on("car", "change", () => select(Number($("car").value) - 1));
    on("follow", "click", () => applyView(followed === selected ? "free" : `car${selected + 1}`));
    on("theme", "click", () => setTheme(palette === PALETTES.dark ? "light" : "dark"));
    on("help-button", "click", help);
    const tabs = ["events", "collisions", "car"];
    tabs.forEach((n, k) => {
      on(`tab-${n}`, "click", () => setTab(n));
      on(`tab-${n}`, "keydown", (e) => {
        const move = {ArrowRight: 1, ArrowLeft: -1}[e.key];
        if (!move) return;
        e.preventDefault(); e.stopPropagation();
        const to = tabs[(k + move + tabs.length) % tabs.length];
        setTab(to); $(`tab-${to}`).focus();
      });
    });

    let held = null;
    const pointers = new Map();
    scene.addEventListener("pointerdown", (e) => {
      scene.setPointerCapture(e.pointerId);
      pointers.set(e.pointerId, [e.offsetX, e.offsetY]);
      held = {x: e.offsetX, y: e.offsetY, moved: 0};
    });
    scene.addEventListener("pointermove", (e) => {
      const before = pointers.get(e.pointerId);
      if (!before) return;
      const dx = e.offsetX - before[0], dy = e.offsetY - before[1];
      if (pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== e.pointerId)[1];
        const was = Math.hypot(before[0] - other[0], before[1] - other[1]), is = Math.hypot(e.offsetX - other[0], e.offsetY - other[1]);
        if (was > 5) zoomBy(is / was, (e.offsetX + other[0]) / 2, (e.offsetY + other[1]) / 2);
      } else {
        held.moved += Math.abs(dx) + Math.abs(dy);
        if (held.moved > 4) panBy(dx, dy);
      }
      pointers.set(e.pointerId, [e.offsetX, e.offsetY]);
    });
    const release = (e) => {
      if (pointers.delete(e.pointerId) && e.type === "pointerup" && held && held.moved <= 4 && !pointers.size) {
        const i = pick(e.offsetX, e.offsetY);
        if (i >= 0) { select(i); setTab("car"); }
      }
    };
    scene.addEventListener("pointerup", release);
    scene.addEventListener("pointercancel", release);
    scene.addEventListener("wheel", (e) => {
      if (!e.ctrlKey && document.activeElement !== scene && !e.altKey) return;  // the page may scroll
      e.preventDefault(); zoomBy(Math.exp(-0.0016 * e.deltaY), e.offsetX, e.offsetY);
    }, {passive: false});
    scene.addEventListener("dblclick", (e) => zoomBy(1.8, e.offsetX, e.offsetY));

    document.addEventListener("keydown", keys);
    new ResizeObserver(resize).observe(scene);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", (e) => setTheme(e.matches ? "dark" : "light"));
  }

  function help() {
    const box = $("help");
    box.hidden = !box.hidden;
    $("help-button").setAttribute("aria-expanded", String(!box.hidden));
  }

  function keys(e) {
    if (e.ctrlKey || e.metaKey || e.altKey) return;
    if (e.key.length === 1 && e.key !== " " && !$("letters").checked) return;
    const tag = e.target.tagName, native = tag === "SELECT" || (tag === "INPUT" && e.target.type !== "checkbox");
    const pressable = ["BUTTON", "SUMMARY", "A", "INPUT", "SELECT"].includes(tag);
    const rates = [...$("rate").options].map((o) => o.value);
    const shift = (n) => { const k = rates.indexOf($("rate").value) + n; if (rates[k]) $("rate").value = rates[k]; };
    const scrolls = e.target.closest?.(".scroll");
    const acts = {
      k: () => setPlaying(!playing), n: () => eventBy(1), p: () => eventBy(-1),
      ",": () => shift(-1), ".": () => shift(1), "+": () => zoomBy(1.35), "=": () => zoomBy(1.35), "-": () => zoomBy(1 / 1.35),
      0: () => applyView("site"), w: () => panBy(0, 60), s: () => panBy(0, -60), a: () => panBy(60, 0), d: () => panBy(-60, 0),
      "[": () => select(selected - 1), "]": () => select(selected + 1),
      f: () => applyView(followed === selected ? "free" : `car${selected + 1}`),
      c: () => { $("colour").selectedIndex = 1 - $("colour").selectedIndex; legend(); dirty = true; },
      t: () => setTheme(palette === PALETTES.dark ? "light" : "dark"), "?": help,
    };
    if (!native && !scrolls) {
      Object.assign(acts, {
        ArrowLeft: () => e.shiftKey ? jump(now - 1) : stepBy(-1), ArrowRight: () => e.shiftKey ? jump(now + 1) : stepBy(1),
        Home: () => jump(time[0]), End: () => jump(time[T - 1]),
      });
    }
    if (!pressable) acts[" "] = () => setPlaying(!playing);
    if (tag === "SELECT" && e.key.length === 1) return;  // typing chooses an entry
    const act = acts[e.key.length === 1 ? e.key.toLowerCase() : e.key];
    if (act) { e.preventDefault(); act(); }
  }

  // --- begin ----------------------------------------------------------------------------------

  async function begin() {
    await unpack();
    setTime(time[0]);
    const scrub = $("scrub");
    scrub.min = String(time[0]); scrub.max = String(time[T - 1]);
    const options = [["site", "accident site"], ["train", "whole train"], ["free", "free"]];
    for (const [v, t] of options) $("view").append(make("option", t, {value: v}));
    for (let i = 0; i < N; i++) {
      $("view").append(make("option", `follow car ${i + 1}`, {value: `car${i + 1}`}));
      $("car").append(make("option", `${i + 1}${cars[i].name ? `  ${cars[i].name}` : ""}`, {value: String(i + 1)}));
    }
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    makeCharts();
    setTheme(dark ? "dark" : "light");
    listEvents(); listCollisions(); bind(); resize(); applyView("site"); announce();
    $("live").textContent = "";
    requestAnimationFrame(frame);
    document.documentElement.dataset.ready = "true";
  }

  // For tests and scripts on this page.
  window.derailReplay = {
    get time() { return now; }, get playing() { return playing; }, get frames() { return frames; }, get view() { return view; },
    get first() { return time[0]; }, get last() { return time[T - 1]; }, get selected() { return selected + 1; },
    get camera() { return {...camera}; }, get travel() { return travel(); },
    seek: (t) => { jump(t); refresh(); }, play: () => setPlaying(true), pause: () => setPlaying(false),
    pose: (car) => [value("x", car - 1), value("y", car - 1), value("yaw", car - 1)],
    speed: (car) => value("speed", car - 1), state: (car) => STATES[state(car - 1)], peak: (car) => peakSoFar(car - 1)[1],
    derailed: countDerailed, select: (car) => select(car - 1),
    screen: (car) => [px(value("x", car - 1)), py(value("y", car - 1))],
  };

  begin().catch((error) => {
    const box = $("failure");
    box.textContent = error.message; box.hidden = false;
    throw error;
  });
})();
