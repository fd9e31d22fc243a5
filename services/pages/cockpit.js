// The station's page: decodes the vehicle's pictures, tells how old they are, and sends what the driver asks for.
"use strict";

const TURNS = 20; // ms between two sendings of what is asked for
const OLD = 300; // ms from which a picture's age is shown as bad
const HEADER = 14; // bytes before a picture
const SEEN = 5, // sendings that name a stop without agreeing, which the vehicle wants first, however quick the driver is
  AGREED = 10; // sendings that agree

let socket = null,
  facts = {},
  lights = false,
  gear = 1,
  agreeing = 0;
const cameras = new Map(),
  pressed = new Set(),
  wheel = { steering: 0, throttle: 0, brake: 0 };

function strip(id, text) {
  byId(id).hidden = !text;
  byId(id).textContent = text ?? "";
}

function send(said) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify(said));
}

const driving = () => facts.driver !== undefined && facts.driver === facts.you;

// pictures

class Camera {
  constructor(number) {
    this.number = number;
    this.figure = element("figure");
    this.canvas = element("canvas");
    this.caption = element("figcaption");
    this.name = element("b", `camera ${number}`);
    this.age = element("output", "-");
    this.caption.append(this.name, this.age);
    this.figure.append(this.canvas, this.caption);
    this.arrivals = new Map(); // when a picture is taken to have been captured, by its timestamp, on this page's clock
    this.captured = null;
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

  take(key, age, data) {
    if (!this.started && !key) return send({ do: "key", camera: this.number });
    if (this.decoder.state !== "configured") this.begin();
    this.started = true;
    const timestamp = Math.round(performance.now() * 1000);
    this.arrivals.set(timestamp, performance.now() - age);
    this.decoder.decode(new EncodedVideoChunk({ type: key ? "key" : "delta", timestamp, data }));
  }

  draw(picture) {
    const captured = this.arrivals.get(picture.timestamp) ?? performance.now();
    for (const one of this.arrivals.keys()) if (one <= picture.timestamp) this.arrivals.delete(one);
    if (this.canvas.width !== picture.displayWidth || this.canvas.height !== picture.displayHeight) {
      this.canvas.width = picture.displayWidth;
      this.canvas.height = picture.displayHeight;
    }
    const context = this.canvas.getContext("2d"),
      age = Math.round(performance.now() - captured);
    context.drawImage(picture, 0, 0);
    picture.close();
    this.captured = captured;
    this.shown += 1;
    this.figure.dataset.shown = this.shown;
    context.font = "600 20px system-ui, sans-serif";
    context.fillStyle = "rgba(0, 0, 0, .55)";
    context.fillRect(this.canvas.width - 96, 8, 88, 28);
    context.fillStyle = age > OLD ? "#ff6b60" : "#fff";
    context.textAlign = "right";
    context.fillText(`${age} ms`, this.canvas.width - 14, 29);
  }

  // a picture that stays grows old
  tell() {
    if (this.captured === null) return;
    const age = Math.round(performance.now() - this.captured);
    this.age.textContent = `${age} ms`;
    this.figure.dataset.age = age;
    this.age.className = age > OLD ? "bad" : "";
    return age;
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

// what the driver asks for

function ramped(value, wanted, rate) {
  const step = rate * (TURNS / 1000);
  return Math.abs(wanted - value) <= step ? wanted : value + Math.sign(wanted - value) * step;
}

const any = (...codes) => codes.some((code) => pressed.has(code));

function asked() {
  const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one?.connected && one.index === gamepad);
  if (gamepad !== null && !pad) return null; // it was driven by a gamepad that is gone: nobody asks for anything
  if (pad) {
    const axis = pad.axes[0] ?? 0;
    wheel.steering = Math.abs(axis) < 0.05 ? 0 : -axis;
    wheel.throttle = pad.buttons[7]?.value ?? 0;
    wheel.brake = pad.buttons[6]?.value ?? 0;
  } else {
    const turn = (any("ArrowLeft", "KeyA") ? 1 : 0) - (any("ArrowRight", "KeyD") ? 1 : 0);
    wheel.steering = ramped(wheel.steering, turn, turn ? 1.6 : 3);
    wheel.throttle = ramped(wheel.throttle, any("ArrowUp", "KeyW") ? 1 : 0, any("ArrowUp", "KeyW") ? 1.2 : 5);
    wheel.brake = ramped(wheel.brake, any("ArrowDown", "KeyS", "Space") ? 1 : 0, 5);
  }
  return wheel;
}

let gamepad = null;

function turn() {
  if (!driving()) return;
  const now = asked();
  if (now === null) {
    gamepad = null;
    return leave("the gamepad was unplugged");
  }
  const agree = agreeing > 0 && agreeing <= AGREED && now.throttle === 0;
  send({
    do: "turn", ...now, throttle: agreeing > 0 ? 0 : now.throttle, gear, horn: any("KeyH"), lights,
    stop: facts.telemetry?.stop ?? 0, agree,
  });
  if (agreeing > 0) agreeing -= 1;
}

function leave(why) {
  pressed.clear();
  gamepad = null;
  Object.assign(wheel, { steering: 0, throttle: 0, brake: 0 });
  send({ do: "leave", why });
}

addEventListener("keydown", (event) => {
  if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) return;
  if (driving() && (event.code.startsWith("Arrow") || event.code === "Space")) event.preventDefault();
  if (!event.repeat && event.code === "KeyR" && Math.abs(facts.telemetry?.vehicle.speed ?? 0) < 0.3) gear = -gear;
  if (!event.repeat && event.code === "KeyL") lights = !lights;
  pressed.add(event.code);
});
addEventListener("keyup", (event) => pressed.delete(event.code));
addEventListener("blur", () => pressed.clear());
addEventListener("gamepaddisconnected", (event) => {
  if (event.gamepad.index === gamepad && driving()) leave("the gamepad was unplugged");
});
document.addEventListener("visibilitychange", () => {
  if (document.hidden && driving()) leave("the page was in the background: driving was released");
});

// what is told

function pill(link) {
  const trip = link.round_trip === null ? "" : ` ${Math.round(link.round_trip)} ms`;
  const loss = link.loss ? ` ${(100 * link.loss).toFixed(1)} % lost` : "";
  const made = element("span", `${link.name}${link.up ? `${trip}${loss} ${link.rate.toFixed(1)} Mbit/s` : " down"}`, "pill");
  made.dataset.state = link.up ? "running" : "failed";
  return made;
}

function tell(told) {
  if (told.fault) return strip("fault", told.fault);
  facts = told;
  const there = told.vehicle !== null,
    telemetry = told.telemetry;
  byId("vehicle").textContent = told.vehicle ?? "no vehicle";
  byId("station").textContent = told.station;
  byId("fetch").hidden = there;
  byId("wheel").hidden = byId("drive").hidden = !there;
  byId("why").textContent = there ? "" : told.why;
  if (!there) {
    for (const one of cameras.values()) one.figure.remove();
    cameras.clear();
    strip("standing", told.left || null);
    return;
  }
  for (const one of told.cameras) camera(one.camera).name.textContent = one.fps ? one.name : `${one.name}: gone`;
  byId("speed").textContent = telemetry ? (3.6 * telemetry.vehicle.speed).toFixed(1) : "-";
  byId("gear").textContent = { "-1": "back", 0: "neutral", 1: "forwards" }[driving() ? gear : (telemetry?.vehicle.gear ?? 0)];
  byId("command").textContent = telemetry && Number.isFinite(telemetry.age) ? Math.round(telemetry.age) : "-";
  byId("links").replaceChildren(...told.links.map(pill));
  byId("take").disabled = told.driver !== null;
  byId("leave").disabled = !driving();
  byId("agree").disabled = !driving() || !telemetry?.standing || told.why !== "";
  byId("input").textContent = gamepad === null ? "" : "The gamepad drives.";
  const silent = told.telemetry_age !== null && told.telemetry_age > 1 ? `The vehicle says nothing for ${told.telemetry_age.toFixed(0)} s. ` : "";
  const stands = telemetry?.standing ? `The vehicle stands: ${telemetry.reason}. ` : "";
  const faults = (telemetry?.vehicle.faults ?? []).map((one) => `${one}. `).join("");
  const left = told.driver === null && told.left ? `${told.left}. ` : "";
  strip("standing", silent + stands + faults + left + (told.why ? `Nobody may drive: ${told.why}.` : "") || null);
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
  const status = byId("status");
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
    status.textContent = "live";
    status.dataset.state = "live";
  };
  socket.onmessage = (event) => (typeof event.data === "string" ? tell(JSON.parse(event.data)) : picture(event.data));
  await new Promise((done) => (socket.onclose = done));
  throw new Error("the station isn't reached");
}

(async () => {
  if (!("VideoDecoder" in window)) return strip("fault", "This browser decodes no video here: it needs WebCodecs, and a page from localhost or by https.");
  setInterval(turn, TURNS);
  setInterval(() => {
    const pads = [...(navigator.getGamepads?.() ?? [])].filter((one) => one?.connected);
    if (driving() && gamepad === null) gamepad = pads.find((one) => one.buttons.some((button) => button.pressed))?.index ?? null;
    const ages = [...cameras.values()].map((one) => one.tell()).filter((one) => one !== undefined);
    byId("age").textContent = ages.length ? Math.max(...ages) : "-";
    byId("age").className = Math.max(...ages) > OLD ? "bad" : "";
  }, 50);
  for (;;) {
    try {
      await watch();
    } catch (error) {
      byId("status").textContent = error.message;
      byId("status").dataset.state = "lost";
    }
    await new Promise((done) => setTimeout(done, 1000));
  }
})();
