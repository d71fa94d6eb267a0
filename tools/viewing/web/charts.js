"use strict";
// Draw plots versus time with a common time axis and cursor. A row is [number, time, mode, values …],
// where null is a missing value.
//
// This module does not use a plotting package. uPlot takes the same time to draw, but the Python
// package that contains uPlot requires IPython. Plotly takes seven times as long and has 4.8 MB.

const [TIME, MODE] = [1, 2];
const KEPT = 6000;  // number of rows, enough for ten minutes
const READABLE = 180;  // minimum time between updates of a number, for readability [ms]

const inks = new Map();
const ink = name => inks.get(name)
  ?? inks.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim()).get(name);

// Canvas context and size in CSS pixels. An observer reports the size, because reading the size would force a layout.
class Surface {
  constructor(canvas, changed) {
    [this.canvas, this.pen, this.width, this.height] = [canvas, canvas.getContext("2d"), 0, 0];
    new ResizeObserver(([{ contentRect: { width, height } }]) => {
      [this.width, this.height] = [width, height];
      changed();
    }).observe(canvas);
  }

  // Clear the canvas. Return false if the canvas is not visible.
  clear() {
    const ratio = window.devicePixelRatio || 1, { canvas, pen } = this;
    const [width, height] = [this.width, this.height].map(side => Math.round(ratio * side));
    if (!width || !height) return false;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.font = "11px system-ui, sans-serif";
    return true;
  }
}

class History {
  rows = [];

  // Add rows. Drop rows before number `first`, which belong to another daemon or recording position.
  add(rows, first) {
    if (this.rows.length && this.rows[0][0] < first) this.rows = this.rows.filter(row => row[0] >= first);
    this.rows.push(...rows.filter(row => row[0] >= first && row[0] > (this.rows.at(-1)?.[0] ?? -1)));
    if (this.rows.length > KEPT) this.rows.splice(0, this.rows.length - KEPT);
  }

  // Return the index of the first row at or after the given time.
  from(time) {
    let [low, high] = [0, this.rows.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.rows[middle][TIME] < time) low = middle + 1; else high = middle;
    }
    return low;
  }

  near(time) {
    const k = this.from(time), [before, after] = [this.rows[k - 1], this.rows[k]];
    if (!before || !after) return before ?? after;
    return time - before[TIME] < after[TIME] - time ? before : after;
  }
}

// Cursor time and common time range of all plots: `span` seconds before `end` or the newest row.
class View {
  span = 20;
  end = null;
  cursor = null;
  newest = null;  // row
  old = false;  // true if the stream is lost
  start = null;  // start time of a recording, null if live

  constructor(changed) { this.changed = changed; }

  get range() {
    const newest = this.newest?.[TIME] ?? 0;  // In the first seconds of a recording, the axis does not move.
    const end = this.end ?? (this.start === null ? newest : Math.max(newest, this.start + this.span));
    return [end - this.span, end];
  }

  zoom(factor, at = this.range[1]) {
    const [from, to] = this.range, share = (to - at) / (to - from);
    const span = Math.min(Math.max(this.span * factor, 0.5), 600);
    if (this.end !== null) this.end = at + share * span;
    this.span = span;
    this.changed();
  }

  select(from, to) {
    [this.span, this.end] = [Math.max(to - from, 0.2), to];
    this.changed();
  }

  hold(on) {
    this.end = on ? this.range[1] : null;
    this.changed();
  }

  follow() {
    [this.span, this.end, this.cursor] = [20, null, null];
    this.changed();
  }

  label(time, step) {
    const places = step < 1 ? 1 : 0;
    if (this.start !== null) return `${decimal(time - this.start, places)} s`;
    if (this.end === null) {
      const ago = this.range[1] - time;
      return ago < 0.5 * step ? this.old ? "last" : "now" : `−${ago.toFixed(places)} s`;
    }
    return clock(time) + (places ? (time % 1).toFixed(1).slice(1) : "");
  }
}

const clock = time => new Date(1e3 * time).toTimeString().slice(0, 8);

// Round a value up to the next round number: 1, 2 or 5 times a power of ten.
function round(value) {
  const decade = 10 ** Math.floor(Math.log10(value));
  return decade * [1, 2, 5, 10].find(step => step * decade >= value * (1 - 1e-9));
}

class Chart {
  static margin = { left: 46, right: 10, top: 8, bottom: 30 };

  constructor(parent, plot, history, view) {
    Object.assign(this, { plot, history, view, low: 0, high: 0 });
    this.figure = make(parent, "figure", "plot");
    const caption = make(this.figure, "figcaption");
    make(caption, "b", "", plot.title);
    make(caption, "span", "", plot.unit);
    const values = make(caption, "span", "values");
    this.age = make(caption, "span", "age");
    this.values = plot.lines.map(({ colour }) => {
      const value = make(values, "span");
      value.style.color = `var(--${colour})`;
      return value;
    });
    this.canvas = make(this.figure, "canvas");
    this.canvas.setAttribute("role", "img");
    this.surface = new Surface(this.canvas, () => this.draw());
    this.listen();
  }

  listen() {
    const { canvas, view } = this;
    const time = event => {
      const [from, to] = view.range, { left, right } = Chart.margin;
      const share = (event.offsetX - left) / (this.surface.width - left - right);
      return from + Math.min(Math.max(share, 0), 1) * (to - from);
    };
    canvas.addEventListener("pointerdown", event => {
      if (event.pointerType !== "mouse" || event.button) return;
      this.begun = time(event);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", event => {
      view.cursor = time(event);
      view.changed();
    });
    canvas.addEventListener("pointerup", event => {
      const [from, to] = [this.begun, time(event)].sort((a, b) => a - b), [left, right] = view.range;
      if (this.begun !== undefined && to - from > 0.02 * (right - left)) view.select(from, to);
      this.begun = undefined;
    });
    canvas.addEventListener("pointerleave", () => {
      this.begun = undefined;
      view.cursor = null;
      view.changed();
    });
    canvas.addEventListener("dblclick", () => view.follow());
    canvas.addEventListener("wheel", event => {
      if (!event.ctrlKey && !event.metaKey) return;  // Let the page scroll.
      event.preventDefault();
      view.zoom(event.deltaY > 0 ? 1.25 : 0.8, time(event));
    }, { passive: false });
  }

  // Return the visible rows and one additional row on each side.
  shown() {
    const { history, view } = this, [from, to] = view.range;
    const first = Math.max(history.from(from) - 1, 0);
    const rows = history.rows.slice(first, history.from(to) + 1);
    if (view.end === null && view.newest) rows.push(view.newest);
    return rows;
  }

  // Fit the scale to the values. The scale grows immediately, and shrinks once half of it is empty.
  rescale(rows) {
    let [low, high, least] = [Infinity, -Infinity, Infinity];
    for (const { column, spread } of this.plot.lines)
      for (const row of rows) {
        const value = row[column], around = spread === null ? 0 : row[spread] ?? 0;
        if (value === null || value === undefined) continue;
        least = Math.min(least, value);
        low = Math.min(low, value - around);
        high = Math.max(high, value + around);
      }
    if (low > high) [low, high] = this.high > this.low ? [this.low, this.high] : [0, this.plot.span];
    const span = Math.max(high - low, this.plot.span), middle = 0.5 * (low + high);
    const fits = Math.min(low, least) >= this.low - (least >= 0 ? Infinity : 0) && high <= this.high;
    if (fits && span > 0.5 * (this.high - this.low)) return;
    this.step = round(0.27 * span);
    this.low = this.step * Math.floor((middle - 0.52 * span) / this.step);
    this.high = this.step * Math.ceil((middle + 0.52 * span) / this.step);
    if (least >= 0) this.low = Math.max(this.low, 0);
  }

  draw() {
    if (!this.surface.clear()) return;
    const { surface: { pen, width, height }, view, plot } = this, [from, to] = view.range;
    const { left, right, top, bottom } = Chart.margin, rows = this.shown();
    this.rescale(rows);
    const wide = (width - left - right) / (to - from), high = (height - top - bottom) / (this.high - this.low);
    const x = time => left + wide * (time - from), y = value => top + high * (this.high - value);
    this.axes(x, y);
    pen.save();
    pen.beginPath();
    pen.rect(left, top - 2, width - left - right, height - top - bottom + 4);
    pen.clip();
    for (const line of plot.lines) if (line.spread !== null) this.band(line, rows, x, y);
    for (const line of plot.lines) this.line(line, rows, x, y);
    pen.restore();
    this.strip(rows, x);
    const at = view.cursor === null ? rows.at(-1) : this.history.near(view.cursor);
    if (view.cursor !== null && at) this.cursor(at, x, y);
    this.tell(at);
  }

  axes(x, y) {
    const { surface: { pen, width, height }, view } = this, [from, to] = view.range;
    const { left, right, bottom } = Chart.margin, foot = height - bottom;
    const digits = Math.max(0, -Math.floor(Math.log10(this.step) + 1e-9));
    pen.fillStyle = ink("muted");
    pen.strokeStyle = ink("grid");
    pen.lineWidth = 1;
    pen.beginPath();
    pen.textAlign = "right";
    for (let k = Math.round(this.low / this.step); k <= Math.round(this.high / this.step); k++) {
      const at = Math.round(y(k * this.step)) + 0.5;
      pen.moveTo(left, at);
      pen.lineTo(width - right, at);
      pen.fillText(decimal(k * this.step, digits), left - 6, at + 3.5);
    }
    const step = round((to - from) * 75 / Math.max(width - left - right, 75));
    const zero = view.start ?? (view.end === null ? to : 0);
    for (let k = Math.ceil((from - zero) / step - 1e-9); zero + k * step <= to + 1e-6; k++) {
      const at = Math.round(x(zero + k * step)) + 0.5, text = view.label(zero + k * step, step);
      pen.moveTo(at, foot);
      pen.lineTo(at, foot + 4);
      pen.textAlign = at > width - right - 20 ? "right" : "center";
      pen.fillText(text, Math.min(at, width - 2), height - 4);
    }
    pen.stroke();
  }

  // Draw a line. If a pixel contains several rows, draw the lowest and the highest value.
  line({ column, colour }, rows, x, y) {
    const { pen, width } = this.surface, each = Math.max(1, Math.floor(rows.length / width));
    pen.beginPath();
    let gap = true;
    const to = (time, value) => { pen[gap ? "moveTo" : "lineTo"](x(time), y(value)); gap = false; };
    for (let k = 0; k < rows.length; k += each) {
      let [low, high] = [Infinity, -Infinity];
      for (let i = k; i < k + each && i < rows.length; i++) {
        const value = rows[i][column];
        if (value === null || value === undefined) { gap = true; continue; }
        if (value < low) low = value;
        if (value > high) high = value;
      }
      if (low > high) { gap = true; continue; }
      to(rows[k][TIME], low);
      if (high > low) to(rows[k][TIME], high);
    }
    pen.strokeStyle = ink(colour);
    pen.lineWidth = 1;  // Without a graphics card, a wider line takes two and a half times as long to draw.
    pen.lineJoin = "round";
    pen.stroke();
  }

  band({ column, spread, colour }, rows, x, y) {
    const { pen, width } = this.surface, each = Math.max(1, Math.floor(rows.length / width));
    pen.fillStyle = ink(colour);
    pen.globalAlpha = 0.2;
    for (let k = 0; k < rows.length; k += each) {
      const edge = [];
      pen.beginPath();
      for (; k < rows.length && typeof rows[k][column] === "number" && typeof rows[k][spread] === "number"; k += each) {
        const { [TIME]: time, [column]: value, [spread]: around } = rows[k];
        pen.lineTo(x(time), y(value + around));
        edge.push([x(time), y(value - around)]);
      }
      for (const [px, py] of edge.reverse()) pen.lineTo(px, py);
      pen.fill();
    }
    pen.globalAlpha = 1;
  }

  strip(rows, x) {
    const { pen, width, height } = this.surface, { left, right, bottom } = Chart.margin;
    const bound = value => Math.min(Math.max(value, left), width - right);
    for (let k = 0; k < rows.length;) {
      const begin = k, mode = rows[k][MODE];
      while (k < rows.length && rows[k][MODE] === mode) k++;
      const from = bound(x(rows[begin][TIME])), to = bound(x(rows[Math.min(k, rows.length - 1)][TIME]));
      pen.fillStyle = ink(mode) || ink("muted");
      pen.fillRect(from, height - bottom + 6, to - from, 6);
    }
  }

  cursor(row, x, y) {
    const { pen, height, width } = this.surface, { left, top, bottom } = Chart.margin;
    const at = x(row[TIME]), text = this.view.label(row[TIME], 0.1);
    if (this.begun !== undefined) {
      pen.fillStyle = ink("stripe");
      pen.fillRect(x(this.begun), top, x(this.view.cursor) - x(this.begun), height - top - bottom);
    }
    pen.strokeStyle = pen.fillStyle = ink("text");
    pen.lineWidth = 1;
    pen.beginPath();
    pen.moveTo(at, top);
    pen.lineTo(at, height - bottom);
    pen.stroke();
    const half = 0.5 * pen.measureText(text).width + 4, middle = Math.min(Math.max(at, left + half), width - half);
    pen.fillRect(middle - half, height - 15, 2 * half, 15);
    pen.textAlign = "center";
    pen.fillStyle = ink("card");
    pen.fillText(text, middle, height - 4);
    for (const { column, colour } of this.plot.lines) {
      if (typeof row[column] !== "number") continue;
      pen.beginPath();
      pen.arc(at, y(row[column]), 3.5, 0, 7);
      pen.fillStyle = ink(colour);
      pen.fill();
    }
  }

  // Write the values to the caption and to the text for screen readers.
  tell(row) {
    const { plot, values, canvas, view } = this, words = [], now = performance.now();
    if (view.cursor === null && now < (this.written ?? 0) + READABLE) return;
    this.written = now;
    plot.lines.forEach(({ name, column, spread }, k) => {
      const value = row?.[column], around = spread === null ? null : row?.[spread];
      const digits = value >= 1000 ? 0 : Math.max(this.step < 0.1 ? 2 : 1, 0);
      const text = typeof value === "number" ? decimal(value, digits) : "—";
      put(values[k], `${name} ${text}${typeof around === "number" ? ` ± ${+around.toPrecision(2)}` : ""}`);
      words.push(`${name} ${text} ${plot.unit}`);
    });
    if (now < (this.told ?? 0) + 1000) return;
    this.told = now;
    const when = view.cursor === null ? "" : ` at ${view.label(row?.[TIME] ?? 0, 0.1)}`;
    canvas.setAttribute("aria-label", `${plot.title}${when}: ${words.join(", ")}`);
  }
}

// Format a number with the minus sign U+2212, but without a sign before zero.
function decimal(value, places) {
  const text = value.toFixed(places);
  return +text === 0 ? text.replace("-", "") : text.replace("-", "−");
}

function make(parent, kind, name = "", text = "") {
  const element = parent.appendChild(document.createElement(kind));
  if (name) element.className = name;
  element.textContent = text;
  return element;
}

// Set a text only if it has changed, because the browser lays out and paints every text that is set.
function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function give(element, name, value) {
  if (element.getAttribute(name) !== `${value}`) element.setAttribute(name, value);
}
