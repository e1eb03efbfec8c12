// The page of `semcal view`: draws what the server sends, and sends what the user wants.
// All lengths and uncertainties come from the server; only places on the screen are computed here.

const $ = (id) => document.getElementById(id);
const all = (selector) => [...document.querySelectorAll(selector)];
const figures = Object.fromEntries(all("#pictures figure").map((f) => [f.dataset.picture, f]));
const canvases = Object.fromEntries(Object.entries(figures).map(([n, f]) => [n, f.querySelector("canvas")]));

const state = {
  socket: null, shown: {}, header: null, layout: "both", blink: "raw", tool: "ruler",
  zoom: 1, centre: [0.5, 0.5], contrast: "auto", low: 0, high: 255,
  ruler: null, rulerText: "", drag: null, seeking: false, trace: [], traceSigma: 0, measuredAt: 0,
};
const MOST_ZOOM = 32;
const BLINK_MS = 700;
const RETRY_MS = 1000;

// -- connection ----------------------------------------------------------------------------------

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  state.socket = socket;
  socket.onopen = () => { setLink("connected", "ok"); sendRequest(); };
  socket.onmessage = (event) => (typeof event.data === "string" ? onText(JSON.parse(event.data)) : onBinary(event.data));
  socket.onclose = () => {
    if (state.socket !== socket) return;
    state.socket = null;
    setLink("not connected: the viewer has ended or is busy", "error");
    if (!document.hidden) setTimeout(reconnect, RETRY_MS);
  };
}
function reconnect() { if (!state.socket && !document.hidden) connect(); }
function send(message) {
  if (state.socket?.readyState === WebSocket.OPEN) state.socket.send(JSON.stringify(message));
}
function setLink(text, level) { $("link").textContent = text; $("link").className = `badge ${level}`; }
// A page that nobody sees costs the stream nothing.
document.addEventListener("visibilitychange", () => {
  if (document.hidden) { const socket = state.socket; state.socket = null; socket?.close(); setLink("paused", "warn"); } else reconnect();
});

function sendRequest() {
  const pictures = { both: ["raw", "corrected"], blink: ["raw", "corrected"], raw: ["raw"], corrected: ["corrected"] }[state.layout];
  const width = Math.max(...Object.values(canvases).map((c) => c.clientWidth), 200) * Math.min(devicePixelRatio, 2);
  const contrast = state.contrast === "fixed" ? { mode: "fixed", low: state.low, high: state.high } : { mode: state.contrast };
  send({ type: "request", pictures, width: Math.round(width), zoom: state.zoom, centre: state.centre, contrast });
}

// -- what the server sends -------------------------------------------------------------------------

async function onBinary(data) {
  const size = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
  let offset = 4 + size;
  if (header.type === "overlay") {
    const image = $("overlay").querySelector("img");
    const before = image.src;
    image.src = URL.createObjectURL(new Blob([new Uint8Array(data, offset)], { type: "image/jpeg" }));
    if (before) URL.revokeObjectURL(before);
    $("overlay").hidden = false;
    return;
  }
  const shown = {};
  for (const picture of header.pictures) {
    const bytes = new Uint8Array(data, offset, picture.bytes);
    offset += picture.bytes;
    shown[picture.name] = { ...picture, bitmap: await createImageBitmap(new Blob([bytes], { type: "image/jpeg" })) };
  }
  for (const old of Object.values(state.shown)) old.bitmap.close();
  state.shown = shown;
  state.header = header;
  showHeader(header);
  draw();
  send({ type: "seen", number: header.number });
  if (state.ruler && performance.now() - state.measuredAt > 500) measureRuler();
}

function showHeader(header) {
  const first = header.pictures[0];
  $("pixel").textContent = first?.scale ? `${first.scale.pixel_size}${first.scale.calibrated ? "" : " (nominal)"}` : "unknown";
  const [low, high, least, greatest] = header.levels ?? [0, 255, 0, 255];
  for (const [id, value] of [["low", low], ["high", high]]) {
    const slider = $(id);
    slider.min = least; slider.max = greatest; slider.step = greatest - least > 50 ? 1 : (greatest - least) / 200;
    if (state.contrast !== "fixed") { slider.value = value; state[id] = value; }
  }
  $("levels").textContent = `${format(low)} to ${format(high)} of ${format(greatest)}`;
  $("empty").hidden = header.available.length > 0;
  for (const name of ["raw", "corrected"]) {
    const there = header.available.includes(name);
    $(`snap-${name}`).toggleAttribute("aria-disabled", !there);
    if (!there) $(`snap-${name}`).setAttribute("aria-disabled", "true");
  }
  layOut();
}
const format = (value) => (Math.abs(value) >= 1000 || Number.isInteger(value) ? Math.round(value).toString() : value.toPrecision(3));

function onText(message) {
  if (message.type === "status") showStatus(message);
  else if (message.type === "measured") showMeasured(message);
  else if (message.type === "done") answer(message.text, message.success ? "ok" : "error");
  else if (message.type === "refused") answer(message.text, "error");
}
function answer(text, level) { $("answer").textContent = text; $("answer").className = level; }

// A slow scan has frames per second below one.
function rateText(hz) { return hz < 0.95 ? hz.toFixed(2) : hz.toFixed(1); }

function showStatus(s) {
  $("title").textContent = s.title;
  document.title = `semcal view: ${s.title}`;
  $("magnification").textContent = s.magnification.text;
  const badge = $("range");
  badge.textContent = s.magnification.explanation;
  badge.hidden = !s.magnification.explanation;
  badge.className = `badge ${{ ok: "ok", outside: "error", unknown: "warn" }[s.magnification.state]}`;
  const rate = s.rates.find((r) => r.name.includes("corrector")) ?? s.rates[0];
  $("rate").textContent = rate ? `${rateText(rate.rate_hz)} frames/s${rate.latency_ms === null ? "" : `, ${rate.latency_ms.toFixed(0)} ms old`}` : "no frames yet";
  fill($("rates"), s.rates, "tr", (row, r) => {
    const latency = r.latency_ms === null ? "" : `${r.latency_ms.toFixed(0)}, ${r.longest_ms.toFixed(0)} ms`;
    fill(row, [r.name, rateText(r.rate_hz), latency], "td", (cell, text) => setText(cell, text));
  });
  fill($("notes"), s.notes, "li", (item, note) => {
    item.className = note.level;
    // What is fine is said of several at once, what is not of one.
    const words = note.level === "ok" ? [["", note.text], ["who", ` ${note.who}`]] : [["", `${note.who} ${note.text}`.trim()], ["who", ""]];
    fill(item, [...words, ["do", note.do]], "span", (span, [kind, text]) => { span.className = kind; setText(span, text); span.hidden = !text.trim(); });
  });
  $("drift-text").textContent = s.drift.text;
  state.trace = s.drift.trace_nm;
  state.traceAt = s.drift.at_nm;
  state.traceSigma = s.drift.sigma_nm;
  drawTrace();
  for (const button of all("[data-action]")) button.disabled = !s.actions.includes(button.dataset.action);
  showCalibration(s.calibration);
  showTimeline(s.timeline);
  $("microscope").hidden = s.kind !== "live";
}

function showCalibration(panel) {
  $("calibration").hidden = !panel;
  if (!panel) return;
  $("calibration-answer").textContent = panel.answer;
  // The request of an acquisition stands with its buttons.
  $("calibration-answer").hidden = panel.acquisition?.request === panel.answer;
  $("calibration-answer").className = panel.level === "ok" ? "" : panel.level;
  fillBars($("bars"), panel.running ? [...panel.bars, panel.running] : panel.bars);
  setText($("corners"), panel.overlay_text);
  showAcquisition(panel.acquisition);
}
function fillBars(parent, bars) {
  fill(parent, bars, "div", (element, bar) => {
    element.className = "bar";
    if (!element.firstChild) element.innerHTML = "<div><span></span><span></span></div><progress max='1'></progress>";
    const [name, text] = element.querySelectorAll("span");
    setText(name, bar.name); setText(text, bar.text);
    const progress = element.querySelector("progress");
    progress.value = bar.fraction; progress.setAttribute("aria-label", bar.name);
  });
}

function showAcquisition(panel) {
  $("acquisition").hidden = !panel;
  const waiting = panel?.state === "waiting";
  document.querySelector("[data-action=add_view]").classList.toggle("wanted", waiting);
  if (!panel) return;
  const under = waiting || panel.state === "running";
  setText($("acquisition-who"), panel.who);
  const request = { waiting: `Please ${panel.request}; then press Add view.`, running: panel.request, ready: "" }[panel.state]
    ?? `${panel.state}: ${panel.request}`;
  setText($("request"), request);
  $("request").hidden = !request;
  $("request").className = { waiting: "warn", failed: "error", stopped: "warn", done: "ok" }[panel.state] ?? "";
  fillBars($("acquisition-bars"), panel.bars);
  const button = document.querySelector("[data-action=acquire]");
  setText(button, panel.state === "stopped" || panel.state === "failed" ? "Go on" : "Acquire");
  if (under) button.disabled = true;
  const goal = { "goal-low": panel.magnifications?.[0], "goal-high": panel.magnifications?.[1], "goal-target": panel.target && +(100 * panel.target).toPrecision(6) };
  for (const [id, value] of Object.entries(goal)) {
    const input = $(id);
    input.disabled = under;
    // What somebody has typed stays until it is used.
    if (value && (under || !input.dataset.typed)) { input.value = value; delete input.dataset.typed; }
  }
}
// What is to be acquired; nothing where a field is empty: the node then takes its own, or says what is missing.
function goal() {
  const [low, high, percent] = ["goal-low", "goal-high", "goal-target"].map((id) => $(id).valueAsNumber);
  return [low, high, percent].every(Number.isFinite) ? [low, high, percent / 100] : null;
}

function showTimeline(timeline) {
  $("timeline").hidden = !timeline;
  if (!timeline) return;
  $("time").max = timeline.count - 1;
  if (!state.seeking) $("time").value = timeline.index;
  $("clock").textContent = `${timeline.index + 1} of ${timeline.count}, ${timeline.time_s.toFixed(1)} of ${timeline.duration_s.toFixed(1)} s`;
}

// Reuses elements, so that what is being read or focused stays.
function fill(parent, items, tag, update) {
  while (parent.children.length > items.length) parent.lastElementChild.remove();
  items.forEach((item, k) => update(parent.children[k] ?? parent.appendChild(document.createElement(tag)), item));
}
function setText(element, text) { if (element.textContent !== text) element.textContent = text; }

// -- drawing -----------------------------------------------------------------------------------------

function visible(name) {
  if (!state.header?.available.includes(name)) return false;
  if (state.layout === "both") return true;
  if (state.layout === "blink") return state.blink === name || state.header.available.length === 1;
  return state.layout === name;
}
function layOut() {
  let count = 0;
  for (const [name, figure] of Object.entries(figures)) { figure.hidden = !visible(name); count += visible(name); }
  $("pictures").className = `${state.layout} ${count === 1 ? "one" : ""} ${state.tool === "move" ? "moving" : ""}`;
}

function draw() {
  for (const [name, canvas] of Object.entries(canvases)) {
    const picture = state.shown[name];
    if (!picture || figures[name].hidden) continue;
    const [, , w, h] = picture.region;
    canvas.style.aspectRatio = `${w} / ${h}`;
    const ratio = Math.min(devicePixelRatio, 2);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientWidth * ratio * h / w);
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    const pen = canvas.getContext("2d");
    // Pixels of a zoomed picture are to be seen as such.
    pen.imageSmoothingEnabled = picture.bitmap.width > width || picture.bitmap.width / width > 0.5;
    pen.drawImage(picture.bitmap, 0, 0, width, height);
    pen.lineJoin = pen.lineCap = "round";
    pen.font = `${13 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
    drawBar(pen, picture, ratio, width, height);
    if (name === "raw") drawArrow(pen, picture, ratio, width, height);
    else drawMoving(pen, picture, ratio);
    drawRuler(pen, name, picture, ratio);
  }
}
function line(pen, ratio, colour, points) {
  for (const [style, wide] of [["rgb(0 0 0 / .8)", 5], [colour, 2]]) {
    pen.strokeStyle = style; pen.lineWidth = wide * ratio; pen.beginPath();
    points.forEach(([x, y], k) => (k ? pen.lineTo(x, y) : pen.moveTo(x, y)));
    pen.stroke();
  }
}
function label(pen, ratio, text, x, y, align = "left") {
  pen.textAlign = align; pen.textBaseline = "bottom";
  const canvas = pen.canvas, half = pen.measureText(text).width / 2 + 4 * ratio;
  if (align === "center") x = Math.min(Math.max(x, half), canvas.width - half);
  pen.strokeStyle = "rgb(0 0 0 / .85)"; pen.lineWidth = 4 * ratio; pen.strokeText(text, x, y);
  pen.fillStyle = "#fff"; pen.fillText(text, x, y);
}
function drawBar(pen, picture, ratio, width, height) {
  if (!picture.scale) return;
  const length = picture.scale.bar_px * width / picture.region[2];
  const right = width - 12 * ratio, y = height - 12 * ratio;
  const plate = Math.max(length, pen.measureText(picture.scale.bar_label).width) + 12 * ratio;
  pen.fillStyle = "rgb(0 0 0 / .55)";
  pen.fillRect(right + 6 * ratio - plate, y - 26 * ratio, plate, 33 * ratio);
  line(pen, ratio, "#fff", [[right - length, y], [right, y]]);
  label(pen, ratio, picture.scale.bar_label, right, y - 6 * ratio, "right");
}
function drawArrow(pen, picture, ratio, width, height) {
  const drift = state.header.drift_px;
  if (!drift) return;
  const scale = width / picture.region[2], shown = Math.hypot(...drift) * scale;
  // A few pixels cannot be seen as an arrow: it is drawn ten or a hundred times as long, and says so.
  const times = [1, 10, 100].find((k) => k * shown >= 16 * ratio);
  if (!times) return;
  const [dx, dy] = drift.map((v) => times * v * scale), length = times * shown, words = times > 1 ? `drift ×${times}` : "drift";
  const x = width / 2, y = height / 2, head = Math.min(10 * ratio, length / 2), angle = Math.atan2(dy, dx);
  const end = [x + dx, y + dy];
  const wing = (turn) => [end[0] - head * Math.cos(angle + turn), end[1] - head * Math.sin(angle + turn)];
  line(pen, ratio, "#ffb86b", [[x, y], end]);
  line(pen, ratio, "#ffb86b", [wing(0.5), end, wing(-0.5)]);
  // Beyond the tip, where it hides nothing of the arrow; the text stands on its place.
  const [ux, uy] = [dx / length, dy / length], away = 8 * ratio, half = pen.measureText(words).width / 2;
  label(pen, ratio, words, end[0] + ux * (half + away), Math.max(end[1] + uy * 2 * away + 8 * ratio, 20 * ratio), "center");
}
function drawMoving(pen, picture, ratio) {
  for (const points of state.header.moving ?? []) {
    const places = points.map((point) => toScreen(picture, point, pen.canvas));
    line(pen, ratio, "#ff8fa3", [...places, places[0]]);
    const [x, y] = [0, 1].map((axis) => places.reduce((sum, place) => sum + place[axis], 0) / places.length);
    label(pen, ratio, "moves by itself", x, y, "center");
  }
}
function toScreen(picture, [x, y], canvas) {
  const [left, top, w] = picture.region, scale = canvas.width / w;
  return [(x - left + 0.5) * scale, (y - top + 0.5) * scale];
}
function drawRuler(pen, name, picture, ratio) {
  if (!state.ruler || state.ruler.picture !== name) return;
  const start = toScreen(picture, state.ruler.start, pen.canvas), end = toScreen(picture, state.ruler.end, pen.canvas);
  line(pen, ratio, "#7cc4ff", [start, end]);
  const angle = Math.atan2(end[1] - start[1], end[0] - start[0]) + Math.PI / 2, tick = 6 * ratio;
  for (const [x, y] of [start, end]) {
    line(pen, ratio, "#7cc4ff", [[x - tick * Math.cos(angle), y - tick * Math.sin(angle)], [x + tick * Math.cos(angle), y + tick * Math.sin(angle)]]);
  }
  if (state.rulerText) label(pen, ratio, state.rulerText, (start[0] + end[0]) / 2, Math.max(Math.min(start[1], end[1]) - 8 * ratio, 20 * ratio), "center");
}

function drawTrace() {
  const canvas = $("trace"), ratio = Math.min(devicePixelRatio, 2);
  canvas.hidden = state.trace.length < 2;
  if (canvas.hidden) return;
  canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.clientHeight * ratio);
  const pen = canvas.getContext("2d"), xs = state.trace.map((p) => p[0]), ys = state.trace.map((p) => p[1]);
  const middle = (v) => (Math.min(...v) + Math.max(...v)) / 2, span = (v) => Math.max(...v) - Math.min(...v);
  // The same scale in both directions; below a nanometre, or two 1-sigmas to either side, only noise would be seen.
  const margin = 24 * ratio, least = Math.max(1, 4 * state.traceSigma);
  const scale = Math.min((canvas.width - margin) / Math.max(span(xs), least), (canvas.height - 2 * margin) / Math.max(span(ys), least));
  const place = ([x, y]) => [canvas.width / 2 + (x - middle(xs)) * scale, canvas.height / 2 + (y - middle(ys)) * scale - margin / 4];
  pen.strokeStyle = "#ffb86b"; pen.lineWidth = 1.5 * ratio; pen.lineJoin = "round"; pen.beginPath();
  state.trace.forEach((p, k) => { const [x, y] = place(p); if (k) pen.lineTo(x, y); else pen.moveTo(x, y); });
  pen.stroke();
  const [x, y] = place(state.traceAt ?? state.trace.at(-1));
  pen.fillStyle = "#fff"; pen.beginPath(); pen.arc(x, y, 3.5 * ratio, 0, 7); pen.fill();
  const wide = canvas.width / scale / 4, round = 10 ** Math.floor(Math.log10(wide));
  const nm = [5, 2, 1].map((k) => k * round).find((v) => v <= wide);
  pen.font = `${12 * ratio}px system-ui, "DejaVu Sans", sans-serif`;
  const bottom = canvas.height - 8 * ratio;
  line(pen, ratio, "#fff", [[10 * ratio, bottom], [10 * ratio + nm * scale, bottom]]);
  label(pen, ratio, nm >= 1000 ? `${nm / 1000} µm` : `${nm} nm`, 10 * ratio, bottom - 5 * ratio);
}

// -- measuring, zooming, moving ------------------------------------------------------------------------

function placeOf(name, event) {
  const picture = state.shown[name], box = canvases[name].getBoundingClientRect();
  if (!picture) return null;
  const [left, top, w, h] = picture.region;
  return [left + (event.clientX - box.left) / box.width * w - 0.5, top + (event.clientY - box.top) / box.height * h - 0.5];
}
function placedTo(name) { const p = state.shown[name]; return p ? p.region[2] / canvases[name].clientWidth : 1; }
let cursorAsked = 0;
function measureCursor(name, end) {
  const now = performance.now();
  if (now - cursorAsked < 40) return;
  cursorAsked = now;
  send({ type: "measure", of: "cursor", picture: name, start: null, end, placed_to: placedTo(name) });
}
function measureRuler() {
  state.measuredAt = performance.now();
  const { picture, start, end } = state.ruler;
  send({ type: "measure", of: "ruler", picture, start, end, placed_to: placedTo(picture) });
}
function showMeasured(m) {
  if (m.of === "cursor") {
    const sigma = m.sigma_nm === null ? "" : `, ± ${(m.sigma_nm / 1000).toPrecision(2)}`;
    $("cursor").textContent = `x ${m.x}, y ${m.y} µm from the middle${sigma}`;
  } else if (state.ruler) {
    state.rulerText = m.text;
    $("ruler").textContent = `${m.text} at ${m.angle_deg.toFixed(1)}°`;
    $("why").textContent = m.why;
    draw();
  }
}
function setZoom(zoom, anchor = null) {
  const before = state.zoom;
  state.zoom = Math.min(Math.max(zoom, 1), MOST_ZOOM);
  if (anchor) {
    // What is under the pointer stays there.
    const k = before / state.zoom;
    state.centre = state.centre.map((c, i) => anchor[i] + (c - anchor[i]) * k);
  }
  holdCentre();
  $("zoom").textContent = `${state.zoom >= 10 ? state.zoom.toFixed(0) : +state.zoom.toFixed(1)}×`;
  sendRequest();
}
function holdCentre() {
  const half = 0.5 / state.zoom;
  state.centre = state.centre.map((c) => Math.min(Math.max(c, half), 1 - half));
}

for (const [name, canvas] of Object.entries(canvases)) {
  canvas.addEventListener("pointerdown", (event) => {
    const place = placeOf(name, event);
    if (!place || event.button) return;
    canvas.setPointerCapture(event.pointerId);
    state.drag = { name, place, x: event.clientX, y: event.clientY, centre: state.centre };
    if (state.tool === "ruler") { state.ruler = { picture: name, start: place, end: place }; state.rulerText = ""; }
  });
  canvas.addEventListener("pointermove", (event) => {
    const place = placeOf(name, event);
    if (!place) return;
    measureCursor(name, place);
    if (state.drag?.name !== name) return;
    if (state.tool === "ruler") {
      state.ruler.end = place;
      if (performance.now() - state.measuredAt > 40) measureRuler();
      draw();
    } else {
      const box = canvas.getBoundingClientRect();
      state.centre = [state.drag.centre[0] - (event.clientX - state.drag.x) / box.width / state.zoom,
        state.drag.centre[1] - (event.clientY - state.drag.y) / box.height / state.zoom];
      holdCentre();
      sendRequest();
    }
  });
  const end = (event) => {
    if (state.drag && state.tool === "ruler") {
      // A click without a way takes the ruler away.
      if (Math.hypot(event.clientX - state.drag.x, event.clientY - state.drag.y) < 3) {
        state.ruler = null; state.rulerText = ""; $("ruler").textContent = "drag over a picture"; $("why").textContent = "";
      } else measureRuler();
      draw();
    }
    state.drag = null;
  };
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const place = placeOf(name, event), picture = state.shown[name];
    if (place) setZoom(state.zoom * (event.deltaY < 0 ? 1.25 : 0.8), [(place[0] + 0.5) / picture.size[0], (place[1] + 0.5) / picture.size[1]]);
  }, { passive: false });
}

// -- buttons -------------------------------------------------------------------------------------------

function press(buttons, chosen) { for (const b of buttons) b.setAttribute("aria-pressed", String(b === chosen)); }
for (const button of all("[data-layout]")) {
  button.addEventListener("click", () => { state.layout = button.dataset.layout; press(all("[data-layout]"), button); layOut(); sendRequest(); draw(); });
}
for (const button of all("[data-tool]")) {
  button.addEventListener("click", () => { state.tool = button.dataset.tool; press(all("[data-tool]"), button); layOut(); });
}
for (const button of all("[data-action]")) {
  button.addEventListener("click", () => {
    answer(`${button.textContent} …`, "");
    send({ type: "act", action: button.dataset.action, ...(button.dataset.action === "acquire" && { value: goal() }) });
  });
}
for (const id of ["goal-low", "goal-high", "goal-target"]) $(id).addEventListener("input", () => { $(id).dataset.typed = "yes"; });
$("zoom-in").addEventListener("click", () => setZoom(state.zoom * 1.5, state.centre));
$("zoom-out").addEventListener("click", () => setZoom(state.zoom / 1.5, state.centre));
$("zoom-all").addEventListener("click", () => { state.centre = [0.5, 0.5]; setZoom(1); });
$("contrast").addEventListener("change", () => {
  state.contrast = $("contrast").value;
  $("low").disabled = $("high").disabled = state.contrast !== "fixed";
  sendRequest();
});
for (const id of ["low", "high"]) {
  $(id).addEventListener("input", () => {
    state[id] = Number($(id).value);
    const least = Number($("low").step) || 1;
    if (state.low >= state.high) {
      if (id === "low") state.high = state.low + least; else state.low = state.high - least;
      $("low").value = state.low; $("high").value = state.high;
    }
    sendRequest();
  });
}
$("time").addEventListener("input", () => { state.seeking = true; send({ type: "act", action: "seek", value: Number($("time").value) }); });
$("time").addEventListener("change", () => { setTimeout(() => { state.seeking = false; }, 400); });
setInterval(() => {
  if (state.layout !== "blink") return;
  state.blink = state.blink === "raw" ? "corrected" : "raw";
  layOut(); draw();
}, BLINK_MS);
addEventListener("resize", () => { sendRequest(); draw(); drawTrace(); });
connect();
