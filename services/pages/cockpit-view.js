// Worker of the driver page: connection to the station, video, and the watchdog of all that is displayed. It draws into
// canvases by itself, so that a hanging page neither freezes a picture unnoticed nor delays one.
//
// From the page: {open}, {send}, {canvas, camera}, {remove}, {notice}, {overlay}, {alive}. To the page: {opened},
// {closed}, {message}, {camera}, {status}.
"use strict";

importScripts("/pages/ages.js", "/pages/overlay.js");

const WATCHDOG_PERIOD = 10, // interval of the watchdog, ms
  STATUS_PERIOD = 40, // interval of reports to the page, ms
  COVER_PERIOD = 90, // interval at which a cover's age is redrawn, ms
  NOTICE_PERIOD = 1000, // interval at which the notice of a hanging page is redrawn while the page runs, ms
  CLOCK_PERIOD = 200; // interval of clock synchronization, ms
const HEADER_BYTES = 14; // length of a frame's header
const DECODE_QUEUE_MAX = 8; // frames that may wait for decoding; a page that falls behind continues at the next key frame

const cameras = new Map();
let socket = null,
  clock = new Clock(),
  pageAlive = now(), // when the page's own thread was last alive
  overlay = {}, // what is drawn into the first camera's picture, see overlay.js
  notice = null, // canvas that the browser shows when the page's own thread hangs
  noticed = 0;

function send(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(typeof message === "string" ? message : JSON.stringify(message));
}

class Camera {
  constructor(number) {
    this.number = number;
    this.captured = -Infinity; // of the newest decoded frame
    this.shown = 0;
    this.covered = -Infinity; // when the cover was last drawn
    this.coveredAt = null; // when the picture was covered; null: it is shown
    this.begin();
    postMessage({ camera: number });
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
    this.captured = clock.toPage(frame.timestamp / 1000);
    this.shown += 1;
    const { canvas } = this;
    if (canvas && !this.outdated) {
      if (canvas.width !== frame.displayWidth || canvas.height !== frame.displayHeight) {
        canvas.width = frame.displayWidth;
        canvas.height = frame.displayHeight;
      }
      const context = canvas.getContext("2d");
      context.drawImage(frame, 0, 0);
      drawOverlay(context, this.number === Math.min(...cameras.keys()) ? overlay : null, age(this.captured));
      this.covered = -Infinity;
      this.coveredAt = null;
    }
    frame.close();
    report();
  }

  get outdated() {
    return age(this.captured) > MAX_AGE;
  }

  cover() {
    if (!this.canvas || !this.outdated || age(this.covered) < COVER_PERIOD) return;
    drawCover(this.canvas, `no picture${sinceText(this.captured)}`);
    this.covered = now();
    this.coveredAt ??= this.covered;
  }
}

function camera(number) {
  if (!cameras.has(number)) cameras.set(number, new Camera(number));
  return cameras.get(number);
}

function receiveFrame(buffer) {
  const view = new DataView(buffer);
  camera(view.getUint8(0)).decode(view.getUint8(1) === 1, view.getFloat64(6, true), buffer.slice(HEADER_BYTES));
}

function receive(message) {
  if (message.clock !== undefined) return clock.addAnswer(message.clock, message.now_ms);
  if (message.fault !== undefined) return postMessage({ message });
  if (clock.differences.length === 0) return; // the time of this state is unknown
  const sent = clock.toPage(message.now_ms),
    vehicle = message.telemetry_age_ms;
  for (const one of message.cameras ?? []) camera(one.camera);
  postMessage({ message, sent, vehicle: vehicle === null || vehicle === undefined ? -Infinity : sent - vehicle });
}

const synchronize = () => send({ do: "clock", sent: now() });

function open({ url, protocols }) {
  socket = new WebSocket(url, protocols);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    clock = new Clock();
    synchronize();
    for (const one of cameras.values()) one.started = false; // frames are missing: continue at a key frame
    postMessage({ opened: true });
  };
  socket.onmessage = (event) =>
    typeof event.data === "string" ? receive(JSON.parse(event.data)) : receiveFrame(event.data);
  socket.onclose = () => postMessage({ closed: true });
}

onmessage = ({ data }) => {
  if (data.alive !== undefined) pageAlive = data.alive;
  if (data.overlay) overlay = data.overlay;
  if (data.send) send(data.send);
  if (data.open) open(data.open);
  if (data.canvas) camera(data.camera).canvas = data.canvas;
  if (data.notice) notice = data.notice;
  if (data.remove) {
    for (const one of cameras.values()) if (one.decoder.state !== "closed") one.decoder.close();
    cameras.clear();
  }
};

setInterval(() => {
  for (const one of cameras.values()) one.cover();
  const hangs = age(pageAlive) > MAX_AGE;
  if (notice && age(noticed) > (hangs ? COVER_PERIOD : NOTICE_PERIOD)) {
    drawCover(notice, `no picture: this page does not respond${hangs ? sinceText(pageAlive) : ""}`);
    noticed = now();
  }
}, WATCHDOG_PERIOD);
setInterval(synchronize, CLOCK_PERIOD);
function report() {
  const status = [...cameras.values()].map(({ number, captured, shown, coveredAt }) => ({ number, captured, shown, coveredAt }));
  postMessage({ status, at: now() });
}

setInterval(report, STATUS_PERIOD);
