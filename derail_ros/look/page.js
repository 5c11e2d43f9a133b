  // A live run: states come as server-sent events; between two of them the cars are interpolated.

  let data = {track: {x: [], y: [], breaks: []}, contacts: []}, cars = [], N = 0;
  let hello = null, before = null, after = null, arrived = 0, spacing = 50, weight = 0, now = 0, ended = false;
  let peaks = [], place = null;  // place on the track that was tapped: [x, y]

  function value(name, car) {
    const b = after[name][car];
    if (!before || weight >= 1) return b;
    let a = before[name][car];
    if (name === "yaw" || name === "alpha" || name === "beta") a = b - Math.atan2(Math.sin(b - a), Math.cos(b - a));
    return a + weight * (b - a);
  }
  const off = (car, end) => !after.on[2 * car + end];
  const parted = (car) => car < 0 || car >= N - 1 || !after.coupled[car];
  const peakSoFar = (car) => peaks[car] || [null, 0, 0];

  function select(i) {
    selected = i; chosenByUser = true; dirty = true;
  }

  // --- commands -------------------------------------------------------------------------------

  async function send(command, more = {}) {
    try {
      const answer = await fetch("/command", {method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify({command, ...more})});
      const told = await answer.json();
      fail(told.error || "");
      if (told.said) $("live").textContent = told.said;
      return answer.ok;
    } catch { fail("The run does not answer: its program has ended, or the network is gone."); return false; }
  }

  function fail(text) {
    $("failure").textContent = text ? text[0].toUpperCase() + text.slice(1) : ""; $("failure").hidden = !text;
  }

  function breakRail() {
    if (place) send("break", {x: place[0], y: place[1]}).then((done) => { if (done) { place = null; target(); } });
    else send("break", {car: selected + 1});
  }

  function target() {
    $("break").textContent = place ? "Break the rail here" : `Break the rail ahead of car ${selected + 1}`;
    dirty = true;
  }

  // The nearest place on the track, if it is close to where was tapped.
  function onTrack(x, y) {
    const line = data.track;
    let best = 30 / camera.zoom + 3, found = null;
    for (let i = 0; i + 1 < line.x.length; i++) {
      const dx = line.x[i + 1] - line.x[i], dy = line.y[i + 1] - line.y[i], size = dx * dx + dy * dy;
      if (!size) continue;
      const share = Math.min(1, Math.max(0, ((x - line.x[i]) * dx + (y - line.y[i]) * dy) / size));
      const at = [line.x[i] + share * dx, line.y[i] + share * dy], apart = Math.hypot(at[0] - x, at[1] - y);
      if (apart < best) { best = apart; found = at; }
    }
    return found;
  }

  function tapped(car, x, y) {
    if (car >= 0) { select(car); place = null; }
    else { const at = onTrack(x, y); if (!at) return; place = at; }
    target();
  }

  // --- the view -------------------------------------------------------------------------------

  // Derailed cars and those that come next; before there are any, the first cars and the break ahead.
  function actionWindow() {
    let w = null;
    const take = (x, y, r) => { w = w ? [Math.min(w[0], x - r), Math.max(w[1], x + r), Math.min(w[2], y - r), Math.max(w[3], y + r)] : [x - r, x + r, y - r, y + r]; };
    let last = -1;
    for (let i = 0; i < N; i++) if (derailed(i) && cars[i].represents === 1) { take(value("x", i), value("y", i), 16); last = i; }
    if (last < 0) {
      const next = data.track.breaks.map((b) => [b, Math.hypot(b.x - value("x", 0), b.y - value("y", 0))]).filter(([, d]) => d < 250)[0];
      if (next) take(next[0].x, next[0].y, 25);
      for (let i = 0; i < Math.min(N, 6); i++) take(value("x", i), value("y", i), 16);
    }
    for (let i = last + 1; i < Math.min(N, last + 4); i++) take(value("x", i), value("y", i), 10);
    return w;
  }

  function moveCamera(seconds) {
    if (view === "free" || view === "train") return;
    const was = {...camera};
    if (view === "head") { camera.x = value("x", 0); camera.y = value("y", 0); return; }
    fitWindow(actionWindow());
    const share = 1 - Math.exp(-2.5 * seconds);  // soft, so that the scene does not jump
    for (const k of ["x", "y"]) camera[k] = was[k] + share * (camera[k] - was[k]);
    camera.zoom = was.zoom * (camera.zoom / was.zoom) ** share;
  }

  function look(chosen) {
    view = chosen; followed = -1; $("view").value = chosen; dirty = true;
    if (!after) return;
    if (chosen === "head") camera.zoom = Math.max(4, Math.min(9, width / 90));
    if (chosen === "action") fitWindow(actionWindow());
  }

  // --- what comes -----------------------------------------------------------------------------

  function begin(told) {
    hello = told; cars = told.cars; N = cars.length;
    data = {track: told.track, place: told.place, contacts: []};
    before = after = place = null; peaks = []; ended = false; selected = 0; chosenByUser = false;
    $("title").textContent = told.title; document.title = `${told.title}: live run`;
    $("outcome").textContent = ""; $("events").replaceChildren(); fail("");
    for (const name of ["break", "brake", "pause"]) $(name).hidden = !told.can.includes(name);
    $("where").hidden = $("break").hidden;
    $("rate-box").hidden = !told.can.includes("rate"); $("again").hidden = !told.can.includes("restart");
    $("break").disabled = told.breaks === false; $("brake").disabled = told.brakes === false;
    if (!$("scenario").length) for (const name of told.choices) $("scenario").append(make("option", name, {value: name}));
    $("scenario").value = told.scenario; $("whole").checked = Boolean(told.whole);
    if (told.speed) {
      $("speed").max = String(Math.max(160, Math.ceil(told.speed)));
      $("speed").value = String(told.speed); showSpeed();
    }
    target();
  }

  function showSpeed() {
    const v = Number($("speed").value);
    $("speed-shown").textContent = `${v.toFixed(0)} km/h (${(v / 1.609344).toFixed(0)} mph)`;
  }

  function state_(told) {
    const stamp = performance.now();
    if (after) spacing = Math.min(250, Math.max(20, 0.7 * spacing + 0.3 * (stamp - arrived)));
    before = after; after = told; arrived = stamp; weight = before ? 0 : 1;
    if (!before) { look(view === "site" ? "action" : view); }
    if (told.paused !== undefined) {
      $("pause").textContent = told.paused ? "Go on" : "Pause"; $("pause").setAttribute("aria-pressed", String(told.paused));
      if (document.activeElement !== $("rate")) $("rate").value = String(told.rate);
    }
    dirty = true;
  }

  function happened(told) {
    const [item] = eventRow(told.time, ICONS[told.kind] || "•", told.text, () => {
      if (told.cars.length && told.cars.length < 3) { select(told.cars[0] - 1); place = null; target(); }
    });
    $("events").prepend(item);
    while ($("events").childElementCount > 300) $("events").lastElementChild.remove();
  }

  function contact(c) {
    const k = data.contacts.findIndex((old) => old.id === c.id);
    if (k >= 0) data.contacts[k] = c; else data.contacts.push(c);
    for (const [car, other] of [[c.a, c.b], [c.b, c.a]]) {
      if (car > 0 && c.peak > peakSoFar(car - 1)[1]) peaks[car - 1] = [c.peakTime, c.peak, other];
    }
    if (k < 0 && c.peak >= 1e6) happened({time: c.peakTime, kind: "collision", cars: [c.a, c.b], text: c.text[0].toUpperCase() + c.text.slice(1)});
    dirty = true;
  }

  function end(told) {
    ended = true;
    $("outcome").textContent = `${told.text} ${told.more}`;
    $("live").textContent = told.text;
    for (const name of ["break", "brake", "pause"]) $(name).disabled = true;
  }

  function connect() {
    const stream = new EventSource("/events");
    const on = (kind, act) => stream.addEventListener(kind, (e) => act(JSON.parse(e.data)));
    on("hello", (told) => { for (const name of ["break", "brake", "pause"]) $(name).disabled = false; begin(told); });
    on("state", state_); on("event", happened); on("contact", contact); on("end", end);
    on("break", (told) => { data.track.breaks.push(told); dirty = true; });
    on("closed", () => { stream.close(); fail("The program that ran this has ended."); });
    stream.onerror = () => { if (stream.readyState !== EventSource.CLOSED && hello) fail("The connection is lost; trying again."); };
    stream.onopen = () => fail("");
  }

  // --- drawing --------------------------------------------------------------------------------

  let last = performance.now();
  function frame(stamp) {
    const seconds_ = Math.min(0.2, Math.max(0, (stamp - last) / 1000));
    last = stamp;
    if (after) {
      const reach = before ? Math.min(1, (stamp - arrived) / spacing) : 1;
      if (reach !== weight) { weight = Math.max(0, reach); dirty = true; }
      now = before ? before.time + weight * (after.time - before.time) : after.time;
      if (view === "action" || view === "head") { moveCamera(seconds_); dirty = true; }
      if (dirty) { dirty = false; draw(); }
    }
    requestAnimationFrame(frame);
  }

  function draw() {
    drawScene();
    if (place) {
      const [x, y] = [px(place[0]), py(place[1])];
      pen.strokeStyle = palette.mark; pen.lineWidth = 3;
      pen.beginPath(); pen.arc(x, y, 11, 0, 7); pen.moveTo(x - 17, y); pen.lineTo(x + 17, y); pen.moveTo(x, y - 17); pen.lineTo(x, y + 17); pen.stroke();
      label(x, y - 26, "here", palette.mark, 13);
    }
    let fast = 0, hard = 0;
    for (let i = 0; i < N; i++) fast = Math.max(fast, value("speed", i));
    for (const p of peaks) if (p) hard = Math.max(hard, p[1]);
    const text = `${speedText(fast)} · ${countDerailed()} derailed${hard ? ` · largest force ${force(hard)}` : ""}`;
    if ($("facts").textContent !== text) $("facts").textContent = text;
    $("clock").textContent = seconds(now, 1);
  }

  // --- begin ----------------------------------------------------------------------------------

  const on = (id, kind, act) => $(id).addEventListener(kind, act);
  on("break", "click", breakRail);
  on("brake", "click", () => send("brake"));
  on("pause", "click", () => send($("pause").getAttribute("aria-pressed") === "true" ? "resume" : "pause"));
  on("rate", "change", () => send("rate", {value: Number($("rate").value)}));
  on("speed", "input", showSpeed);
  on("scenario", "change", () => send("restart", {scenario: $("scenario").value, whole: $("whole").checked}));
  on("restart", "click", () => send("restart", {scenario: $("scenario").value, speed_kmh: Number($("speed").value), whole: $("whole").checked}));
  on("view", "change", () => look($("view").value));
  on("colour", "change", () => { legend(); dirty = true; });
  on("zoom-in", "click", () => zoomBy(1.35));
  on("zoom-out", "click", () => zoomBy(1 / 1.35));
  on("theme", "click", () => paintScene(palette === PALETTES.dark ? "light" : "dark"));
  bindScene(tapped);
  new ResizeObserver(resizeScene).observe(scene);
  view = "action";
  resizeScene();
  paintScene(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  connect();
  requestAnimationFrame(frame);

  // For tests of this page.
  window.derailLook = {
    get time() { return now; }, get cars() { return N; }, get ended() { return ended; }, get derailed() { return after ? countDerailed() : 0; },
    get breaks() { return data.track.breaks.length; }, get speed() { return after ? after.speed[0] : 0; }, get run() { return hello ? hello.run : 0; },
    pose: (car) => [value("x", car - 1), value("y", car - 1)], screen: (x, y) => [px(x), py(y)],
  };
