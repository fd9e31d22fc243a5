// The station's page: decodes the vehicle's pictures, shows their age, covers what is old, and sends the driver's commands.
"use strict";

const OLD = 300; // ms after which a picture, or what is known of vehicle and station, is covered
const WATCH = 25, // ms between two runs of the watchdog
  AGES = 100, // between two updates of the ages that are shown as numbers
  COMPARE = 200; // between two comparisons of clocks
const HEADER = 14; // bytes before a picture
const GEARS = { "-1": "back", 0: "neutral", 1: "forwards" };
const QUEUE = 8; // pictures that may wait for their decoding; a page that falls behind continues at the next key frame
const SEEN = 5, // sendings that name a stop without agreeing, which the vehicle wants first, however quick the driver is
  AGREED = 10; // sendings that agree

let socket = null,
  connection = "waiting", // why there is none; "": there is
  facts = {},
  lights = false,
  gear = 1,
  agreeing = 0;
const cameras = new Map();

// A text that stays costs no layout, and isn't read aloud again.
function write(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function strip(id, text) {
  byId(id).hidden = !text;
  write(byId(id), text ?? "");
}

function send(said) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(said));
}

const driving = () => facts.driver !== undefined && facts.driver === facts.you;

// ages: times of capture and sending are of this page's clock (ms), -Infinity where unknown

// The station's clock as this page's. The station reads its clock after the page has sent its own time, so no difference
// of the two is too large, and the largest is the closest: ages are never too small, whatever the way back takes.
class Clock {
  static KEPT = 16; // differences: those of the last 3 s

  constructor() {
    this.differences = [];
  }

  ask() {
    send({ do: "clock", sent: performance.now() });
  }

  answered(sent, station) {
    this.differences = [...this.differences, sent - station].slice(-Clock.KEPT);
  }

  here(station) {
    return station + Math.max(...this.differences);
  }
}

let clock = new Clock();

const known = { station: -Infinity, vehicle: -Infinity }; // when the station and the vehicle sent what is shown of them
const age = (since) => performance.now() - since;
const silence = (since) => (Number.isFinite(since) ? ` since ${(age(since) / 1000).toFixed(1)} s` : "");

// pictures

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
    const later = [...cameras.values()].find((one) => one.number > number); // the first is the largest, whichever comes first
    byId("cameras").insertBefore(this.figure, later?.figure ?? null);
  }

  begin() {
    this.started = false;
    this.decoder = new VideoDecoder({ output: (picture) => this.draw(picture), error: () => this.begin() });
    this.decoder.configure({ codec: "vp8", optimizeForLatency: true });
  }

  // `captured`: ms of the station's clock; it comes back with the picture as its timestamp
  take(key, captured, data) {
    if (this.decoder.decodeQueueSize > QUEUE) this.decoder.close();
    if (this.decoder.state !== "configured") this.begin();
    const dated = Number.isFinite(captured); // else the station doesn't know the vehicle's clock yet
    this.started = dated && (key || this.started);
    if (!this.started) return send({ do: "key", camera: this.number });
    this.decoder.decode(new EncodedVideoChunk({ type: key ? "key" : "delta", timestamp: Math.round(captured * 1000), data }));
  }

  draw(picture) {
    if (this.canvas.width !== picture.displayWidth || this.canvas.height !== picture.displayHeight) {
      this.canvas.width = picture.displayWidth;
      this.canvas.height = picture.displayHeight;
    }
    const context = this.canvas.getContext("2d");
    this.captured = clock.here(picture.timestamp / 1000);
    context.drawImage(picture, 0, 0);
    picture.close();
    this.shown += 1;
    this.figure.dataset.shown = this.shown;
    context.font = "600 20px system-ui, sans-serif";
    context.fillStyle = "rgba(0, 0, 0, .55)";
    context.fillRect(this.canvas.width - 96, 8, 88, 28);
    context.fillStyle = "#fff";
    context.textAlign = "right";
    context.fillText(`${Math.round(age(this.captured))} ms`, this.canvas.width - 14, 29);
  }

  get old() {
    return age(this.captured) > OLD;
  }

  coverOld() {
    this.cover.hidden = !this.old;
    write(this.cover, `no picture${silence(this.captured)}`);
  }

  showAge() {
    if (!Number.isFinite(this.captured)) return;
    this.figure.dataset.age = Math.round(age(this.captured));
    write(this.age, `${this.figure.dataset.age} ms`);
    this.age.className = this.old ? "bad" : "";
  }
}

function camera(number) {
  const known = cameras.get(number);
  if (known) return known;
  const made = new Camera(number),
    all = [...cameras.values(), made].sort((one, other) => one.number - other.number);
  cameras.clear();
  for (const one of all) cameras.set(one.number, one);
  return made;
}

function picture(buffer) {
  const view = new DataView(buffer);
  camera(view.getUint8(0)).take(view.getUint8(1) === 1, view.getFloat64(6, true), buffer.slice(HEADER));
}

// commands

function drive() {
  if (!driving()) return;
  const now = controls();
  if (now === null) return leave("the gamepad was unplugged");
  const agree = agreeing > 0 && agreeing <= AGREED && now.throttle === 0;
  send({
    do: "turn", ...now, throttle: agreeing > 0 ? 0 : now.throttle, gear, horn: any("KeyH"), lights,
    stop: facts.telemetry?.stop ?? 0, agree,
  });
  if (agreeing > 0) agreeing -= 1;
}

function leave(why) {
  resetControls();
  send({ do: "leave", why });
}

addEventListener("keydown", (event) => {
  const brake = driving() && BRAKES.includes(event.code); // whatever else is held, wherever the focus is
  if (!brake && (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey)) return;
  if (driving() && (brake || event.code.startsWith("Arrow"))) event.preventDefault();
  if (!event.repeat && event.code === "KeyR" && Math.abs(facts.telemetry?.vehicle.speed ?? 0) < 0.3) gear = -gear;
  if (!event.repeat && event.code === "KeyL") lights = !lights;
  pressed.add(event.code);
});
addEventListener("keyup", (event) => {
  if (driving() && event.code === "Space") event.preventDefault(); // it brakes, and presses no button
});
byId("brake").addEventListener("pointerdown", (event) => {
  event.target.setPointerCapture(event.pointerId);
  pressed.add("Button");
});
byId("brake").addEventListener("lostpointercapture", () => pressed.delete("Button")); // released, also outside
byId("brake").addEventListener("contextmenu", (event) => event.preventDefault());
addEventListener("gamepaddisconnected", (event) => {
  if (event.gamepad.index === gamepad && driving()) leave("the gamepad was unplugged");
});
document.addEventListener("visibilitychange", () => {
  if (document.hidden && driving()) leave("the page was in the background: driving was released");
});

// the view

function pill(link) {
  const trip = link.round_trip === null ? "" : ` ${Math.round(link.round_trip)} ms`;
  const loss = link.loss ? ` ${(100 * link.loss).toFixed(1)} % lost` : "";
  const made = element("span", `${link.name}${link.up ? `${trip}${loss} ${link.rate.toFixed(1)} Mbit/s` : " down"}`, "pill");
  made.dataset.state = link.up ? "running" : "failed";
  return made;
}

function showLinks(links) {
  const pills = links.map(pill);
  if (byId("links").innerHTML !== pills.map((one) => one.outerHTML).join("")) byId("links").replaceChildren(...pills);
}

function received(message) {
  if (message.fault) return strip("fault", message.fault);
  if (message.clock !== undefined) return clock.answered(message.clock, message.now_ms);
  facts = message;
  known.station = clock.here(facts.now_ms);
  known.vehicle = facts.telemetry && facts.telemetry_age_ms !== null ? known.station - facts.telemetry_age_ms : -Infinity;
  write(byId("vehicle"), facts.vehicle ?? "no vehicle");
  write(byId("station"), facts.station);
  byId("fetch").hidden = Boolean(facts.vehicle);
  byId("wheel").hidden = byId("drive").hidden = !facts.vehicle;
  write(byId("why"), facts.vehicle ? "" : facts.why);
  if (facts.vehicle) for (const one of facts.cameras) write(camera(one.camera).name, one.fps ? one.name : `${one.name}: gone`);
  else {
    for (const one of cameras.values()) one.figure.remove();
    cameras.clear();
  }
}

// A cover over the whole page that appears when the watchdog doesn't run for so long: the browser's compositor animates it,
// also while this page's scripts hang.
const hung = byId("hung").animate({ opacity: [0, 0, 1, 1], offset: [0, 0.001, 0.001, 1] }, { duration: 1000 * OLD, fill: "both" });

// Shows what is known, and covers what is old. It counts from now, so that whatever stops is old soon, also where nothing
// says that it stopped.
function watchdog() {
  hung.currentTime = 0;
  for (const one of cameras.values()) one.coverOld();
  const station = age(known.station) <= OLD ? facts : {},
    telemetry = age(known.vehicle) <= OLD ? station.telemetry : undefined;
  write(byId("speed"), telemetry ? (3.6 * telemetry.vehicle.speed).toFixed(1) : "-");
  write(byId("gear"), telemetry ? GEARS[driving() ? gear : telemetry.vehicle.gear] : "-");
  write(byId("command"), Number.isFinite(telemetry?.age) ? `${Math.round(telemetry.age)}` : "-");
  showLinks(station.links ?? []);
  byId("take").disabled = station.driver !== null;
  byId("leave").disabled = !driving();
  byId("agree").disabled = !driving() || !telemetry?.standing || station.why !== "";
  write(byId("input"), gamepad === null ? "" : "The gamepad drives.");
  showStatus(station === facts, telemetry !== undefined);
  strip("standing", [...hindrances(station, telemetry)].map((one) => `${one}. `).join(""));
}

function showAges() {
  for (const one of cameras.values()) one.showAge();
  const ages = [...cameras.values()].map((one) => age(one.captured)).filter(Number.isFinite),
    oldest = Math.max(...ages);
  write(byId("age"), ages.length ? `${Math.round(oldest)}` : "-");
  byId("age").className = oldest > OLD ? "bad" : "";
}

function* hindrances(station, telemetry) {
  if (!facts.vehicle) return yield* facts.left ? [facts.left] : [];
  if (station !== facts) return yield `Nothing from the station${silence(known.station)}`;
  if (!telemetry) yield `Nothing from the vehicle${silence(known.vehicle)}`;
  if (telemetry?.standing) yield `The vehicle stands: ${telemetry.reason}`;
  yield* telemetry?.vehicle.faults ?? [];
  if (station.driver === null && station.left) yield station.left;
  if (station.why) yield `Nobody may drive: ${station.why}`;
}

// "live" only if nothing that is shown is old; `station`, `vehicle`: whether these sent something lately
function showStatus(station, vehicle) {
  const old = [...cameras.values()].filter((one) => one.old),
    faults = [];
  if (connection) faults.push(connection);
  else if (!station) faults.push("the station is silent");
  else if (facts.vehicle && !vehicle) faults.push("the vehicle is silent");
  if (facts.vehicle && old.length === cameras.size) faults.push(`no picture${silence(Math.max(...old.map((one) => one.captured)))}`);
  else if (old.length) faults.push(`no picture: ${old.map((one) => one.name.textContent).join(", ")}`);
  write(byId("status"), faults.join(", ") || (facts.vehicle ? "live" : "connected"));
  byId("status").dataset.state = faults.length ? "lost" : facts.vehicle ? "live" : "waiting";
}

byId("take").addEventListener("click", () => {
  strip("fault", null);
  send({ do: "take" });
});
byId("leave").addEventListener("click", () => leave("the driver left it"));
byId("agree").addEventListener("click", () => (agreeing = SEEN + AGREED));
byId("release").addEventListener("click", () => send({ do: "release", vehicle: facts.vehicle }));
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

async function watch() {
  try {
    await ask("/api/station", AbortSignal.timeout(5000));
  } catch (error) {
    byId("token").hidden = !(error instanceof NoToken);
    throw error instanceof NoToken ? new Error("needs a token") : error;
  }
  const token = sessionStorage.getItem("token");
  socket = new WebSocket(`/live`.replace(/^/, location.origin.replace(/^http/, "ws")), ["scan2sim", ...(token ? [`token.${hex(token)}`] : [])]);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    connection = "";
    clock = new Clock();
    clock.ask();
    for (const one of cameras.values()) one.started = false; // what was sent meanwhile is missing
  };
  socket.onmessage = (event) => (typeof event.data === "string" ? received(JSON.parse(event.data)) : picture(event.data));
  await new Promise((done) => (socket.onclose = done));
  throw new Error("the station isn't reached");
}

(async () => {
  if (!("VideoDecoder" in window)) return strip("fault", "This browser decodes no video here: it needs WebCodecs, and a page from localhost or by https.");
  setInterval(drive, PERIOD);
  setInterval(() => clock.ask(), COMPARE);
  setInterval(showAges, AGES);
  setInterval(() => {
    if (driving()) chooseGamepad();
    watchdog();
  }, WATCH);
  document.addEventListener("visibilitychange", watchdog);
  for (;;) {
    try {
      await watch();
    } catch (error) {
      connection = error.message;
    }
    await new Promise((done) => setTimeout(done, 1000));
  }
})();
