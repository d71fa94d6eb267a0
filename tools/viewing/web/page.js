
// Draw the pictures that the server sends. `tools.viewing.pictures` describes their contents.
let scene, picture, palette, panels = [], charts = [], headline = [], player, arrived = 0, connected = false, events = "";
const past = new History(), view = new View(() => redraw());
const images = new Map();  // panel images

const seconds = value => value < 10 ? value.toFixed(1) : Math.round(value).toString();
const elapsed = () => (performance.now() - arrived) / 1000;
// Return the current value of an age that was sent in a picture. A null age means that no message has arrived.
const aged = age => age === null ? Infinity : scene.live ? age + elapsed() : 0;
const isOld = () => aged(picture.age) > picture.patience.state + scene.period;

function layOut(next) {
  scene = next;
  images.clear();
  palette = scene.palette.map(([red, green, blue]) => red | green << 8 | blue << 16 | 255 << 24);
  document.querySelectorAll(".pictures, .plots, .headline").forEach(each => each.replaceChildren());
  panels = scene.panels.map(panel => {
    const box = make(one(panel.name === "landscape" ? "#more .pictures" : ".pictures"), "figure", panel.name);
    const caption = make(box, "figcaption"), canvas = make(box, "canvas");
    make(caption, "b", "", panel.title);
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", panel.title);
    const isMap = !panel.still && panel.name !== "hand";
    const made = { ...panel, box, limits: panel.box, note: make(caption, "span", "note"), age: make(caption, "span", "age"), canvas };
    made.surface = new Surface(canvas, () => picture && paint(made));
    if (isMap) {
      const bar = make(box, "div", "scale"), [low, ramp, high] = ["span", "i", "span"].map(kind => make(bar, kind));
      ramp.style.background = `linear-gradient(to right, ${scene.palette.map(colour => `rgb(${colour})`)})`;
      Object.assign(made, { low, high });
    }
    return made;
  });
  charts = scene.plots.map(plot => new Chart(one(plot.detail ? "#more .plots" : ".plots"), plot, past, view));
  headline = scene.plots.filter(plot => plot.headline !== null).map(({ title, unit, headline: decimals, lines }) => {
    const box = make(one(".headline"), "div");
    make(box, "h2", "", `${title}, ${unit}`);
    const row = make(box, "div");
    return { decimals, lines: lines.map(line => {
      const cell = make(row, "p"), value = make(cell, "span"), aside = make(cell, "small");
      value.style.color = `var(--${line.colour})`;
      return { ...line, value, aside };
    }) };
  });
  const colours = scene.modes.map(mode => `[data-mode=${mode}] { --mode: var(--${mode}) }`);
  put(one("#modes"), colours.join("\n"));
  scene.age = make(one(".headline"), "span", "age");
  if (settings.force && !picture) settings.force.value = scene.force_default;
}

// Draw an image's levels on a canvas of the same size. Levels beyond the palette are transparent.
function image({ rows, cols, data }, canvas = document.createElement("canvas")) {
  const levels = atob(data), pixels = new Uint32Array(levels.length);
  for (let k = 0; k < levels.length; k++) pixels[k] = palette[levels.charCodeAt(k)] ?? 0;
  if (canvas.width !== cols || canvas.height !== rows) [canvas.width, canvas.height] = [cols, rows];
  canvas.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(pixels.buffer), cols), 0, 0);
  return canvas;
}

// Draw a panel in the coordinates of its box (left, right, top, bottom).
function paint({ name, limits, equal, scaled, still: fixed = {}, surface, note, low, high }) {
  if (!surface.clear()) return;
  const drawn = picture.panels[name] ?? {}, [left, right, top, bottom] = limits, { pen, width, height } = surface;
  let wide = width / Math.abs(right - left), tall = height / Math.abs(bottom - top);
  if (equal) wide = tall = Math.min(wide, tall);
  const x = value => 0.5 * width + wide * (value - 0.5 * (left + right));
  const y = value => 0.5 * height + tall * Math.sign(bottom - top) * (value - 0.5 * (top + bottom));
  const under = fixed.image ?? drawn.image;
  pen.imageSmoothingEnabled = !!fixed.image;
  if (under) {
    if (!fixed.image || !images.has(name)) images.set(name, image(under, images.get(name)));
    const [from, to, above, below] = under.box;
    pen.drawImage(images.get(name), x(from), y(above), x(to) - x(from), y(below) - y(above));
  }
  for (const [named, thick, points] of drawn.lines ?? []) {
    pen.beginPath();
    for (let k = 0; k < points.length; k += 2) pen.lineTo(x(points[k]), y(points[k + 1]));
    pen.strokeStyle = ink(under ? `${named}-map` : named);
    pen.lineWidth = scaled ? Math.max(0.7, wide * thick) : thick;
    pen.lineJoin = "round";
    pen.stroke();
  }
  for (const [named, px, py] of drawn.dots ?? []) {
    pen.beginPath();
    pen.arc(x(px), y(py), 4.5, 0, 7);
    pen.fillStyle = ink(`${named}-map`);
    pen.fill();
    [pen.strokeStyle, pen.lineWidth] = ["#fff", 1.5];
    pen.stroke();
  }
  pen.textAlign = "center";
  for (const [named, px, py, text] of fixed.texts ?? []) {
    pen.fillStyle = ink("muted");
    pen.fillText(text, x(px), y(py) + 4);
  }
  pen.font = "600 13px system-ui, sans-serif";
  for (const [named, px, py, text] of drawn.texts ?? []) {
    pen.fillStyle = ink(named);
    pen.fillText(text, x(px), y(py) + 4);
  }
  put(note, drawn.note ?? "");
  if (low) [[low, 0], [high, 1]].forEach(([end, k]) => put(end, drawn.scale?.[k] ?? ""));
}

function show() {
  const { row, fault } = picture;
  if (player) player.show();
  if (settings.force) showControls();
  put(one(".fault"), fault ? `Fault: ${fault}` : "");
  one(".fault").hidden = !fault;
  const { failed } = picture.recording, notes = failed ? [failed, ...picture.notes] : picture.notes;
  list(one(".notes"), notes, (item, note) => put(item, note));
  one(".notes").title = notes.join("\n");
  const readable = performance.now() > (show.read ?? 0) + READABLE;
  if (readable) show.read = performance.now();
  for (const { decimals, lines } of readable ? headline : [])
    for (const { value, aside, name, column, spread } of lines) {
      const number = row?.[column], around = row?.[spread];
      put(value, typeof number === "number" ? decimal(number, decimals) : "—");
      put(aside, `${name}${typeof around === "number" ? ` ± ${+around.toPrecision(2)}` : ""}`);
    }
  for (const panel of panels) paint(panel);
  redraw();
  list(one(".facts"), picture.facts, (item, text) => put(item, text), k => k % 2 ? "dd" : "dt");
  if (events !== (events = JSON.stringify(picture.events))) {
    one(".events").replaceChildren();
    for (const [at, time, level, kind, text] of picture.events.toReversed()) {
      const item = make(one(".events"), "li", level);
      make(item, "time", "", view.start === null || at === null ? time : view.label(at, 0.1));
      item.append(`${kind}: ${text}`);
    }
  }
  showAges();
  document.body.dataset.seq = picture.seq;
}

function list(parent, items, fill, kind = () => "li") {
  while (parent.children.length > items.length) parent.lastElementChild.remove();
  items.forEach((item, k) => fill(parent.children[k] ?? make(parent, kind(k)), item));
}

function redraw() {
  for (const chart of charts) chart.draw();
  const seen = new Set(charts[0]?.shown().map(row => row[MODE]));
  list(one(".legend"), scene ? scene.modes.filter(mode => seen.has(mode)) : [], (item, mode) => {
    if (item.dataset.mode === mode) return;
    item.dataset.mode = item.textContent = mode;
    item.prepend(document.createElement("i"));
  });
  put(one(".window"), `${seconds(view.span)} s${view.end === null ? "" : ", paused"}`);
  one("#follow").hidden = view.end === null && view.span === 20;
  give(one("#hold"), "aria-pressed", view.end !== null);
  put(one("#hold"), view.end === null ? "Pause" : "Resume");
}

// Mark panels with old data. Each panel shows the age of its data once the next picture is overdue.
function showAges() {
  clearTimeout(showAges.timer);
  if (!picture) return;
  const age = aged(picture.age), old = isOld(), { patience } = picture;
  const mark = (element, label, since) => {
    element.classList.toggle("old", since !== null);
    put(label, since === null ? "" : since < Infinity ? `${seconds(since)} s old` : "nothing received");
  };
  for (const panel of panels) {
    const frame = aged(picture.panels[panel.name]?.age ?? (panel.low ? null : picture.age));
    const late = frame > (panel.low ? patience.frame : patience.state) + scene.period;
    mark(panel.box, panel.age, late ? frame : old ? age : null);
  }
  for (const { figure, age: label } of charts) mark(figure, label, old ? age : null);
  mark(one(".headline"), scene.age, old ? age : null);
  document.body.classList.toggle("lost", old);
  if (view.old !== old) {
    view.old = old;
    redraw();
  }
  put(one(".mode"), old ? "No stream" : picture.mode || "—");
  give(one(".mode"), "data-mode", picture.mode);
  const past = age === Infinity ? "no state yet" : `last state ${seconds(age)} s ago, in mode ${picture.mode}`;
  const why = connected ? "" : "; the page's server does not respond";
  put(one(".stream"), old ? past + why : scene.live ? "live" : "recording");
  if (old && settings.force) showControls();
  const next = picture.patience.state + scene.period - age;
  showAges.timer = setTimeout(showAges, old ? 200 : Math.min(200, 1000 * next + 5));
}

function plotKey({ key }) {
  const [from, to] = view.range, step = (to - from) / 60;
  if (key === "ArrowLeft" || key === "ArrowRight") {
    const at = (view.cursor ?? to) + (key === "ArrowLeft" ? -step : step);
    view.cursor = Math.min(Math.max(at, from), to);
  } else if (key === "+" || key === "=") view.zoom(0.7, view.cursor ?? to);
  else if (key === "-") view.zoom(1.4, view.cursor ?? to);
  else if (key === "Escape") view.follow();
  else return false;
  redraw();
  return true;
}

// The colours follow the system's theme or the user's choice on the page.
const dark = matchMedia("(prefers-color-scheme: dark)"), still = matchMedia("(prefers-reduced-motion: reduce)");
const stored = () => { try { return localStorage.getItem("theme") ?? "auto"; } catch { return theme; } };
let theme = "auto";

function setTheme(next) {
  theme = next;
  document.documentElement.dataset.theme = next === "auto" ? dark.matches ? "dark" : "light" : next;
  put(one("#theme"), { auto: "◐ Auto", light: "☀ Light", dark: "☾ Dark" }[next]);
  one("#theme").setAttribute("aria-label", `Colours: ${{ auto: "same as the system", light: "light", dark: "dark" }[next]}`);
  inks.clear();
  if (picture) {
    panels.forEach(paint);
    redraw();
    player?.draw();
  }
}

function begin() {
  one("#theme").onclick = () => {
    const order = ["auto", "light", "dark"], next = order[(order.indexOf(theme) + 1) % 3];
    try { localStorage.setItem("theme", next); } catch { /* The choice applies to this page only. */ }
    setTheme(next);
  };
  dark.onchange = () => setTheme(theme);
  setTheme(stored());
  one("#help").onclick = () => one("#explained").showModal();
  one("#hold").onclick = () => view.hold(view.end === null);
  one("#closer").onclick = () => view.zoom(0.5);
  one("#wider").onclick = () => view.zoom(2);
  one("#follow").onclick = () => view.follow();
  for (const details of document.querySelectorAll("details")) details.ontoggle = () => picture && show();
  if (one("#place")) player = new Player();
  one("#hold").hidden = !!player;  // The player has its own button.
  if (one("#force")) beginControls();
  const keys = { ...(settings.force ? { Space: ["", "Stop"], ...KEYS } : {}), p: ["", "Pause or resume the plots"], "?": ["", "This help"],
    ...(player ? { Space: ["", "Play or pause"], "← →": ["", "1 s back or forward; with Shift 5 s"], ", .": ["", "Previous or next mark"] } : {}) };
  for (const [key, [, meaning]] of Object.entries(keys)) {
    make(make(one(".keys"), "dt"), "kbd", "", key.replace("Arrow", ""));
    make(one(".keys"), "dd", "", meaning);
  }
  beginKeys();
  const recorded = one("#stored").textContent;
  recorded ? play(recorded) : connect();
}

function take(given) {
  [picture, arrived] = [given, performance.now()];
  view.newest = given.row;
  view.start = given.place?.start ?? null;
}

function connect() {
  const stream = new WebSocket(`ws://${location.host}/pictures${location.search}`);
  let drawing = false, more = false;
  const next = () => stream.readyState === 1 && stream.send(player?.wishes.shift() ?? "");
  stream.onopen = () => { connected = true; next(); };
  stream.onclose = () => { connected = false; setTimeout(connect, 500); };
  stream.onmessage = message => {
    const given = JSON.parse(message.data);
    if (given.palette) return layOut(given);
    take(given);
    past.add(given.rows, given.first);
    if (drawing) return more = true;
    drawing = true;
    next();  // Request the next picture while drawing this one. A hidden page requests only one more picture.
    requestAnimationFrame(() => {
      show();
      drawing = false;
      if (more) next();
      more = false;
    });
  };
}

// Play a recording that is stored in the page. Its JSON lines contain scenes, pictures and, in the last line, all rows.
async function play(text) {
  const packed = new Blob([Uint8Array.from(atob(text), each => each.charCodeAt(0))]);
  const lines = (await new Response(packed.stream().pipeThrough(new DecompressionStream("gzip"))).text()).split("\n");
  const pictures = [], all = new History();
  all.rows = JSON.parse(lines.pop());
  let layout = "", shown = null, last = performance.now(), changed = last;
  for (const line of lines) line.startsWith('{"live"') ? layout = line : pictures.push([layout, line]);
  const { period } = JSON.parse(layout), place = { ...JSON.parse(pictures[0][1]).place, playing: !still.matches };
  const ask = wish => {
    const [name, value] = wish.split(" ");
    if (name === "speed") place.speed = +value;
    else if (name !== "play" && name !== "pause") place.position = +wish;
    else if (place.playing = name === "play") place.position %= place.duration;
  };
  const step = () => {
    const now = performance.now(), elapsed = (now - last) / 1000;
    last = now;
    if (place.playing) place.position = Math.min(place.position + place.speed * elapsed, place.duration);
    if (place.playing || player.wishes.length) changed = now;
    player.wishes.splice(0).forEach(ask);
    if (now > changed + 3 * READABLE) return;  // The numbers have reached their last values.
    place.playing &&= place.position < place.duration;
    const [above, line] = pictures[Math.min(Math.round(place.position / period), pictures.length - 1)];
    if (above !== shown) layOut(JSON.parse(shown = above));
    take({ ...JSON.parse(line), place });
    past.rows = all.rows.slice(0, all.from(picture.time)).filter(row => row[0] >= picture.first);
    show();
  };
  step();
  setInterval(step, 1000 * period);
}

begin();
