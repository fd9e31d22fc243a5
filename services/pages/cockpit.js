// Driver page of a station: decodes video, shows its age, covers what is outdated, and sends the driver's commands.
"use strict";

const MAX_AGE = 300; // age in ms above which video, or the state of vehicle or station, is covered
const WATCHDOG_PERIOD = 25, // interval of the watchdog, ms
  AGES_PERIOD = 100, // interval at which displayed ages are updated, ms
  CLOCK_PERIOD = 200; // interval of clock synchronization, ms
const HEADER_BYTES = 14; // length of a frame's header
const GEARS = { "-1": "reverse", 0: "neutral", 1: "forwards" };
const DECODE_QUEUE_MAX = 8; // frames that may wait for decoding; a page that falls behind continues at the next key frame
const COMMANDS_SEEN = 5, // commands that name a stop without agreeing, which the vehicle requires first
  COMMANDS_AGREED = 10; // commands that agree

let socket = null,
  connection = "waiting", // why there is no connection; "": there is one
  state = {}, // last state from the station
  lights = false,
  gear = 1,
  agreeing = 0;
const cameras = new Map();

// Sets a text only if it has changed, which avoids layout and repeated announcements by screen readers.
function write(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function strip(id, text) {
  byId(id).hidden = !text;
  write(byId(id), text ?? "");
}

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

const driving = () => state.driver !== undefined && state.driver === state.you;

// ---- ages: capture and sending times are of this page's clock (ms), -Infinity where unknown

// Converts times of the station's clock to this page's clock. The station reads its clock after the page has sent its own
// time, so each difference is a lower bound, and the largest is the closest: ages are never too small, whatever the delay.
class Clock {
  static KEPT = 16; // differences kept: those of the last 3 s

  constructor() {
    this.differences = [];
  }

  synchronize() {
    send({ do: "clock", sent: performance.now() });
  }

  addAnswer(sent, station) {
    this.differences = [...this.differences, sent - station].slice(-Clock.KEPT);
  }

  toPage(station) {
    return station + Math.max(...this.differences);
  }
}

let clock = new Clock();

const sentAt = { station: -Infinity, vehicle: -Infinity }; // when station and vehicle sent their displayed state
const age = (since) => performance.now() - since;
const sinceText = (since) => (Number.isFinite(since) ? ` since ${(age(since) / 1000).toFixed(1)} s` : "");

// ---- video

class Camera {
  constructor(number) {
    this.number = number;
    this.figure = element("figure");
    this.canvas = element("canvas");
    this.cover = element("p", "no picture", "cover");
    this.caption = element("figcaption");
    this.name = element("b", `camera ${number}`);
    this.age = element("output", "-");
    this.caption.append(this.name, this.age);
    this.figure.append(this.canvas, this.cover, this.caption);
    this.captured = -Infinity;
    this.shown = 0;
    this.begin();
    const later = [...cameras.values()].find((one) => one.number > number); // the first camera is the largest
    byId("cameras").insertBefore(this.figure, later?.figure ?? null);
  }

  begin() {
    this.started = false;
    this.decoder = new VideoDecoder({ output: (frame) => this.draw(frame), error: () => this.begin() });
    this.decoder.configure({ codec: "vp8", optimizeForLatency: true });
  }

  // `captured`: time of the station's clock, ms; the decoder passes it on as the frame's timestamp
  decode(key, captured, data) {
    if (this.decoder.decodeQueueSize > DECODE_QUEUE_MAX) this.decoder.close();
    if (this.decoder.state !== "configured") this.begin();
    const hasTime = Number.isFinite(captured); // else the station has not synchronized with the vehicle's clock yet
    this.started = hasTime && (key || this.started);
    if (!this.started) return send({ do: "key", camera: this.number });
    this.decoder.decode(new EncodedVideoChunk({ type: key ? "key" : "delta", timestamp: Math.round(captured * 1000), data }));
  }

  draw(frame) {
    if (this.canvas.width !== frame.displayWidth || this.canvas.height !== frame.displayHeight) {
      this.canvas.width = frame.displayWidth;
      this.canvas.height = frame.displayHeight;
    }
    const context = this.canvas.getContext("2d");
    this.captured = clock.toPage(frame.timestamp / 1000);
    context.drawImage(frame, 0, 0);
    frame.close();
    this.shown += 1;
    this.figure.dataset.shown = this.shown;
    context.font = "600 20px system-ui, sans-serif";
    context.fillStyle = "rgba(0, 0, 0, .55)";
    context.fillRect(this.canvas.width - 96, 8, 88, 28);
    context.fillStyle = "#fff";
    context.textAlign = "right";
    context.fillText(`${Math.round(age(this.captured))} ms`, this.canvas.width - 14, 29);
  }

  get outdated() {
    return age(this.captured) > MAX_AGE;
  }

  updateCover() {
    this.cover.hidden = !this.outdated;
    write(this.cover, `no picture${sinceText(this.captured)}`);
  }

  showAge() {
    if (!Number.isFinite(this.captured)) return;
    this.figure.dataset.age = Math.round(age(this.captured));
    write(this.age, `${this.figure.dataset.age} ms`);
    this.age.className = this.outdated ? "bad" : "";
  }
}

function camera(number) {
  const existing = cameras.get(number);
  if (existing) return existing;
  const created = new Camera(number),
    all = [...cameras.values(), created].sort((one, other) => one.number - other.number);
  cameras.clear();
  for (const one of all) cameras.set(one.number, one);
  return created;
}

function receiveFrame(buffer) {
  const view = new DataView(buffer);
  camera(view.getUint8(0)).decode(view.getUint8(1) === 1, view.getFloat64(6, true), buffer.slice(HEADER_BYTES));
}

// ---- commands

function sendCommand() {
  if (!driving()) return;
  const now = controls();
  if (now === null) return releaseControl("the gamepad was unplugged");
  const agree = agreeing > 0 && agreeing <= COMMANDS_AGREED && now.throttle === 0;
  send({
    do: "turn", ...now, throttle: agreeing > 0 ? 0 : now.throttle, gear, horn: any("KeyH"), lights,
    stop: state.telemetry?.stop ?? 0, agree,
  });
  if (agreeing > 0) agreeing -= 1;
}

function releaseControl(why) {
  resetControls();
  send({ do: "leave", why });
}

addEventListener("keydown", (event) => {
  const brake = driving() && BRAKES.includes(event.code); // with any modifiers, and wherever the focus is
  if (!brake && (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey)) return;
  if (driving() && (brake || event.code.startsWith("Arrow"))) event.preventDefault();
  if (!event.repeat && event.code === "KeyR" && Math.abs(state.telemetry?.vehicle.speed ?? 0) < 0.3) gear = -gear;
  if (!event.repeat && event.code === "KeyL") lights = !lights;
  pressed.add(event.code);
});
addEventListener("keyup", (event) => {
  if (driving() && event.code === "Space") event.preventDefault(); // space is a brake and must not press a button
});
byId("brake").addEventListener("pointerdown", (event) => {
  event.target.setPointerCapture(event.pointerId);
  pressed.add("Button");
});
byId("brake").addEventListener("lostpointercapture", () => pressed.delete("Button")); // also when released outside
byId("brake").addEventListener("contextmenu", (event) => event.preventDefault());
addEventListener("gamepaddisconnected", (event) => {
  if (event.gamepad.index === gamepad && driving()) releaseControl("the gamepad was unplugged");
});
document.addEventListener("visibilitychange", () => {
  if (document.hidden && driving()) releaseControl("control was released since the page was in the background");
});

// ---- display

function linkPill(link) {
  const trip = link.round_trip === null ? "" : ` ${Math.round(link.round_trip)} ms`;
  const loss = link.loss ? ` ${(100 * link.loss).toFixed(1)} % lost` : "";
  const made = element("span", `${link.name}${link.up ? `${trip}${loss} ${link.rate.toFixed(1)} Mbit/s` : " down"}`, "pill");
  made.dataset.state = link.up ? "running" : "failed";
  return made;
}

function showLinks(links) {
  const pills = links.map(linkPill);
  if (byId("links").innerHTML !== pills.map((one) => one.outerHTML).join("")) byId("links").replaceChildren(...pills);
}

function received(message) {
  if (message.fault) return strip("fault", message.fault);
  if (message.clock !== undefined) return clock.addAnswer(message.clock, message.now_ms);
  state = message;
  sentAt.station = clock.toPage(state.now_ms);
  sentAt.vehicle = state.telemetry && state.telemetry_age_ms !== null ? sentAt.station - state.telemetry_age_ms : -Infinity;
  write(byId("vehicle"), state.vehicle ?? "no vehicle");
  write(byId("station"), state.station);
  byId("fetch").hidden = Boolean(state.vehicle);
  byId("wheel").hidden = byId("drive").hidden = !state.vehicle;
  write(byId("why"), state.vehicle ? "" : state.why);
  if (state.vehicle) for (const one of state.cameras) write(camera(one.camera).name, one.fps ? one.name : `${one.name}: offline`);
  else {
    for (const one of cameras.values()) one.figure.remove();
    cameras.clear();
  }
}

// A cover over the whole page, which appears when the watchdog hasn't run for too long: the browser's compositor animates
// it even while this page's scripts hang.
const hung = byId("hung").animate({ opacity: [0, 0, 1, 1], offset: [0, 0.001, 0.001, 1] }, { duration: 1000 * MAX_AGE, fill: "both" });

// Updates the display, and covers what is outdated. It computes ages from the current time, so that a failure of anything
// is detected without being reported.
function watchdog() {
  hung.currentTime = 0;
  for (const one of cameras.values()) one.updateCover();
  const station = age(sentAt.station) <= MAX_AGE ? state : {},
    telemetry = age(sentAt.vehicle) <= MAX_AGE ? station.telemetry : undefined;
  write(byId("speed"), telemetry ? (3.6 * telemetry.vehicle.speed).toFixed(1) : "-");
  write(byId("gear"), telemetry ? GEARS[driving() ? gear : telemetry.vehicle.gear] : "-");
  write(byId("command"), Number.isFinite(telemetry?.age) ? `${Math.round(telemetry.age)}` : "-");
  showLinks(station.links ?? []);
  byId("take").disabled = station.driver !== null;
  byId("leave").disabled = !driving();
  byId("agree").disabled = !driving() || !telemetry?.standing || station.why !== "";
  write(byId("input"), gamepad === null ? "" : "The gamepad is in use.");
  showStatus(station === state, telemetry !== undefined);
  strip("standing", [...messages(station, telemetry)].map((one) => `${one}. `).join(""));
}

function showAges() {
  for (const one of cameras.values()) one.showAge();
  const ages = [...cameras.values()].map((one) => age(one.captured)).filter(Number.isFinite),
    oldest = Math.max(...ages);
  write(byId("age"), ages.length ? `${Math.round(oldest)}` : "-");
  byId("age").className = oldest > MAX_AGE ? "bad" : "";
}

// Messages for the driver: why the vehicle is stopped, or can't be driven.
function* messages(station, telemetry) {
  if (!state.vehicle) return yield* state.left ? [state.left] : [];
  if (station !== state) return yield `Nothing from the station${sinceText(sentAt.station)}`;
  if (!telemetry) yield `Nothing from the vehicle${sinceText(sentAt.vehicle)}`;
  if (telemetry?.standing) yield `The vehicle is stopped: ${telemetry.reason}`;
  yield* telemetry?.vehicle.faults ?? [];
  if (station.driver === null && station.left) yield station.left;
  if (station.why) yield `Driving is not possible: ${station.why}`;
}

// "live" only if nothing displayed is outdated; `station`, `vehicle`: whether each has sent its state recently
function showStatus(station, vehicle) {
  const outdated = [...cameras.values()].filter((one) => one.outdated),
    faults = [];
  if (connection) faults.push(connection);
  else if (!station) faults.push("the station does not respond");
  else if (state.vehicle && !vehicle) faults.push("the vehicle does not respond");
  if (state.vehicle && outdated.length === cameras.size)
    faults.push(`no picture${sinceText(Math.max(...outdated.map((one) => one.captured)))}`);
  else if (outdated.length) faults.push(`no picture: ${outdated.map((one) => one.name.textContent).join(", ")}`);
  write(byId("status"), faults.join(", ") || (state.vehicle ? "live" : "connected"));
  byId("status").dataset.state = faults.length ? "lost" : state.vehicle ? "live" : "waiting";
}

byId("take").addEventListener("click", () => {
  strip("fault", null);
  send({ do: "take" });
});
byId("leave").addEventListener("click", () => releaseControl("the driver released the controls"));
byId("agree").addEventListener("click", () => (agreeing = COMMANDS_SEEN + COMMANDS_AGREED));
byId("release").addEventListener("click", () => send({ do: "release", vehicle: state.vehicle }));
byId("fetch").addEventListener("submit", (event) => {
  event.preventDefault();
  strip("fault", null);
  send({ do: "join", vehicle: event.target.elements.vehicle.value });
});
byId("token").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", event.target.elements.token.value);
  byId("token").hidden = true;
});

const hex = (text) => [...new TextEncoder().encode(text)].map((one) => one.toString(16).padStart(2, "0")).join("");

async function connect() {
  try {
    await request("/api/station", AbortSignal.timeout(5000));
  } catch (error) {
    byId("token").hidden = !(error instanceof NoToken);
    throw error instanceof NoToken ? new Error("a token is required") : error;
  }
  const token = sessionStorage.getItem("token");
  socket = new WebSocket(`/live`.replace(/^/, location.origin.replace(/^http/, "ws")), ["scan2sim", ...(token ? [`token.${hex(token)}`] : [])]);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    connection = "";
    clock = new Clock();
    clock.synchronize();
    for (const one of cameras.values()) one.started = false; // frames are missing: continue at a key frame
  };
  socket.onmessage = (event) =>
    typeof event.data === "string" ? received(JSON.parse(event.data)) : receiveFrame(event.data);
  await new Promise((done) => (socket.onclose = done));
  throw new Error("the station is not reachable");
}

(async () => {
  if (!("VideoDecoder" in window)) return strip("fault", "This browser decodes no video here: it needs WebCodecs, and a page from localhost or by https.");
  setInterval(sendCommand, PERIOD);
  setInterval(() => clock.synchronize(), CLOCK_PERIOD);
  setInterval(showAges, AGES_PERIOD);
  setInterval(() => {
    if (driving()) chooseGamepad();
    watchdog();
  }, WATCHDOG_PERIOD);
  document.addEventListener("visibilitychange", watchdog);
  for (;;) {
    try {
      await connect();
    } catch (error) {
      connection = error.message;
    }
    await new Promise((done) => setTimeout(done, 1000));
  }
})();
