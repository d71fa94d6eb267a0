
// At most one command of each kind is in transit at a time. Of the later commands, only the newest is sent.
const client = "page " + Math.random().toString(16).slice(2, 6);
const one = selector => document.querySelector(selector);
const lanes = {}, settings = {};
const allowed = command => picture && !isOld() && scene.commands[command].includes(picture.mode);

function say(text, bad = false) {
  const reply = one(".reply");
  if (!reply) return;
  put(reply, text);
  reply.classList.toggle("bad", bad);
}

// Call `answered` with the success flag and the text of the reply.
function send(command, numbers = {}, answered = () => {}) {
  const lane = lanes[command] ??= { busy: 0, next: null };
  const asked = { message: { command, client, seen: picture?.now, ...numbers }, answered };
  if (command === "stop") drop("stop was sent first");
  else if (lane.busy) return void (lane.next = asked);
  transmit(lane, asked);
}

function drop(why) {
  for (const lane of Object.values(lanes)) {
    lane.next?.answered(false, why);
    lane.next = null;
  }
}

function transmit(lane, { message, answered }) {
  lane.busy++;
  say(`${message.command} …`);
  let answer = `✗ ${message.command}: the page's server does not respond`;
  // Use a separate connection, because the picture connection may be closed.
  const line = new WebSocket(`ws://${location.host}/command${location.search}`);
  line.onopen = () => line.send(JSON.stringify(message));
  line.onmessage = ({ data }) => { answer = data; line.close(); };
  line.onclose = () => {
    lane.busy--;
    const done = answer.startsWith("✓");
    say(answer, !done);
    answered(done, answer);
    const next = lane.next;
    lane.next = null;
    if (next && !lane.busy) transmit(lane, next);
  };
}

// Hand value with a slider and an input field, which follow the hand. After a change on this page,
// both show the new value until the hand has reached or refused this value.
class Setting {
  wanted = null;
  accepted = NaN;
  value = NaN;
  typing = false;

  constructor(root, unit, commit) {
    Object.assign(this, { unit, commit, output: root.querySelector("output") });
    [this.number, this.range] = [root.querySelector("[type=number]"), root.querySelector("[type=range]")];
    this.value = +this.range.value;
    this.range.oninput = () => this.want(+this.range.value);
    this.range.onchange = () => this.commit(this.wanted ?? this.value);
    this.number.oninput = () => this.typing = true;
    this.number.onblur = () => this.typing = false;
    this.number.onkeydown = event => {
      if (event.key === "Escape") this.number.blur();
    };
    this.number.onchange = () => {
      this.typing = false;
      if (!this.number.value || !this.number.checkValidity()) return this.tell(this.number.validationMessage || "not a number", true);
      this.want(+this.number.value);
      this.commit(this.wanted);
    };
  }

  get text() { return decimal(this.wanted ?? this.value, 1) + this.unit; }

  want(value) {
    this.wanted = value;
    this.show();
  }

  send(command, numbers) {
    const text = this.text, wanted = this.wanted;
    this.tell(`${text} is being sent …`);
    send(command, numbers, (done, answer) => {
      this.tell(done ? `✓ ${text} accepted` : answer.startsWith("✗") ? answer : `✗ ${text} was not sent: ${answer}`, !done);
      if (this.wanted !== wanted) return;  // A newer value is in transit.
      if (done) [this.until, this.accepted] = [Date.now() + 2000, wanted]; else this.wanted = null;
      this.show();
    });
  }

  // Show the hand's value. NaN means that the value is unknown.
  follow(value) {
    if (!Number.isNaN(value)) this.value = value;
    if (this.wanted === null && Math.abs(value - this.accepted) > 0.05) {  // Another client has changed the value.
      this.accepted = NaN;
      this.tell("");
    }
    const reached = Math.abs(value - this.wanted) < 0.05;
    if (this.wanted !== null && this.until && (reached || Date.now() > this.until)) this.wanted = this.until = null;
    this.show();
  }

  show() {
    const value = this.wanted ?? this.value;
    if (Number.isNaN(value)) return;
    if (value !== this.shown && !this.range.matches(":active")) this.range.value = this.shown = value;
    const text = `${+value.toFixed(1) || 0}`;
    if (!this.typing && this.number.value !== text) this.number.value = text;
  }

  tell(text, bad = false) {
    put(this.output, text);
    this.output.classList.toggle("bad", bad);
  }

  limit(most) {
    give(this.range, "max", most);
    give(this.number, "max", most);
  }

  disable(on) {
    this.number.disabled = this.range.disabled = on;
  }
}

const gripping = () => allowed("rotate");
const pressed = {
  grasp() {
    settings.force.wanted ??= settings.force.value;
    settings.force.send("grasp", { force: settings.force.wanted });
  },
  rotate(step) {
    const { angle } = settings;
    angle.want((angle.wanted ?? angle.value) + step);
    angle.send("rotate", { angle: angle.wanted * Math.PI / 180 });
  },
  disarm() {
    gripping() ? one("#sure").showModal() : send("disarm");
  },
};

function press(command, value) {
  if (command !== "stop" && command !== "record" && !allowed(command))
    return say(`✗ ${command}: not accepted ${isOld() ? "without a stream" : `in mode ${picture.mode}`}`, true);
  (pressed[command] ?? (() => send(command)))(value);
}

function beginControls() {
  settings.force = new Setting(one("#force"), " N", value => {
    if (gripping()) pressed.grasp();
    else {
      [settings.force.value, settings.force.wanted] = [value, null];
      settings.force.tell("for the next grasp");
    }
  });
  settings.angle = new Setting(one("#angle"), "°", () => pressed.rotate(0));
  for (const button of document.querySelectorAll("button[name]"))
    button.onclick = () => press(button.name, +button.value);
  one("#sure").onclose = () => one("#sure").returnValue === "disarm" && send("disarm");
}

function showControls() {
  const { set, force_max: most, recording } = picture;
  for (const button of document.querySelectorAll("button[name]"))
    if (!["stop", "record"].includes(button.name)) button.disabled = !allowed(button.name);
  if (most !== null) settings.force.limit(most);
  settings.force.follow(set.force ?? NaN);
  settings.angle.follow(set.angle ?? NaN);
  settings.angle.disable(!allowed("rotate"));
  const button = one("[name=record]"), on = !!recording.file;
  give(button, "aria-pressed", on);
  const seconds = Math.max(0, Date.now() / 1000 - recording.since);
  put(button, on ? `End recording, ${Math.floor(seconds)} s` : "Record");
}

// This page uses the keys of the terminal page. Space always stops the hand, even if a button has the focus.
const KEYS = {
  a: ["arm", "Arm"], g: ["grasp", "Grasp"], r: ["release", "Release"], d: ["disarm", "Disarm"], c: ["clear", "Clear the fault"],
  "+": ["", "More force"], "-": ["", "Less force"], ArrowLeft: ["rotate", "Turn by −5°", -5], ArrowRight: ["rotate", "Turn by +5°", 5],
};

function commandKey({ key }) {
  const [command, , value] = KEYS[key] ?? [];
  if (command) press(command, value);
  else if (["+", "=", "-"].includes(key)) {
    const { force } = settings, step = key === "-" ? -0.5 : 0.5;
    force.want(Math.min(Math.max((force.wanted ?? force.value) + step, 0.5), +force.range.max));
    force.commit(force.wanted);
  } else return false;
  return true;
}

function beginKeys() {
  if (settings.force)
    for (const kind of ["keydown", "keyup"])
      window.addEventListener(kind, event => {
        if (event.code !== "Space") return;
        event.preventDefault();
        event.stopImmediatePropagation();
        if (kind === "keydown" && !event.repeat) send("stop");
      }, true);
  window.addEventListener("keydown", event => {
    const { target, key, ctrlKey, altKey, metaKey } = event;
    if (ctrlKey || altKey || metaKey || one("dialog[open]") || target.matches("input, select, textarea")) return;
    const handled = key === "?" ? (one("#explained").showModal(), true)
      : target.closest(".plots") && plotKey(event) ? true
      : key === "p" && !player ? (one("#hold").click(), true)
      : player ? player.key(event)
      : settings.force ? commandKey(event) : false;
    if (handled) event.preventDefault();
  });
}

// Recording player. Its requests are sent with the next picture requests.
class Player {
  wishes = [];

  constructor() {
    [this.place, this.track] = [one("#place"), new Surface(one(".track canvas"), () => this.draw())];
    this.place.oninput = () => this.go(+this.place.value);
    one("#playing").onclick = () => this.wish(picture.place.playing ? "pause" : "play");
    one("#speed").onchange = () => this.wish(`speed ${one("#speed").value}`);
    one("#previous").onclick = () => this.jump(-1);
    one("#next").onclick = () => this.jump(1);
  }

  wish(text) {
    if (!Number.isNaN(+text) && !Number.isNaN(+this.wishes.at(-1))) this.wishes.pop();
    this.wishes.push(text);
  }

  go(position) {
    this.wish(`${Math.min(Math.max(position, 0), picture.place.duration)}`);
  }

  jump(step) {
    // During playback, a mark that has just been passed does not yet count as the previous mark.
    const { position, playing } = picture.place, least = step < 0 && playing ? 0.5 : 0.03;
    const beyond = scene.marks.filter(([at]) => step * (at - position) > least);
    const mark = beyond.at(step > 0 ? 0 : -1);
    if (mark) this.go(mark[0] + 0.02);
  }

  key({ code, key, shiftKey }) {
    const { position } = picture.place, far = shiftKey ? 5 : 1;
    if (code === "Space") one("#playing").click();
    else if (key === ",") this.jump(-1);
    else if (key === ".") this.jump(1);
    else if (key === "ArrowLeft") this.go(position - far);
    else if (key === "ArrowRight") this.go(position + far);
    else if (key === "Home") this.go(0);
    else if (key === "End") this.go(picture.place.duration);
    else return false;
    return true;
  }

  show() {
    const { position, duration, playing, speed } = picture.place;
    give(this.place, "max", duration);
    if (!this.wishes.length && !this.place.matches(":active")) this.place.value = position;
    put(one("#playing"), playing ? "Pause" : "Play");
    put(one("#clock"), `${position.toFixed(1)} of ${duration.toFixed(1)} s`);
    if (document.activeElement !== one("#speed")) one("#speed").value = speed;
    const mark = scene.marks.filter(([at]) => at <= position).at(-1);
    put(one("#mark"), mark ? mark[3] : "");
    if (this.drawn !== `${duration} ${scene.marks.length}`) this.draw();
  }

  // Draw the recording's modes along its track, with warnings and errors above them.
  draw() {
    if (!picture || !scene.marks || !this.track.clear()) return;
    const { pen, width } = this.track, { duration } = picture.place, inset = 8;  // half the width of the thumb [px]
    this.drawn = `${duration} ${scene.marks.length}`;
    const x = at => inset + (width - 2 * inset) * at / duration;
    const modes = scene.marks.filter(([, , kind]) => kind === "mode");
    let begin = 0, mode = modes[0]?.[3].split(" → ")[0] ?? picture.mode;
    for (const [at, , , text] of [...modes, [duration, "", "", ""]]) {
      pen.fillStyle = ink(mode) || ink("muted");
      pen.fillRect(x(begin), 11, x(at) - x(begin), 6);
      [begin, mode] = [at, text.split(" → ")[1]];
    }
    for (const [at, level, kind] of scene.marks) {
      if (kind === "mode" && level === "info") continue;
      pen.fillStyle = ink(level === "error" ? "error" : "warning");
      pen.beginPath();
      pen.moveTo(x(at), 10);
      pen.lineTo(x(at) - 4, 1);
      pen.lineTo(x(at) + 4, 1);
      pen.fill();
    }
  }
}
