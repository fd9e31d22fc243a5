// Driver page of a station: sends the driver's commands, and shows the state of vehicle and station. Its worker
// (cockpit-view.js) holds the connection, and decodes, draws and covers the video.
"use strict";

const WATCHDOG_PERIOD = 10, // interval of the watchdog, ms
  AGES_PERIOD = 100, // interval at which displayed ages are updated, ms
  STANDING = 0.3, // speed below which a vehicle stands, m/s
  GEAR_KEPT_PERIOD = 3000; // time for which the reason is shown why the gear stays, ms
const GEARS = { "-1": "reverse", 0: "neutral", 1: "forwards" };
const COMMANDS_SEEN = 5, // commands that name a stop without agreeing, which the vehicle requires first
  COMMANDS_AGREED = 10; // commands that agree
const RELEASE_HOLD = 1000; // time for which the button that ends an emergency stop is held, ms

let connection = "waiting", // why there is no connection; "": there is one
  state = {}, // last state from the station
  lights = false,
  gear = 1,
  gearKept = null, // when the driver wanted to change the gear while the vehicle moved
  agreeing = 0,
  stood = true, // whether the vehicle was stopped at the last update
  stopping = false; // the driver has demanded an emergency stop that the station has not reported yet
const cameras = new Map();
const sentAt = { station: -Infinity, vehicle: -Infinity, worker: -Infinity }; // when they sent what is displayed
const worker = new Worker("/pages/cockpit-view.js");

// Sets a text only if it has changed, which avoids layout and repeated announcements by screen readers.
function write(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

function strip(id, text) {
  byId(id).hidden = !text;
  write(byId(id), text ?? "");
}

// Sends a message to the station; replaces the function of the same name in stream.js.
function send(message) {
  worker.postMessage({ send: message });
}

const driving = () => state.driver !== undefined && state.driver === state.you;

// ---- video

class Camera {
  constructor(number) {
    this.number = number;
    this.figure = element("figure");
    this.canvas = element("canvas");
    this.cover = element("p", "no picture", "cover"); // for a worker that doesn't draw one
    this.caption = element("figcaption");
    this.name = element("b", `camera ${number}`);
    this.age = element("output", "-");
    this.caption.append(this.name, this.age);
    this.figure.append(this.canvas, this.cover, this.caption);
    this.captured = -Infinity;
    const later = [...cameras.values()].find((one) => one.number > number); // the first camera is the largest
    byId("cameras").insertBefore(this.figure, later?.figure ?? byId("map"));
    const canvas = this.canvas.transferControlToOffscreen();
    worker.postMessage({ canvas, camera: number }, [canvas]);
  }

  get outdated() {
    return age(this.captured) > MAX_AGE;
  }

  update({ captured, shown, coveredAt }) {
    this.captured = captured;
    this.figure.dataset.shown = shown;
    this.figure.dataset.covered = coveredAt ?? "";
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
  byId("cameras").dataset.count = cameras.size;
  return created;
}

function removeCameras() {
  for (const one of cameras.values()) one.figure.remove();
  if (cameras.size) worker.postMessage({ remove: true });
  cameras.clear();
}

// ---- commands

function sendCommand() {
  if (stopping) send({ do: "stop" });
  const current = controls();
  sendOverlay(current);
  if (emergency()) demandStop();
  if (!driving()) return;
  if (current === null) return releaseControl("the gamepad was unplugged");
  const agree = agreeing > 0 && agreeing <= COMMANDS_AGREED && current.throttle === 0;
  send({
    do: "turn", ...current, throttle: agreeing > 0 ? 0 : current.throttle, gear, horn: any("KeyH"), lights,
    stop: state.telemetry?.stop ?? 0, agree,
  });
  if (agreeing > 0) agreeing -= 1;
}

function releaseControl(why) {
  resetControls();
  send({ do: "leave", why });
}

// Latches an emergency stop, whoever drives: it is repeated until the station reports it.
function demandStop() {
  if (!state.vehicle) return;
  stopping = true;
  agreeing = 0;
  send({ do: "stop" });
}

addEventListener("keydown", (event) => {
  const brake = driving() && BRAKES.includes(event.code), // with any modifiers, and wherever the focus is
    typing = event.target instanceof HTMLInputElement,
    stop = STOPS.includes(event.code) && !(typing && event.code === "Backspace");
  if (stop && !event.repeat) demandStop();
  if (!brake && !stop && (typing || event.ctrlKey || event.metaKey || event.altKey)) return;
  if (driving() && (brake || stop || event.code.startsWith("Arrow"))) event.preventDefault();
  if (!event.repeat) pressedOnce(event);
  pressed.add(event.code);
});

function pressedOnce({ code, key }) {
  if (code === "KeyR" && driving()) changeGear();
  if (code === "KeyL") lights = !lights;
  if (code === "KeyF") toggleFullScreen();
  if (code === "KeyN") toggleNight();
  if (code === "KeyP") geometry("shown").click();
  if (key === "?") toggleHelp();
}

// Changes between forwards and reverse if the vehicle is known to stand; if it doesn't report its speed, while the driver
// brakes.
function changeGear() {
  const vehicle = freshVehicle(),
    braking = [...pressed].some((code) => BRAKES.includes(code)),
    standing = Number.isFinite(vehicle?.speed) ? Math.abs(vehicle.speed) < STANDING : vehicle !== undefined && braking;
  gearKept = standing ? null : now();
  if (standing) gear = -gear;
}

addEventListener("keyup", (event) => {
  if (driving() && event.code === "Space") event.preventDefault(); // space is a brake and must not press a button
});
byId("brake").addEventListener("pointerdown", (event) => {
  event.target.setPointerCapture(event.pointerId);
  pressed.add("Button");
});
byId("brake").addEventListener("lostpointercapture", () => pressed.delete("Button")); // also when released outside
byId("brake").addEventListener("contextmenu", (event) => event.preventDefault());
byId("stop").addEventListener("pointerdown", demandStop); // when pressed, not when released
byId("stop").addEventListener("click", demandStop); // from the keyboard and by assistive technology

// The emergency stop ends only when this button is held, by pointer or by Enter: a touch alone isn't deliberate.
let held = null;
function hold(event) {
  if (held !== null || (event.type === "keydown" && event.code !== "Enter")) return;
  held = setTimeout(() => {
    stopping = false;
    send({ do: "unlatch" });
  }, RELEASE_HOLD);
  byId("unlatch").dataset.held = "";
}
function letGo() {
  clearTimeout(held);
  held = null;
  delete byId("unlatch").dataset.held;
}
for (const type of ["pointerdown", "keydown"]) byId("unlatch").addEventListener(type, hold);
for (const type of ["pointerup", "pointerleave", "pointercancel", "keyup", "blur"]) byId("unlatch").addEventListener(type, letGo);
byId("unlatch").addEventListener("contextmenu", (event) => event.preventDefault());

addEventListener("gamepaddisconnected", (event) => {
  if (event.gamepad.index === gamepad && driving()) releaseControl("the gamepad was unplugged");
});
document.addEventListener("visibilitychange", () => {
  if (document.hidden && driving()) releaseControl("control was released since the page was in the background");
});

// ---- screen

let leavingFullScreen = false;

async function toggleFullScreen() {
  leavingFullScreen = Boolean(document.fullscreenElement);
  if (leavingFullScreen) return document.exitFullscreen();
  await document.documentElement.requestFullscreen();
  await navigator.keyboard?.lock?.(STOPS).catch(() => {}); // so that the page sees Escape before the browser does
}

document.addEventListener("fullscreenchange", () => {
  if (document.fullscreenElement) return;
  if (!leavingFullScreen && driving()) demandStop(); // the browser took Escape for itself
  leavingFullScreen = false;
});
byId("full").addEventListener("click", toggleFullScreen);

function toggleNight() {
  document.body.toggleAttribute("data-night");
}

// Geometry of the predicted path, stored for each vehicle.
const geometry = (name) => document.querySelector(`#geometry [name=${name}]`);
let path = null; // null: the path isn't drawn

function loadGeometry(vehicle) {
  const stored = { ...PATH, shown: false, ...JSON.parse(localStorage.getItem(`path ${vehicle}`) ?? "{}") };
  for (const name of Object.keys(PATH)) geometry(name).value = stored[name];
  geometry("shown").checked = stored.shown;
  path = stored.shown ? stored : null;
}

byId("geometry").addEventListener("change", ({ target }) => {
  if (!target.checkValidity()) return target.reportValidity();
  const values = Object.fromEntries(Object.keys(PATH).map((name) => [name, Number(geometry(name).value)]));
  localStorage.setItem(`path ${state.vehicle}`, JSON.stringify({ ...values, shown: geometry("shown").checked }));
  loadGeometry(state.vehicle);
});

let history = []; // the latest steering, [time, value]

// Sends the worker what it draws into the first picture; speed and gear only if they are not outdated.
function sendOverlay(current) {
  const { steering = 0, throttle = 0, brake = 0 } = (driving() && current) || {},
    at = now(),
    vehicle = freshVehicle();
  history = [...history.filter(([when]) => when > at - 1000), [at, steering]];
  worker.postMessage({
    overlay: {
      at, steering, throttle, brake, history, path,
      speed: vehicle?.speed ?? null, gear: vehicle ? GEARS[driving() ? gear : vehicle.gear] : "",
      standing: Boolean(vehicle && state.telemetry.standing),
    },
  });
}

function toggleHelp() {
  byId("help").hidden = !byId("help").hidden;
  byId("keys").ariaExpanded = String(!byId("help").hidden);
}
byId("keys").addEventListener("click", toggleHelp);

// ---- display

function linkPill(link) {
  const trip = link.round_trip === null ? "" : ` ${Math.round(link.round_trip)} ms`;
  const loss = link.loss ? ` ${(100 * link.loss).toFixed(1)} % lost` : "";
  const up = link.up && !(link.silent_ms > MAX_AGE),
    why = link.up ? ` silent since ${(link.silent_ms / 1000).toFixed(1)} s` : " down";
  const made = element("span", `${link.name}${up ? `${trip}${loss} ${link.rate.toFixed(1)} Mbit/s` : why}`, "pill");
  made.dataset.state = up ? "running" : "failed";
  return made;
}

function showLinks(links) {
  const pills = links.map(linkPill);
  if (byId("links").innerHTML !== pills.map((one) => one.outerHTML).join("")) byId("links").replaceChildren(...pills);
}

function received(message, sent, vehicle) {
  if (message.fault) return strip("fault", message.fault);
  state = message;
  sentAt.station = sent;
  sentAt.vehicle = vehicle;
  if (state.latched) stopping = false; // the station has it
  if (state.vehicle && byId("vehicle").textContent !== state.vehicle) loadGeometry(state.vehicle);
  write(byId("vehicle"), state.vehicle ?? "no vehicle");
  write(byId("station"), state.station);
  byId("fetch").hidden = Boolean(state.vehicle);
  byId("wheel").hidden = byId("drive").hidden = !state.vehicle;
  write(byId("why"), state.vehicle ? "" : state.why);
  if (state.vehicle) for (const one of state.cameras) write(camera(one.camera).name, one.fps ? one.name : `${one.name}: offline`);
  else removeCameras();
}

// A cover over the whole page, which appears when the watchdog hasn't run for too long: the browser's compositor animates
// it even while this page's scripts hang; the worker draws its text.
const hung = byId("hung").animate({ opacity: [0, 0, 1, 1], offset: [0, 0.001, 0.001, 1] }, { duration: 1000 * MAX_AGE, fill: "both" });
const noticeCanvas = byId("hung").firstElementChild.transferControlToOffscreen();
worker.postMessage({ notice: noticeCanvas }, [noticeCanvas]);

// Last reported state of the vehicle; undefined: it is outdated.
function freshVehicle() {
  const { telemetry } = state;
  if (age(sentAt.station) > MAX_AGE || !telemetry || age(sentAt.vehicle - telemetry.vehicle_age_ms) > MAX_AGE) return;
  return telemetry.vehicle;
}

// Updates the display, and covers what is outdated. It computes ages from the current time, so that a failure of anything
// is detected without being reported.
function watchdog() {
  hung.currentTime = 0;
  worker.postMessage({ alive: now() });
  for (const one of cameras.values()) one.updateCover();
  const station = age(sentAt.station) <= MAX_AGE ? state : {},
    telemetry = age(sentAt.vehicle) <= MAX_AGE ? station.telemetry : undefined,
    vehicle = freshVehicle();
  write(byId("speed"), Number.isFinite(vehicle?.speed) ? (3.6 * vehicle.speed).toFixed(1) : "-");
  write(byId("gear"), vehicle ? GEARS[driving() ? gear : vehicle.gear] : "-");
  write(byId("command"), Number.isFinite(telemetry?.age) ? `${Math.round(telemetry.age)}` : "-");
  showLinks(telemetry ? station.links : []);
  showMap(vehicle);
  byId("take").disabled = station.driver !== null;
  byId("leave").disabled = !driving();
  byId("agree").disabled = !driving() || !telemetry?.standing || station.why !== "" || Boolean(station.latched);
  byId("latched").hidden = !(station.latched || stopping);
  write(byId("latched").firstElementChild, station.latched ? `Emergency stop, pressed by ${station.latched}.` : "Emergency stop.");
  write(byId("input"), inputText());
  if (telemetry?.standing && !stood && driving()) rumble(gamepads());
  stood = telemetry?.standing ?? stood;
  showStatus(station === state, vehicle !== undefined);
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
  if (gearKept !== null && age(gearKept) < GEAR_KEPT_PERIOD)
    yield Number.isFinite(freshVehicle()?.speed)
      ? "The gear stays: the vehicle is moving"
      : "The gear stays: the vehicle's speed is not known; brake while you press R";
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
  if (faults.length === 0) delete byId("status").dataset.lost;
  else byId("status").dataset.lost ??= now(); // when it ceased to be live
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
  sessionStorage.setItem("token", event.target.elements.token.value.trim());
  byId("token").hidden = true;
});

// ---- connection, held by the worker

let closed = () => {};
worker.onmessage = ({ data }) => {
  if (data.opened) connection = "";
  if (data.closed) closed();
  if (data.camera !== undefined) camera(data.camera);
  if (data.message) received(data.message, data.sent, data.vehicle);
  if (data.status) {
    sentAt.worker = data.at;
    for (const one of data.status) cameras.get(one.number)?.update(one);
  }
};

const hex = (text) => [...new TextEncoder().encode(text)].map((one) => one.toString(16).padStart(2, "0")).join("");

async function connect() {
  try {
    await request("/api/station", AbortSignal.timeout(5000));
  } catch (error) {
    byId("token").hidden = !(error instanceof NoToken);
    throw error instanceof NoToken ? new Error(tokenFault()) : error;
  }
  loadMap();
  const token = sessionStorage.getItem("token"),
    url = `${location.origin.replace(/^http/, "ws")}/live`;
  const ended = new Promise((done) => (closed = done));
  worker.postMessage({ open: { url, protocols: ["scan2sim", ...(token ? [`token.${hex(token)}`] : [])] } });
  await ended;
  throw new Error("the station is not reachable");
}

(async () => {
  if (!("VideoDecoder" in window)) return strip("fault", "This browser decodes no video here: it needs WebCodecs, and a page from localhost or by https.");
  setInterval(sendCommand, PERIOD);
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
