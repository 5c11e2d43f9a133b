// The scene from above, drawn on a canvas: for the replay page and for the page of a live run.
// A page gives cars, N, data.track, data.contacts, now, value(name, car), off(car, end), parted(car)
// and select(car); it draws when `dirty` is set. Everything stands in one function (web.py).

  const $ = (id) => document.getElementById(id);
  const reduced = matchMedia("(prefers-reduced-motion: reduce)");
  const RUPTURE = 5e6, CONSERVATIVE = 10e6, GAUGE = 1.435;
  const FADE = 1.5;  // s of run time for which a collision stays marked
  let dirty = true, chosenByUser = false;

  const derailed = (car) => off(car, 0) || off(car, 1);
  const loose = (car) => derailed(car) && parted(car - 1) && parted(car);
  const state = (car) => !derailed(car) ? 0 : loose(car) ? 2 : 1;

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
      lines: "rgba(90,98,108,0.30)", panel: "#f4f5f7", standing: "#009e73",
      energy: ["#d8dce1", "#56b4e9", "#e69f00", "#f0e442", "#d55e00", "#cc79a7"],
    },
    dark: {
      bg: "#121519", ink: "#e9ecef", subtle: "#a9b2bc", rail: "#7d858e", tie: "#37342f", grid: "#343a42",
      state: ["#525b66", "#2f87bd", "#c98a17"], level: ["#3f464f", "#3d7ca3", "#c98a17", "#d2570a"],
      hatch: "rgba(8,10,12,0.60)", edge: "#e9ecef", mark: "#ff8a45", halo: "#121519", box: "#6cbcf0", select: "#6cbcf0",
      lines: "rgba(169,178,188,0.28)", panel: "#1c2026", standing: "#2fc79a",
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
    $("follow")?.setAttribute("aria-pressed", String(followed >= 0 && followed === selected));
    dirty = true;
  }

  const free = () => { if (view !== "free") { view = "free"; followed = -1; $("view").value = "free"; $("follow")?.setAttribute("aria-pressed", "false"); } };

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

  function drawPlace() {
    for (const part of data.place || []) {
      if (part.role === "track") { drawRails(part.points.map((p) => p[0]), part.points.map((p) => p[1])); continue; }
      const line = part.role === "fixed" ? palette.edge : palette.subtle;
      pen.strokeStyle = line; pen.lineWidth = part.role === "fixed" ? 4 : 1.5;
      if (part.role === "area") pen.setLineDash([7, 4]);
      pen.beginPath();
      part.points.forEach(([x, y], i) => (i ? pen.lineTo(px(x), py(y)) : pen.moveTo(px(x), py(y))));
      if (part.closed) pen.closePath();
      if (part.closed && part.role !== "area") {
        pen.globalAlpha = part.role === "zone" ? 0.18 : 0.8; pen.fillStyle = line; pen.fill(); pen.globalAlpha = 1;
      }
      pen.stroke(); pen.setLineDash([]);
      const n = part.points.length, [ax, ay] = part.points[n >> 1], [bx, by] = part.points[(n >> 1) - 1];
      const x = px((ax + bx) / 2), y = py((ay + by) / 2);
      if (x > 0 && x < width && y > 0 && y < height) label(x, y, part.name, line, 12, "500");
    }
  }

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
    drawRails(x, y);
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

  function drawRails(x, y) {
    const z = camera.zoom;
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
      if (cars[i].cut) { pen.strokeStyle = palette.standing; pen.lineWidth = detailed ? 5 : 3; pen.stroke(); pen.fill(); }
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
        if (pair < 0 || pair >= N - 1 || cars[pair].cut !== cars[pair + 1].cut) continue;
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
    const mode = $("marks")?.value || "now";
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
    drawPlace(); drawTrack(); drawCars(); drawCollisions(); drawScale();
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
    if (cars.some((car) => car.cut)) entry("not of the train", (p) => { p.strokeStyle = palette.standing; p.lineWidth = 3; p.strokeRect(2, 2, 22, 11); });
    entry("front", (p) => { p.fillStyle = palette.edge; p.fillRect(19, 1, 6, 13); p.strokeStyle = palette.edge; p.strokeRect(1, 1, 24, 13); });
    entry("parted", (p) => { p.strokeStyle = palette.mark; p.lineWidth = 2; p.beginPath(); p.moveTo(8, 3); p.lineTo(18, 13); p.moveTo(8, 13); p.lineTo(18, 3); p.stroke(); });
    entry("collision, by force", (p) => {
      p.beginPath();
      for (let k = 0; k < 16; k++) { const q = k % 2 ? 3.5 : 7, a = k * Math.PI / 8; p.lineTo(13 + q * Math.cos(a), 7.5 + q * Math.sin(a)); }
      p.closePath(); p.fillStyle = palette.mark; p.fill();
    });
  }

  function countDerailed() {
    let n = 0;
    for (let i = 0; i < N; i++) if (cars[i].represents === 1 && !cars[i].cut && derailed(i)) n++;
    return n;
  }

  const ICONS = {truck_derailed: "▼", coupler_parted: "✕", collision: "✱", brakes_triggered: "◉", brake_signal_reached: "◉", car_at_rest: "■", rail_break_set: "╱"};
  function eventRow(t, icon, text, go) {
    const item = make("li"), button = make("button", null, {type: "button"});
    button.append(make("span", seconds(t), {class: "t"}), make("span", icon, {"aria-hidden": "true"}), make("span", text));
    button.addEventListener("click", go);
    item.append(button);
    return [item, button];
  }

  // --- size, theme, pointers -------------------------------------------------------------------

  function resizeScene() {
    ratio = Math.min(3, window.devicePixelRatio || 1);
    width = Math.max(50, scene.clientWidth); height = Math.max(50, scene.clientHeight);
    scene.width = Math.round(width * ratio); scene.height = Math.round(height * ratio);
    fills = null; dirty = true;
    if (view === "site") fitWindow(data.site);
  }

  function paintScene(name) {
    document.documentElement.dataset.theme = name;
    palette = PALETTES[name]; fills = null; dirty = true;
    $("theme").setAttribute("aria-pressed", String(name === "dark"));
    legend();
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

  // Drag, pinch and wheel move the view; `tapped` gets the car (-1: none) and the place in metres.
  function bindScene(tapped) {
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
        tapped(pick(e.offsetX, e.offsetY), camera.x + (e.offsetX - width / 2) / camera.zoom, camera.y - (e.offsetY - height / 2) / camera.zoom);
      }
    };
    scene.addEventListener("pointerup", release);
    scene.addEventListener("pointercancel", release);
    scene.addEventListener("wheel", (e) => {
      if (!e.ctrlKey && document.activeElement !== scene && !e.altKey) return;  // the page may scroll
      e.preventDefault(); zoomBy(Math.exp(-0.0016 * e.deltaY), e.offsetX, e.offsetY);
    }, {passive: false});
    scene.addEventListener("dblclick", (e) => zoomBy(1.8, e.offsetX, e.offsetY));
  }
