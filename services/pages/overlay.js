// What the driver page's worker draws: covers, and over the first camera's picture gauges and the predicted path.
//
// An overlay: {at, steering, throttle, brake, speed, gear, standing, history, path}. `at`: when the page sent it; `speed`
// in m/s, null: unknown; `history`: the latest steering as [time, value]; `path`: geometry of vehicle and camera (m,
// degrees), null: the path isn't drawn.
"use strict";

const FONT = "system-ui, sans-serif";
const PATH_SECONDS = 2.5, // the path shows where the vehicle will be until then
  PATH_MIN = 6, // and at least this far, m
  PATH_STEP = 0.25; // m
const PATH = { wheelbase: 2.5, angle: 34, width: 1.7, ahead: 1.2, height: 1.5, pitch: -8, field: 80 };

// A cover, which hides outdated video completely.
function drawCover(canvas, text) {
  const context = canvas.getContext("2d"),
    { width, height } = canvas;
  context.fillStyle = "#000";
  context.fillRect(0, 0, width, height);
  context.fillStyle = "#ff6b60";
  context.textAlign = "center";
  const size = Math.min(height / 6, width / 14);
  context.font = `650 ${size}px ${FONT}`;
  context.fillText(text, width / 2, height / 2 + size / 3, width * 0.96);
}

// A label on a dark ground; `x`: its right end, or its centre.
function drawLabel(context, text, x, y, size, align, colour = "#fff") {
  context.font = `600 ${size}px ${FONT}`;
  context.textAlign = align;
  const width = context.measureText(text).width + size * 0.7,
    left = align === "right" ? x - width : x - width / 2;
  context.fillStyle = "rgba(0, 0, 0, .6)";
  context.fillRect(left, y - size * 1.1, width, size * 1.45);
  context.fillStyle = colour;
  context.fillText(text, align === "right" ? x - size * 0.35 : x, y);
}

// Latency of a picture (ms) at its upper right corner; `overlay`: further content, null for all cameras but the first.
function drawOverlay(context, overlay, latency) {
  const { width, height } = context.canvas,
    unit = height / 24;
  drawLabel(context, `${Math.round(latency)} ms`, width - unit * 0.4, unit * 1.6, unit, "right", latency > MAX_AGE / 2 ? "#ffb74d" : "#fff");
  if (!overlay || !(age(overlay.at) <= MAX_AGE)) return;
  if (overlay.path && overlay.speed !== null) drawPath(context, overlay, latency);
  const speed = overlay.speed === null ? "-" : (3.6 * overlay.speed).toFixed(0);
  drawLabel(context, `${speed} km/h  ${overlay.standing ? "STOPPED" : overlay.gear}`, width / 2, height - unit * 0.6, unit * 1.2, "center", overlay.standing ? "#ff6b60" : "#fff");
  drawSteering(context, overlay.steering, unit * 2.6, height - unit * 2.6, unit * 2);
  drawPedal(context, overlay.throttle, width - unit * 1.6, height, unit, "#5cc58a");
  drawPedal(context, overlay.brake, width - unit * 3.2, height, unit, "#ff6b60");
}

// A steering wheel, turned as the driver turns it: by up to 135 degrees.
function drawSteering(context, steering, x, y, radius) {
  context.save();
  context.translate(x, y);
  context.rotate((-steering * 135 * Math.PI) / 180);
  for (const [colour, line] of [["rgba(0, 0, 0, .6)", radius * 0.34], ["#fff", radius * 0.14]]) {
    context.strokeStyle = colour;
    context.lineWidth = line;
    context.beginPath();
    context.arc(0, 0, radius, 0, 2 * Math.PI);
    context.moveTo(-radius, 0);
    context.lineTo(radius, 0);
    context.moveTo(0, 0);
    context.lineTo(0, radius);
    context.stroke();
  }
  context.fillStyle = "#ffb74d";
  context.fillRect(-radius * 0.12, -radius * 1.2, radius * 0.24, radius * 0.4); // top of the wheel
  context.restore();
}

function drawPedal(context, share, x, height, unit, colour) {
  const full = unit * 4.4;
  context.fillStyle = "rgba(0, 0, 0, .6)";
  context.fillRect(x - unit * 0.1, height - unit * 5, unit * 1.2, full + unit * 0.2);
  context.fillStyle = colour;
  context.fillRect(x, height - unit * 0.5 - full * share, unit, full * share);
}

// Positions (x ahead, y left, heading) of a vehicle from the picture on, every PATH_STEP metres: it moves by the steering
// that the driver had commanded while the picture was on its way (bicycle model), then by the present one.
function predictedPath({ speed, steering, history, path, at }, latency) {
  const poses = [],
    moving = Math.abs(speed) > 0.3,
    direction = speed < -0.3 ? -1 : 1,
    until = Math.max(Math.abs(speed) * (PATH_SECONDS + latency / 1000), PATH_MIN);
  let x = 0,
    y = 0,
    heading = 0;
  for (let distance = 0; distance <= until; distance += PATH_STEP) {
    poses.push([x, y, heading]);
    const time = at - latency + (moving ? (1000 * distance) / Math.abs(speed) : latency),
      commanded = history.findLast(([when]) => when <= time)?.[1] ?? history[0]?.[1] ?? steering,
      angle = ((time >= at ? steering : commanded) * path.angle * Math.PI) / 180,
      turn = (direction * PATH_STEP * Math.tan(angle)) / path.wheelbase;
    x += direction * PATH_STEP * Math.cos(heading + turn / 2);
    y += direction * PATH_STEP * Math.sin(heading + turn / 2);
    heading += turn;
  }
  return poses;
}

// Pixel of a point on the ground in the picture of a camera on the vehicle's centre line; null: behind the camera.
function project([x, y], path, width, height) {
  const pitch = (path.pitch * Math.PI) / 180,
    focal = width / 2 / Math.tan((path.field * Math.PI) / 360),
    [ahead, up] = [x - path.ahead, -path.height],
    depth = ahead * Math.cos(pitch) + up * Math.sin(pitch),
    above = -ahead * Math.sin(pitch) + up * Math.cos(pitch);
  return depth < 0.3 ? null : [width / 2 - (focal * y) / depth, height / 2 - (focal * above) / depth];
}

// The tracks of the vehicle's sides.
function drawPath(context, overlay, latency) {
  const { width, height } = context.canvas,
    poses = predictedPath(overlay, latency);
  for (const [colour, line] of [["rgba(0, 0, 0, .5)", height / 90], ["rgba(127, 208, 229, .95)", height / 180]])
    for (const side of [-1, 1]) {
      context.strokeStyle = colour;
      context.lineWidth = line;
      context.beginPath();
      let drawing = false;
      for (const [x, y, heading] of poses) {
        const offset = (side * overlay.path.width) / 2,
          pixel = project([x - offset * Math.sin(heading), y + offset * Math.cos(heading)], overlay.path, width, height);
        if (pixel) context[drawing ? "lineTo" : "moveTo"](...pixel);
        drawing = pixel !== null;
      }
      context.stroke();
    }
}
