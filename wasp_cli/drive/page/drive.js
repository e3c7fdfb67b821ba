// The page of a session: draws what it is sent, sends what is held down. The server has the clock and the record.
"use strict";

const byId = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token") || "";
const KEYS = ["ArrowUp", "ArrowDown", "ArrowLeft", "ArrowRight", "KeyW", "KeyA", "KeyS", "KeyD"];
const COMMAND = "#000000", DONE = "#cc79a7", COST = "#d55e00";
const COLOURS = { safety: "#0072b2", task: "#e69f00", method: "#009e73" }; // of a gate that corrects: robot and banner, as in the viewer
const GATES = {
  none: "No gate fired: your command is executed.",
  safety: "Safety gate: your command is predicted to cost too much.",
  task: "Task gate: a correction is predicted to gain.",
  method: "The assistant's own rule fired.",
  late: "Late: the assistant had not answered in time, your command is executed.",
  alone: "You drive alone.",
};
const KEYS_TOLD = "Drive with the arrow keys or W A S D, a gamepad, or the pad. Space pauses.";
const STAYS = 25; // decisions for which the banner stays after a late one

let socket = null, over = false, phase = "connecting", shown = new Set(), hidden = new Set();
let review = null, player = null;
let block = null, world = null, ground = null, frame = null, lines = null, trail = [], costs = [], inputs = 0, speed = 1, lastLate = -STAYS;
const held = new Set();
let stick = [0, 0], lastSent = "";

// -- the connection ------------------------------------------------------------------------------------------------------------

function connect() {
  socket = new WebSocket(`ws://${location.host}/socket?token=${encodeURIComponent(token)}`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { lastSent = ""; send({ type: "focus", there: document.hasFocus() }); };
  socket.onmessage = (event) => (typeof event.data === "string" ? take(JSON.parse(event.data)) : draw(unpacked(event.data)));
  socket.onclose = (event) => {
    if (over) return;
    phase = "lost";
    if (event.code === 4409) return card("<h2>Somebody drives already</h2>", ["This session is open in another window."], [["Try again", connect]]);
    if (event.code === 4403) return card("<h2>Not allowed</h2>", ["Open the address that wasp drive printed, with its token."], []);
    card("<h2>The connection broke</h2>", ["The world waits. What was driven is kept."], []);
    setTimeout(connect, 1000);
  };
}

function send(message) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  return { header, pixels: new Uint8Array(buffer, 4 + length) };
}

function take(message) {
  if (message.type === "block") begin(message);
  else if (message.type === "imagined") lines = message;
  else if (message.type === "review") review = message;
  else if (message.type === "state") enter(message);
}

// -- what goes on --------------------------------------------------------------------------------------------------------------

function begin(message) {
  block = message; world = block.map; review = null; shown = new Set(block.shown); frame = null; trail = []; costs = []; lines = null; speed = block.speed; lastLate = -STAYS;
  byId("title").textContent = block.task;
  if (world) { ground = new Image(); ground.src = world.ground.image; }
  byId("eyes").width = block.side; byId("eyes").height = block.side * block.cameras;
  byId("ahead").hidden = block.cameras < 2; // one image may be anything
  byId("behind").hidden = block.cameras < 2;
  byId("seen").textContent = !block.plot ? (block.goals ? "what the robot sees" : "what the assistant sees") : block.drawn
    ? "drawn by the environment; the assistant sees numbers" : "what the assistant sees: its numbers over the last decisions";
  const toggles = byId("toggles");
  toggles.replaceChildren(toggles.firstElementChild);
  for (const name of shown) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox"; box.checked = !hidden.has(name); box.dataset.name = name;
    box.onchange = () => { hidden[box.checked ? "delete" : "add"](name); arrange(); box.blur(); };
    label.append(box, " ", name); toggles.append(label);
  }
  const legend = byId("legend");
  legend.replaceChildren();
  const entry = (name, colour, kind) => {
    const span = document.createElement("span"), mark = document.createElement("i");
    mark.className = kind; mark.style.setProperty("--mark", colour); span.append(mark, name); legend.append(span);
    if (kind === "line") span.className = "imagined"; // a replay draws none
  };
  if (world) {
    entry("robot, its front white", world.robot.colour, "");
    for (const kind of world.kinds) entry(kind.name, kind.colour, "");
    if (shown.has("cost")) entry("where it cost", COST, "");
    entry("your command", COMMAND, "arrow");
    if (shown.has("gate")) entry("what is executed", DONE, "arrow");
    if (shown.has("imagined")) { entry("imagined: uncorrected", COMMAND, "line"); entry("with the correction", DONE, "line"); }
  }
  arrange();
}

const sees = (name) => shown.has(name) && !hidden.has(name);

function arrange() {
  byId("cameras").hidden = !sees("cameras");
  byId("above").hidden = !sees("map");
  byId("gate").hidden = !sees("gate");
  if (frame) paint();
}

function enter(state) {
  phase = state.phase;
  closePlayer();
  const driving = ["ready", "driving", "paused"].includes(phase);
  byId("drive").hidden = !driving;
  byId("pause").hidden = phase !== "driving";
  for (const id of ["restart", "next", "end"]) byId(id).hidden = (phase !== "paused" && phase !== "driving") || (id === "next" && !state.skips);
  const episode = state.practice ? `practice ${state.episode + 1} of ${state.of}` : `episode ${state.episode + 1} of ${state.of}`;
  byId("progress").textContent = driving ? (state.blocks > 1 ? `block ${state.block} of ${state.blocks}, ${episode}` : episode) : "";
  if (phase === "driving") { byId("veil").hidden = true; lastSent = ""; hold(); return; }
  if (phase === "ready") {
    trail = []; costs = []; lines = null;
    const who = block && block.assistant ? ` ${block.assistant} assists.` : "";
    const time = block ? `An episode takes ${Math.round(block.seconds)} seconds.` : "";
    const aim = block && !block.goals ? "Gather return, and stay clear of what costs." : "Reach the goals, and stay clear of what costs.";
    const keys = block && block.controls ? `${KEYS_TOLD} ${block.controls}` : KEYS_TOLD;
    const texts = [...compared(), aim, time + who, keys];
    card("<h2></h2>", texts, [["Go", () => ask("go")], ...replays(), ["End the session", () => ask("end")]], state.practice ? "Practice" : `Episode ${state.episode + 1} of ${state.of}`);
    if (world) byId("card").querySelector(".actions").before(byId("legend").cloneNode(true));
  } else if (phase === "paused") {
    card("<h2>Paused</h2>", ["The world waits."], [["Go on", () => ask("go")], ["Restart this world", () => ask("restart")], ...(state.skips ? [["Next world", () => ask("next")]] : []), ["End the session", () => ask("end")]]);
  } else if (phase === "form") form(state.form);
  else if (phase === "over") { over = true; summary(state); }
  else card("<h2>One moment</h2>", [state.text || "The models are loaded …"], []);
}

function ask(what) { send({ type: "ask", what }); }

function card(html, paragraphs, actions, heading) {
  const box = byId("card");
  box.innerHTML = html; // fixed texts of this file only
  if (heading) box.querySelector("h2").textContent = heading;
  for (const text of paragraphs) { const p = document.createElement("p"); p.className = "text"; p.textContent = text; box.append(p); }
  byId("veil").hidden = false; // before its button gets the focus, which a hidden one does not take
  buttons(box, actions);
}

function buttons(box, actions) {
  const row = document.createElement("div");
  row.className = "actions";
  for (const [name, act] of actions) { const b = document.createElement("button"); b.type = "button"; b.textContent = name; b.onclick = act; row.append(b); }
  box.append(row);
  if (row.firstElementChild) row.firstElementChild.focus();
}

function form(asked) {
  card("<h2></h2>", asked.text ? [asked.text] : [], [], asked.title || "A few questions about the drive");
  const box = byId("card"), values = {};
  box.querySelector(".actions").remove();
  for (const scale of asked.scales) {
    const div = document.createElement("div"), label = document.createElement("label"), range = document.createElement("input"), ends = document.createElement("div");
    div.className = "scale"; label.textContent = scale.text; label.htmlFor = `scale-${scale.name}`;
    range.type = "range"; range.min = 0; range.max = 100; range.step = 1; range.value = 50; range.id = label.htmlFor; range.className = "untouched";
    range.oninput = range.onchange = range.onclick = () => { range.className = ""; values[scale.name] = Number(range.value); ready(); };
    ends.className = "ends"; ends.innerHTML = "<span></span><span></span>";
    ends.children[0].textContent = scale.low; ends.children[1].textContent = scale.high;
    div.append(label, range, ends); box.append(div);
  }
  if (asked.name === "consent") {
    buttons(box, [["I agree", () => send({ type: "answers", agreed: true, scales: {} })], ["I do not agree", () => send({ type: "answers", agreed: false, scales: {} })]]);
    return;
  }
  buttons(box, [["Continue", () => send({ type: "answers", scales: values })]]);
  const proceed = box.querySelector(".actions button");
  function ready() { proceed.disabled = asked.scales.some((scale) => !(scale.name in values)); }
  ready();
  const first = box.querySelector("input");
  if (first) first.focus();
}

function summary(state) {
  card("<h2>The session is over</h2>", [...compared(), state.text], replays());
  const rows = state.blocks || [];
  if (!rows.length) return;
  const table = document.createElement("table"), ms = (value) => (value === null ? "–" : `${value} ms`);
  const add = (name, value) => { const tr = table.insertRow(); tr.insertCell().textContent = name; tr.insertCell().textContent = value; };
  for (const row of rows) {
    add("recorded", `${row.label}, ${row.episodes} of ${row.of} episodes`);
    add("decisions", `${row.decisions}, ${row.late} late`);
    add("time for a decision", `${ms(row.decision_p50_ms)}, 99 %: ${ms(row.decision_p99_ms)}`);
    add("round trip of a frame", `${ms(row.round_trip_p50_ms)}, 99 %: ${ms(row.round_trip_p99_ms)}`);
  }
  byId("card").append(table);
}

// -- the replay after an episode -----------------------------------------------------------------------------------------------

const SPEED = 3; // simulated seconds of a replay in a second

// The last episode in words: as driven, and with the same commands alone.
function compared() {
  if (!review || !["return", "cost"].some((key) => key in review.driven.at(-1))) return [];
  const said = (name, header) => `${name}: ` + ["return", "cost"].filter((key) => key in header).map((key) => `${key} ${Number(header[key].toFixed(1))}`).join(", ");
  const ends = [said(review.alone.length ? `You with ${block.assistant || "the assistant"}` : "You", review.driven.at(-1))];
  if (review.alone.length) ends.push(said("Your commands alone", review.alone.at(-1)) + ". A person would have reacted; the commands did not.");
  return ends;
}

function replays() { return review && review.driven[0].robot ? [["Watch it again", () => play(false)], ["Save as a film", () => play(true)]] : []; }

function play(filmed) {
  byId("veil").hidden = true; byId("drive").hidden = false; byId("drive").classList.add("replay"); byId("player").hidden = false;
  byId("above").hidden = false; // also where the driver has hidden the map
  lines = null; player = { begun: performance.now(), at: -1, progress: byId("progress").textContent };
  byId("scrub").max = Math.max(review.driven.length, review.alone.length) - 1;
  byId("progress").textContent = "replay of the last episode";
  if (filmed) film();
  advance();
}

function replayStep() { return (block.period_ms * block.speed) / SPEED; } // ms that a decision is shown

function playOn() {
  const at = Number(byId("scrub").value) < Number(byId("scrub").max) ? Number(byId("scrub").value) : 0;
  player.begun = player.begun !== null && at ? null : performance.now() - at * replayStep();
}

function film() {
  const recorder = new MediaRecorder(byId("map").captureStream()), parts = [];
  recorder.ondataavailable = (event) => parts.push(event.data);
  recorder.onstop = () => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob(parts, { type: recorder.mimeType })); link.download = "wasp-drive.webm"; link.click();
  };
  player.recorder = recorder;
  recorder.start();
}

function advance() {
  if (!player) return;
  const last = Number(byId("scrub").max);
  if (player.begun !== null) byId("scrub").value = Math.min(Math.floor((performance.now() - player.begun) / replayStep()), last);
  const at = Number(byId("scrub").value);
  byId("on").textContent = player.begun !== null && at < last ? "Stop" : "Play";
  if (at !== player.at) { player.at = at; moment(at); }
  if (at === last && player.recorder && !player.ending) player.ending = setTimeout(closePlayer, 700); // the film shows the end for a moment
  setTimeout(advance, 20); // an animation frame never comes where the window is hidden
}

function moment(at) {
  const until = (headers) => headers.slice(0, at + 1), places = (headers) => headers.map((header) => header.robot.slice(0, 2));
  const driven = until(review.driven), alone = until(review.alone), header = driven.at(-1);
  trail = places(driven); costs = places(driven.filter((one) => one.costly));
  if (at === 0) header.t = 0;
  above(header);
  const context = byId("map").getContext("2d"), scale = byId("map").width / (2 * world.half);
  if (alone.length) {
    const [x, y, yaw] = alone.at(-1).robot;
    context.globalAlpha = 0.6;
    path(context, places(alone), COMMAND, 2.5 / scale, [5 / scale, 4 / scale]);
    context.fillStyle = COST;
    for (const one of alone.filter((moment) => moment.costly)) { context.beginPath(); context.arc(one.robot[0], one.robot[1], 4 / scale, 0, 7); context.fill(); }
    outline(context, { ...world.robot, colour: "#404040" }, x, y, yaw - world.robot.front, world.half * 0.045);
    context.globalAlpha = 1;
  }
  context.setTransform(1, 0, 0, 1, 0, 0);
  const told = [[`with ${block.assistant || "nobody"}`, header, world.robot.colour], ["the same commands alone", alone.at(-1), "#404040"]].filter((one) => one[1]);
  context.fillStyle = "rgb(255 255 255 / .85)"; context.fillRect(0, 0, 800, 34 * told.length + 8);
  context.font = "24px system-ui, sans-serif"; context.textBaseline = "top";
  told.forEach(([name, one, colour], row) => {
    context.fillStyle = colour; context.fillRect(10, 34 * row + 12, 20, 20);
    context.fillStyle = "#000"; context.fillText([name, ...["cost", "goals"].filter((key) => key in one).map((key) => `${key} ${one[key]}`)].join("   "), 42, 34 * row + 10);
  });
}

function closePlayer() {
  if (!player) return;
  if (player.recorder && player.recorder.state === "recording") player.recorder.stop();
  clearTimeout(player.ending);
  byId("progress").textContent = player.progress;
  player = null; trail = []; costs = [];
  byId("player").hidden = true; byId("drive").classList.remove("replay"); byId("drive").hidden = phase !== "ready"; byId("veil").hidden = false;
  arrange();
}
byId("scrub").oninput = () => { player.begun = null; };
byId("on").onclick = playOn;
byId("back").onclick = closePlayer;

// -- what is held down ---------------------------------------------------------------------------------------------------------

function hold() {
  const keys = [...held].sort(), axes = stick.map((v) => Math.round(Math.max(-1, Math.min(1, v)) * 100) / 100);
  const now = JSON.stringify([keys, axes]);
  if (now === lastSent) return;
  lastSent = now;
  send({ type: "input", number: ++inputs, keys, axes });
}

addEventListener("keydown", (event) => {
  if (KEYS.includes(event.code) && !event.ctrlKey && !event.metaKey && !event.altKey) {
    held.add(event.code); // before the world moves too: a key that is held while Go is pressed drives
    if (phase === "driving") { event.preventDefault(); hold(); }
  } else if (event.code === "Space" || event.code === "Escape") {
    if (phase === "driving" || event.repeat) event.preventDefault(); // while it is held, it does not press the button that comes
    if (phase === "driving") ask("pause");
  }
});
addEventListener("keyup", (event) => { if (held.delete(event.code)) hold(); });

function letGo() { held.clear(); stick = [0, 0]; place(); hold(); send({ type: "focus", there: false }); }
addEventListener("blur", letGo);
document.addEventListener("visibilitychange", () => { if (document.hidden) letGo(); });
addEventListener("focus", () => send({ type: "focus", there: true }));

const pad = byId("pad");
function place(at = stick) { byId("knob").style.transform = `translate(${-at[1] * 3}rem, ${-at[0] * 3}rem)`; }
function drag(event) {
  const box = pad.getBoundingClientRect();
  stick = [1 - 2 * (event.clientY - box.top) / box.height, 1 - 2 * (event.clientX - box.left) / box.width].map((v) => Math.max(-1, Math.min(1, v)));
  place(); hold();
}
pad.addEventListener("pointerdown", (event) => { pad.setPointerCapture(event.pointerId); drag(event); });
pad.addEventListener("pointermove", (event) => { if (pad.hasPointerCapture(event.pointerId)) drag(event); });
for (const name of ["pointerup", "pointercancel"]) pad.addEventListener(name, () => { stick = [0, 0]; place(); hold(); });

let padded = false;
function gamepads() {
  const found = document.hasFocus() && [...navigator.getGamepads()].find((each) => each && each.axes.length > 1);
  const axis = (value) => (Math.abs(value) < 0.12 ? 0 : value);
  const now = found ? [-axis(found.axes[1]), -axis(found.axes[0])] : [0, 0]; // without focus, or unplugged: let go
  if (padded || now[0] || now[1]) { stick = now; padded = Boolean(now[0] || now[1]); place(); hold(); }
  requestAnimationFrame(gamepads);
}
requestAnimationFrame(gamepads);
setInterval(() => send({ type: "alive" }), 1000);

for (const id of ["pause", "restart", "next", "end"]) byId(id).onclick = () => { byId(id).blur(); ask(id); };

// -- drawing -------------------------------------------------------------------------------------------------------------------

function draw(got) {
  frame = got;
  const header = got.header;
  if (header.t === 0) lastLate = -STAYS;
  if (header.gate === "late") lastLate = header.t;
  if (header.robot) { if (header.t === 0) { trail = []; costs = []; } trail.push(header.robot.slice(0, 2)); if (header.costly) costs.push(header.robot.slice(0, 2)); }
  paint();
  send({ type: "ack", frame: header.frame });
}

function paint() {
  const header = frame.header;
  byId("drive").classList.toggle("costly", sees("cost") && Boolean(header.costly));
  if (sees("cameras") && frame.pixels.length) cameras();
  if (sees("map") && world && header.robot) above(header);
  pads(header);
  const rows = [["time", `${header.seconds.toFixed(1)} s`]];
  if (sees("goals")) rows.push(["goals", header.goals], ["return", (header.return ?? 0).toFixed(1)]);
  if (sees("cost")) rows.push(["cost", header.cost]);
  if (sees("gate")) rows.push(["late decisions", header.late ?? 0]);
  const list = byId("numbers");
  list.replaceChildren(...rows.flatMap(([name, value]) => {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value; if (name === "cost" && header.costly) dd.className = "costly";
    return [dt, dd];
  }));
  byId("late").hidden = !sees("gate") || header.t - lastLate >= STAYS;
  byId("late").textContent = `late: you drive alone; try --speed ${Math.max(0.05, Math.round(50 * speed) / 100)}`;
  const gate = byId("gate");
  gate.style.borderColor = fired(header) || "";
  gate.textContent = header.gate ? (["safety", "task", "method"].includes(header.gate) && !header.corrected ? GATES[header.gate] + " Your command stands." : GATES[header.gate]) : "";
}

// The colour of the gate that corrects now, where it may be seen.
function fired(header) { return sees("gate") && header.corrected ? COLOURS[header.gate] || DONE : null; }

function pads(header) {
  if (!stick[0] && !stick[1]) place(header.command || stick); // keys move it too
  const done = byId("done"), at = sees("gate") && header.corrected ? header.executed : null;
  done.hidden = !at;
  if (at) done.style.transform = `translate(${-at[1] * 3}rem, ${-at[0] * 3}rem)`;
}

function cameras() {
  const canvas = byId("eyes"), context = canvas.getContext("2d"), count = canvas.width * canvas.height;
  const image = context.createImageData(canvas.width, canvas.height), from = frame.pixels, to = image.data;
  for (let i = 0; i < count; i++) { to[4 * i] = from[3 * i]; to[4 * i + 1] = from[3 * i + 1]; to[4 * i + 2] = from[3 * i + 2]; to[4 * i + 3] = 255; }
  context.putImageData(image, 0, 0);
}

let centre = [0, 0];
function above(header) {
  const canvas = byId("map"), context = canvas.getContext("2d"), half = world.half, scale = canvas.width / (2 * half);
  const [x, y, yaw] = header.robot;
  // A map that shows everything moves only for a robot that would leave it; another one follows.
  const free = half * (world.centre ? 0.9 : 0.5);
  if (header.t === 0) centre = world.centre ? [...world.centre] : [x, y];
  centre = [x, y].map((at, i) => centre[i] + (at - centre[i]) - Math.max(-free, Math.min(free, at - centre[i])));
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = "#888"; context.fillRect(0, 0, canvas.width, canvas.height);
  context.setTransform(scale, 0, 0, -scale, canvas.width / 2 - centre[0] * scale, canvas.height / 2 + centre[1] * scale);
  const land = world.ground;
  if (ground && ground.complete && ground.naturalWidth) {
    context.save(); context.translate(land.centre[0], land.centre[1]); context.scale(1, -1);
    context.drawImage(ground, -land.half, -land.half, 2 * land.half, 2 * land.half); context.restore();
  }
  const kinds = [...world.kinds].sort((a, b) => b.flat - a.flat);
  for (const kind of kinds) for (const [px, py, angle] of header.things[kind.name] || []) outline(context, kind, px, py, angle, half * 0.005);
  path(context, trail, "rgb(64 64 64 / .75)", 2 / scale, []);
  context.fillStyle = COST;
  for (const [px, py] of costs) { context.beginPath(); context.arc(px, py, 4 / scale, 0, 7); context.fill(); }
  if (sees("imagined") && lines && header.frame - lines.frame < 4) {
    if (lines.alone) path(context, lines.alone, COMMAND, 2.5 / scale, [5 / scale, 4 / scale]);
    if (lines.corrected) path(context, lines.corrected, DONE, 3 / scale, []);
  }
  outline(context, { ...world.robot, colour: fired(header) || world.robot.colour }, x, y, yaw - world.robot.front, half * 0.045);
  arrow(context, x, y, yaw, header.command, COMMAND, 1 / scale);
  if (fired(header)) arrow(context, x, y, yaw, header.executed, DONE, 1 / scale);
  const size = Math.max(half * 0.06, 0.12);
  context.save(); context.translate(x, y); context.rotate(yaw); context.fillStyle = "#fff"; context.strokeStyle = "#000"; context.lineWidth = 1 / scale;
  context.beginPath(); context.moveTo(size, 0); context.lineTo(-0.3 * size, 0.4 * size); context.lineTo(-0.3 * size, -0.4 * size); context.closePath(); context.fill(); context.stroke(); context.restore();
}

// A stick (forward, left) as an arrow from the robot: its length is the force, it bends to where the robot turns.
function arrow(context, x, y, yaw, stick, colour, pixel) {
  if (!stick || Math.hypot(...stick) < 0.05) return;
  const [forward, left] = stick, length = 70 * pixel * Math.hypot(forward, left);
  context.save(); context.translate(x, y); context.rotate(yaw + Math.atan2(left, forward));
  for (const [style, wide] of [["rgb(255 255 255 / .7)", 7], [colour, 4]]) {
    context.strokeStyle = style; context.lineWidth = wide * pixel; context.lineCap = "round";
    context.beginPath(); context.moveTo(0, 0); context.lineTo(length, 0);
    context.moveTo(length - 9 * pixel, 7 * pixel); context.lineTo(length, 0); context.lineTo(length - 9 * pixel, -7 * pixel); context.stroke();
  }
  context.restore();
}

function outline(context, kind, x, y, angle, least) {
  const extent = Math.max(...kind.shapes.map((s) => Math.hypot(...s.centre) + Math.max(...s.half))), grown = Math.max(1, least / extent);
  context.save(); context.translate(x, y); context.rotate(angle); context.scale(grown, grown); context.fillStyle = kind.colour;
  for (const shape of kind.shapes) {
    context.save(); context.translate(...shape.centre); context.rotate(shape.angle); context.beginPath();
    if (shape.round) context.arc(0, 0, shape.half[0], 0, 7); else context.rect(-shape.half[0], -shape.half[1], 2 * shape.half[0], 2 * shape.half[1]);
    context.fill(); context.restore();
  }
  context.restore();
}

function path(context, places, colour, width, dash) {
  if (places.length < 2) return;
  context.beginPath(); context.moveTo(...places[0]);
  for (const place of places.slice(1)) context.lineTo(...place);
  for (const [style, wide] of [["rgb(255 255 255 / .7)", 2 * width], [colour, width]]) { context.strokeStyle = style; context.lineWidth = wide; context.setLineDash(style === colour ? dash : []); context.stroke(); }
  context.setLineDash([]);
}

connect();
