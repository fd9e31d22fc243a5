// Map of the driver page: lines of the world's roads around the vehicle, whose direction is up.
"use strict";

const MAP_LENGTH = 120, // what the map shows from bottom to top, m
  MAP_BEHIND = 0.3, // share of it that is behind the vehicle
  MAP_SCALE_BAR = 20, // m
  MAP_LINES = { path: ["#46515f", 9], marking: ["#8d97a5", 1.5], edge: ["#d7dde5", 3] }; // colour and width (pixels), the lowest first

let mapLines = null, // lines of the map, {kind, points, low, high}; null: not loaded yet
  mapDrawn; // what is drawn: place of the vehicle as text

// Pixel of a point of the world; without a heading of the vehicle, the world's y axis is up.
function mapPixel([x, y], { position, heading }, width, height) {
  const angle = heading ?? Math.PI / 2,
    [dx, dy] = [x - position[0], y - position[1]],
    ahead = dx * Math.cos(angle) + dy * Math.sin(angle),
    left = dy * Math.cos(angle) - dx * Math.sin(angle),
    scale = height / MAP_LENGTH;
  return [width / 2 - left * scale, height * (1 - MAP_BEHIND) - ahead * scale];
}

// A line with the corners of its bounding box.
function bounded({ kind, points }) {
  const [xs, ys] = [0, 1].map((axis) => points.map((point) => point[axis]));
  return { kind, points, low: [Math.min(...xs), Math.min(...ys)], high: [Math.max(...xs), Math.max(...ys)] };
}

const isNear = ({ low, high }, { position }) =>
  [0, 1].every((axis) => low[axis] < position[axis] + MAP_LENGTH && high[axis] > position[axis] - MAP_LENGTH);

// Draws the lines near the vehicle, and the vehicle; `place`: its position and heading, null: unknown.
function drawMap(canvas, lines, place) {
  if (place === null) return drawCover(canvas, "no position");
  const context = canvas.getContext("2d"),
    { width, height } = canvas,
    near = lines.filter((line) => isNear(line, place));
  context.fillStyle = "#10151c";
  context.fillRect(0, 0, width, height);
  context.lineJoin = context.lineCap = "round";
  for (const [kind, [colour, thickness]] of Object.entries(MAP_LINES)) {
    context.strokeStyle = colour;
    context.lineWidth = thickness;
    context.beginPath();
    for (const line of near.filter((one) => one.kind === kind))
      line.points.forEach((point, index) => context[index ? "lineTo" : "moveTo"](...mapPixel(point, place, width, height)));
    context.stroke();
  }
  drawMapVehicle(context, place.heading !== null, width / 2, height * (1 - MAP_BEHIND), height / 28);
  const bar = (MAP_SCALE_BAR * height) / MAP_LENGTH;
  context.fillStyle = "#fff";
  context.fillRect(width * 0.04, height * 0.96, bar, 3);
  drawLabel(context, `${MAP_SCALE_BAR} m`, width * 0.04 + bar / 2, height * 0.94, height / 22, "center");
}

// An arrow ahead, or a dot for a vehicle without a heading.
function drawMapVehicle(context, hasHeading, x, y, size) {
  context.fillStyle = "#ffb74d";
  context.beginPath();
  if (hasHeading) {
    context.moveTo(x, y - size);
    context.lineTo(x + size * 0.7, y + size);
    context.lineTo(x, y + size * 0.5);
    context.lineTo(x - size * 0.7, y + size);
  } else context.arc(x, y, size * 0.6, 0, 2 * Math.PI);
  context.fill();
}

// Loads the map once; driving doesn't depend on it, so that a failure only means that the next connection tries again.
async function loadMap() {
  if (mapLines !== null) return;
  try {
    const { lines } = await (await request("/api/map", AbortSignal.timeout(20000))).json();
    mapLines = lines.map(bounded);
    byId("map").hidden = !lines.length;
  } catch {
    mapLines = null;
  }
}

// Draws the map again if the vehicle has moved, or if its place is no longer known; `vehicle`: undefined if outdated.
function showMap(vehicle) {
  if (!mapLines?.length) return;
  const place = vehicle?.position ? { position: vehicle.position, heading: vehicle.heading } : null,
    text = JSON.stringify(place);
  if (text === mapDrawn) return;
  mapDrawn = text;
  byId("map").dataset.place = text;
  drawMap(byId("map"), mapLines, place);
}
