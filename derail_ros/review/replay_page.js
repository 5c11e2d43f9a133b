  const data = JSON.parse($("data").textContent);
  const cars = data.cars, N = cars.length;

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
  const parted = (car) => car < 0 || car >= N - 1 || (data.parted[car] !== null && data.parted[car] <= now + 1e-9);

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
      .map((t, i) => [t, i]).filter(([t, i]) => t !== null && cars[i].represents === 1 && !cars[i].cut).sort((a, b) => a[0] - b[0]);
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
      () => [...data.contacts].sort((a, b) => a.peakTime - b.peakTime).map((c) => [c.peakTime.toFixed(3), c.a, c.object || c.b, (c.peak * 1e-6).toFixed(3), c.closing.toFixed(2), c.angle.toFixed(0)]));
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

  // --- lists ----------------------------------------------------------------------------------

  let rowsOfEvents = [];

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
      const text = `${force(c.peak)}: car ${c.a} strikes ${c.object || `car ${c.b}`}, closing at ${c.closing.toFixed(1)} m/s, ${c.angle.toFixed(0)}° ${c.object ? "to it" : "between the cars"}; ${c.touch}`;
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
    box.append(make("h3", `${car.cut ? "Standing car" : "Car"} ${i + 1}${car.name && car.name !== `car ${i + 1}` ? `: ${car.name}` : ""}`));
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
    const i = selected, peak = peakSoFar(i), held = (k) => k < 0 || k >= N - 1 || cars[k].cut !== cars[k + 1].cut ? `end of the ${cars[i].cut ? "cut" : "train"}` : parted(k) ? "parted" : "coupled";
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

  let playing = false, last = 0, listed = 0;
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
    resizeScene(); drawTicks();
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
    paintScene(name);
    charts.forEach((c) => { c.still = null; });
    drawTicks();
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

    bindScene((i) => { if (i >= 0) { select(i); setTab("car"); } });
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
