"use strict";

const MARGIN = { left: 46, right: 8, top: 6, bottom: 20 };
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const color = (number) => css(`--c${number % 5}`);

function floats(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Float32Array(bytes.buffer);
}

function add(parent, tag, text, className) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  parent.append(element);
  return element;
}

function context(canvas, height) {
  const scale = window.devicePixelRatio || 1;
  const width = Math.max(canvas.parentElement.clientWidth, 80);
  canvas.style.height = `${height}px`;
  canvas.width = Math.round(width * scale);
  canvas.height = Math.round(height * scale);
  const c = canvas.getContext("2d");
  c.scale(scale, scale);
  c.font = "11px system-ui, sans-serif";
  return [c, width];
}

function steps(low, high, count) {
  const rough = (high - low) / count || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= rough);
  const found = [];
  for (let n = Math.ceil(low / step); n * step <= high + step * 1e-6; n++) found.push(n * step);
  return found;
}

function shown(value) {
  if (!Number.isFinite(value)) return "-";
  return Math.abs(value) >= 1000 ? value.toFixed(0) : String(Number(value.toPrecision(4)));
}

function lastAtOrBefore(sorted, value) {
  let low = 0, high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= value) low = middle + 1; else high = middle;
  }
  return low - 1;
}

function axes(c, width, height, box, x, y) {
  c.strokeStyle = css("--rule");
  c.fillStyle = css("--muted");
  c.lineWidth = 1;
  c.textBaseline = "middle";
  c.textAlign = "right";
  for (const value of steps(y.low, y.high, Math.max(2, height / 40))) {
    const at = y.at(value);
    c.beginPath(); c.moveTo(box.left, at); c.lineTo(box.right, at); c.stroke();
    c.fillText(shown(value), box.left - 5, Math.min(Math.max(at, 6), box.bottom));
  }
  c.textBaseline = "alphabetic";
  c.textAlign = "center";
  for (const value of steps(x.low, x.high, Math.max(2, width / 90))) {
    const at = x.at(value);
    if (at > box.left + 4 && at < box.right - 14) c.fillText(shown(value), at, height - 5);
  }
}

function scaleOf(low, high, from, to) {
  const span = high - low || 1;
  return { low, high, at: (value) => from + ((value - low) / span) * (to - from) };
}

/** What all plots of a flight share: the time that is looked at, and the window that is shown. */
class Timeline {
  constructor(end) {
    this.end = end;
    this.window = [0, end];
    this.cursor = null;
    this.listeners = [];
    this.players = [];
  }
  /** Goes to a moment, also where a video plays, and shows a second on either side. */
  jump(t) {
    for (const player of this.players) player.pause();
    this.cursor = t;
    this.zoom(Math.max(t - 1, 0), Math.min(t + 1, this.end));
  }
  look(t) { this.cursor = t; this.tell(); }
  zoom(from, to) { this.window = [from, to]; this.tell(); }
  tell() { for (const listener of this.listeners) listener(); }
}

class Plot {
  constructor(parent, plot, t, timeline) {
    Object.assign(this, { plot, t, timeline, height: plot.height || 120 });
    add(parent, "h2", plot.unit ? `${plot.title} [${plot.unit}]` : plot.title);
    this.legend = add(parent, "div", undefined, "legend");
    const holder = add(parent, "div");
    this.canvas = add(holder, "canvas");
    this.values = plot.series.map((series) => floats(series.values));
    this.texts = plot.series.map((series, number) => {
      const item = add(this.legend, "span");
      const name = add(item, "b", `${series.name} `);
      name.dataset.color = number;
      return add(item, "span");
    });
    this.listen();
    timeline.listeners.push(() => this.draw());
  }
  listen() {
    let from = null;
    const timeAt = (event) => {
      const box = this.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right);
      const [low, high] = this.timeline.window;
      return low + Math.min(Math.max(share, 0), 1) * (high - low);
    };
    this.canvas.addEventListener("pointermove", (event) => this.timeline.look(timeAt(event)));
    this.canvas.addEventListener("pointerdown", (event) => { from = timeAt(event); });
    this.canvas.addEventListener("pointerup", (event) => {
      const to = timeAt(event);
      const [low, high] = this.timeline.window;
      if (from !== null && Math.abs(to - from) > (high - low) / 100) {
        this.timeline.zoom(Math.min(from, to), Math.max(from, to));
      }
      from = null;
    });
    this.canvas.addEventListener("dblclick", () => this.timeline.zoom(0, this.timeline.end));
  }
  range(first, last) {
    if (this.plot.range) return this.plot.range;
    let low = Infinity, high = -Infinity;
    for (const values of this.values) {
      for (let k = first; k <= last; k++) {
        if (values[k] < low) low = values[k];
        if (values[k] > high) high = values[k];
      }
    }
    for (const limit of this.plot.limits) high = Math.max(high, limit.value);
    if (this.plot.fromZero) low = Math.min(low, 0);
    if (this.plot.fromZero && !(high > 0)) return [0, 1];
    if (!(low < high)) { low = Number.isFinite(low) ? low - 1 : 0; high = low + 2; }
    const space = (high - low) * 0.06;
    return [this.plot.fromZero && low === 0 ? 0 : low - space, high + space];
  }
  draw() {
    const [c, width] = context(this.canvas, this.height);
    const box = {
      left: MARGIN.left, right: width - MARGIN.right, top: MARGIN.top, bottom: this.height - MARGIN.bottom,
    };
    const [from, to] = this.timeline.window;
    const first = Math.max(lastAtOrBefore(this.t, from), 0);
    const last = Math.min(lastAtOrBefore(this.t, to) + 1, this.t.length - 1);
    const x = scaleOf(from, to, box.left, box.right);
    const y = scaleOf(...this.range(first, last), box.bottom, box.top);
    axes(c, width, this.height, box, x, y);
    c.fillText("s", box.right - 3, this.height - 5);
    c.save();
    c.beginPath(); c.rect(box.left, 0, box.right - box.left, this.height); c.clip();
    for (const limit of this.plot.limits) {
      const at = y.at(limit.value);
      c.strokeStyle = c.fillStyle = css("--bad"); c.lineWidth = 1; c.setLineDash([5, 4]);
      c.beginPath(); c.moveTo(box.left, at); c.lineTo(box.right, at); c.stroke();
      c.setLineDash([]); c.textAlign = "left"; c.textBaseline = "top";
      c.fillText(`${limit.name} ${shown(limit.value)} ${this.plot.unit}`, box.left + 4, at + 2);
    }
    this.values.forEach((values, number) => {
      c.lineWidth = this.plot.series[number].width;
      c.globalAlpha = c.lineWidth > 2 ? 0.4 : 1; // a wide line lies under the others
      this.line(c, values, color(number), first, last, x, y);
      c.globalAlpha = 1;
    });
    if (this.timeline.cursor !== null) {
      c.strokeStyle = css("--ink"); c.lineWidth = 1;
      const at = x.at(this.timeline.cursor);
      c.beginPath(); c.moveTo(at, box.top); c.lineTo(at, box.bottom); c.stroke();
    }
    c.restore();
    this.tellValues();
  }
  line(c, values, stroke, first, last, x, y) {
    c.strokeStyle = stroke; c.lineJoin = "round";
    c.beginPath();
    let column = null, low = 0, high = 0, isDown = false;
    const flush = () => {
      if (column === null) return;
      if (isDown) c.lineTo(column, y.at(low)); else c.moveTo(column, y.at(low));
      c.lineTo(column + (low === high ? 0.8 : 0), y.at(high)); // a lone point is seen, too
      isDown = true; column = null;
    };
    for (let k = first; k <= last; k++) {
      const value = values[k];
      if (Number.isNaN(value)) { flush(); isDown = false; continue; }
      const at = Math.round(x.at(this.t[k]));
      if (at !== column) { flush(); column = at; low = high = value; }
      low = Math.min(low, value); high = Math.max(high, value);
    }
    flush();
    c.stroke();
  }
  tellValues() {
    const index = this.timeline.cursor === null ? -1 : lastAtOrBefore(this.t, this.timeline.cursor);
    this.texts.forEach((text, number) => {
      text.previousSibling.style.color = color(number);
      text.textContent = index < 0 ? "" : shown(this.values[number][index]);
    });
  }
}

class Bands {
  constructor(parent, flight, timeline) {
    Object.assign(this, { flight, timeline });
    add(parent, "h2", "Who held the sticks");
    const legend = add(parent, "div", undefined, "legend");
    const names = { policy: "policy", "read-only": "policy, nothing sent", idle: "idle, before the flight",
      neutral: "neutral, on the way out", release: "release", pilot: "pilot or autopilot" };
    for (const [name, text] of Object.entries(names)) {
      if (!flight.holders.some((span) => span.holder === name)) continue;
      const item = add(legend, "span");
      add(item, "b", "■ ").dataset.holder = name;
      add(item, "span", text);
    }
    this.legend = legend;
    this.reason = add(parent, "div", "", "legend");
    this.canvas = add(add(parent, "div"), "canvas");
    this.canvas.addEventListener("pointermove", (event) => {
      const box = this.canvas.getBoundingClientRect();
      const [low, high] = timeline.window;
      const share = (event.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right);
      timeline.look(low + Math.min(Math.max(share, 0), 1) * (high - low));
    });
    timeline.listeners.push(() => this.draw());
  }
  color(holder) { return css(`--${holder === "read-only" ? "c4" : holder}`); }
  draw() {
    const height = 26;
    const [c, width] = context(this.canvas, height);
    for (const item of this.legend.querySelectorAll("b")) item.style.color = this.color(item.dataset.holder);
    const x = scaleOf(...this.timeline.window, MARGIN.left, width - MARGIN.right);
    c.save();
    c.beginPath(); c.rect(MARGIN.left, 0, width - MARGIN.left - MARGIN.right, height); c.clip();
    for (const span of this.flight.holders) {
      c.fillStyle = this.color(span.holder);
      c.fillRect(x.at(span.start_s), 2, Math.max(x.at(span.end_s) - x.at(span.start_s), 1), height - 6);
    }
    const cursor = this.timeline.cursor;
    if (cursor !== null) { c.fillStyle = css("--ink"); c.fillRect(x.at(cursor), 0, 1, height); }
    c.restore();
    const span = this.flight.holders.find((s) => cursor !== null && s.start_s <= cursor && cursor <= s.end_s);
    this.reason.textContent = cursor === null ? "" : `${cursor.toFixed(2)} s: ${span ? span.holder : "-"}` +
      (span && span.reason ? `: ${span.reason}` : "");
  }
}

/** The path from above and in three dimensions; the latter turns by the mouse. */
class Path {
  constructor(parent, flight, timeline) {
    Object.assign(this, { flight, timeline, turn: -0.7, tilt: 0.5 });
    this.t = floats(flight.track.t);
    const [n, e, d] = [flight.track.north, flight.track.east, flight.track.down].map(floats);
    this.points = Array.from(n, (_, k) => [e[k], n[k], -d[k]]);
    this.gates = flight.gates.map((gate) => this.corners(gate));
    const pair = add(parent, "div", undefined, "pair");
    this.canvases = ["From above [m]: north is up, east is right", "Path: drag to turn it"].map((title) => {
      const side = add(pair, "div");
      add(side, "h2", title);
      return add(add(side, "div"), "canvas");
    });
    this.canvases[1].style.cursor = "grab";
    this.canvases[1].style.touchAction = "none";
    this.canvases[1].addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      this.turn += event.movementX / 120;
      this.tilt = Math.min(Math.max(this.tilt + event.movementY / 120, 0.02), 1.55);
      this.draw();
    });
    timeline.listeners.push(() => this.draw());
  }
  corners(gate) {
    const half = gate.size_m / 2, [n, e, d] = gate.center_ned_m;
    const [across_e, across_n] = [Math.cos(gate.yaw_rad), -Math.sin(gate.yaw_rad)];
    return [[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]].map(([side, up]) =>
      [e + side * half * across_e, n + side * half * across_n, -d + up * half]);
  }
  draw() {
    const height = 260;
    this.canvases.forEach((canvas, view) => {
      const [c, width] = context(canvas, height);
      const project = view === 0 ? ([e, n]) => [e, n] : ([e, n, up]) => {
        const right = e * Math.cos(this.turn) - n * Math.sin(this.turn);
        const away = e * Math.sin(this.turn) + n * Math.cos(this.turn);
        return [right, away * Math.sin(this.tilt) + up * Math.cos(this.tilt)];
      };
      const ground = view === 0 ? [] : this.points.map(([e, n]) => [e, n, 0]);
      const all = [...this.points, ...ground, ...this.gates.flat()].map(project);
      const xs = all.map((p) => p[0]), ys = all.map((p) => p[1]);
      const bounds = (values) => values.reduce(([a, b], v) => [Math.min(a, v), Math.max(b, v)], [Infinity, -Infinity]);
      const [left, right] = bounds(xs), [low, high] = bounds(ys);
      const inner = [width - MARGIN.left - 14, height - 38];
      const scale = Math.min(inner[0] / Math.max(right - left, 1), inner[1] / Math.max(high - low, 1));
      const middle = [(left + right) / 2, (low + high) / 2];
      const at = (point) => {
        const [x, y] = project(point);
        return [MARGIN.left + inner[0] / 2 + (x - middle[0]) * scale, 12 + inner[1] / 2 - (y - middle[1]) * scale];
      };
      if (view === 0) this.mapAxes(c, width, height, middle, scale, inner);
      const trace = (points, stroke, lineWidth) => {
        c.strokeStyle = stroke; c.lineWidth = lineWidth;
        c.beginPath();
        points.forEach((point, k) => { const [x, y] = at(point); if (k) c.lineTo(x, y); else c.moveTo(x, y); });
        c.stroke();
      };
      if (view === 1) trace(ground, css("--rule"), 1.5);
      for (const gate of this.gates) trace(gate, color(1), 2);
      trace(this.points, color(0), 2);
      const index = this.timeline.cursor === null ? -1 : lastAtOrBefore(this.t, this.timeline.cursor);
      const marks = [[this.points[0], color(2)]];
      if (index >= 0) marks.push([this.points[index], css("--ink")]);
      for (const [point, fill] of marks) {
        c.fillStyle = fill;
        c.beginPath(); c.arc(...at(point), 4, 0, 2 * Math.PI); c.fill();
      }
    });
  }
  mapAxes(c, width, height, middle, scale, inner) {
    const half = [inner[0] / 2 / scale, inner[1] / 2 / scale];
    const box = { left: MARGIN.left, right: MARGIN.left + inner[0], top: 12, bottom: 12 + inner[1] };
    const x = scaleOf(middle[0] - half[0], middle[0] + half[0], box.left, box.right);
    const y = scaleOf(middle[1] - half[1], middle[1] + half[1], box.bottom, box.top);
    axes(c, width, height, box, x, y);
  }
}

function addVideo(parent, video, timeline) {
  add(parent, "h2", "What the policy saw");
  if (!video.source) { add(parent, "p", video.note, "help"); return; }
  const player = add(parent, "video");
  player.controls = true; player.muted = true; player.preload = "auto";
  player.src = video.source;
  timeline.players.push(player);
  const exposed = floats(video.exposed_s);
  timeline.listeners.push(() => {
    if (timeline.cursor === null || !player.paused) return;
    const image = Math.max(lastAtOrBefore(exposed, timeline.cursor), 0);
    player.currentTime = exposed[image] - exposed[0] + 0.001;
  });
  player.addEventListener("timeupdate", () => {
    const image = lastAtOrBefore(exposed, exposed[0] + player.currentTime);
    if (!player.paused && image >= 0) timeline.look(exposed[image]);
  });
}

function addMoments(parent, moments, timeline) {
  add(parent, "h2", "The worst moments, the worst one first");
  if (!moments.length) { add(parent, "p", "No moment went wrong.", "help"); return; }
  const table = add(parent, "table");
  const head = add(table, "tr");
  for (const name of ["s", "what", "what happened"]) add(head, "th", name);
  for (const moment of moments) {
    const row = add(table, "tr");
    row.dataset.t = moment.t_s;
    row.tabIndex = 0;
    for (const text of [moment.t_s.toFixed(2), moment.what, moment.detail]) add(row, "td", text);
    const go = () => timeline.jump(moment.t_s);
    row.addEventListener("click", go);
    row.addEventListener("keydown", (event) => { if (event.key === "Enter") go(); });
  }
}

function addFlight(parent, flight) {
  const section = add(parent, "section");
  const timeline = new Timeline(flight.end_s);
  add(section, "h1", flight.name);
  if (flight.outcome) add(section, "p", flight.outcome.text, `outcome ${flight.outcome.verdict}`);
  const facts = add(section, "dl");
  for (const [label, text, isBad] of flight.facts) {
    add(facts, "dt", label);
    add(facts, "dd", text, isBad ? "bad" : "");
  }
  addMoments(section, flight.moments, timeline);
  new Bands(section, flight, timeline);
  if (flight.track) new Path(section, flight, timeline);
  if (flight.video) addVideo(section, flight.video, timeline);
  const t = floats(flight.t);
  for (const plot of flight.plots) new Plot(section, plot, t, timeline);
  timeline.tell();
  return timeline;
}

const flights = JSON.parse(document.getElementById("data").textContent);
const timelines = flights.map((flight) => addFlight(document.getElementById("flights"), flight));
const redraw = () => timelines.forEach((timeline) => timeline.tell());
window.addEventListener("resize", redraw);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
document.documentElement.dataset.drawn = flights.length;
