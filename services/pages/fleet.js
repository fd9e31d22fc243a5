// Fleet page: vehicles, stations and their links; joins, hands over, takes back and releases vehicles.
"use strict";

const REFRESH_PERIOD = 1000, // ms
  SPEEDS_PERIOD = 100, // interval at which speeds are requested, ms
  WATCHDOG_PERIOD = 20; // interval at which speeds that are too old are removed, ms
let speeds = {}; // {speed, at} by vehicle: m/s, and when it was reported

function showError(error) {
  byId("fault").hidden = !error;
  byId("fault").textContent = error ?? "";
}

async function act(vehicle, action, body) {
  try {
    showError(null);
    await send("POST", `/api/vehicles/${encodeURIComponent(vehicle)}/${action}`, body && JSON.stringify(body));
  } catch (error) {
    showError(error.message);
  }
  await refresh();
}

function pill(text, good) {
  const made = element("span", text, "pill");
  made.dataset.state = good ? "running" : "failed";
  return made;
}

function linkPill(link) {
  const trip = link.round_trip === null ? "" : ` ${Math.round(link.round_trip)} ms`;
  const loss = link.loss ? ` ${(100 * link.loss).toFixed(1)} % lost` : "";
  return pill(`${link.name}${link.up ? `${trip}${loss} ${link.rate.toFixed(1)} Mbit/s` : " down"}`, link.up);
}

const time = (seconds) => new Date(1000 * seconds).toLocaleTimeString();

function card(one, pairText) {
  const made = element("article", undefined, "run"),
    line = element("div", undefined, "bar");
  const latency = one.age === null ? "" : `${Math.round(one.age)} ms`;
  line.append(
    element("b", one.name),
    pill(one.connected ? "connected" : `disconnected since ${time(one.since)}`, one.connected),
    element("span", one.address, "soft"),
    element("span", pairText, "soft"),
    element("span", latency),
    ...one.links.map(linkPill),
  );
  made.append(line);
  if (one.message) made.append(element("p", one.message, "failure"));
  return [made, line];
}

// Who has control, and since when; a station of an earlier version doesn't report it.
const driver = (one) => (one.driver ? ` by ${one.driver} since ${time(one.driver_since)}` : "");

function vehicle(one, stations, mayChange) {
  const [made, line] = card(one, one.other ? `driven from ${one.other}${driver(one)}` : "no station");
  const choice = element("span", undefined, "choice"),
    speed = element("output"),
    select = element("select");
  const free = stations.filter((station) => station.connected && station.pair === null);
  select.ariaLabel = `station for ${one.name}`;
  select.append(...free.map((station) => element("option", station.name)));
  const selected = () => ({ station: select.value });
  speed.dataset.vehicle = one.name;
  line.append(speed);
  if (!mayChange) return made;
  if (free.length && one.connected) choice.append(select);
  if (one.pair === null) choice.append(button("Join", !free.length || !one.connected, () => act(one.name, "join", selected())));
  else {
    choice.append(button("Hand over", !free.length, () => act(one.name, "hand-over", selected())));
    if (one.before) choice.append(button(`Back to ${one.before}`, false, () => act(one.name, "take-back")));
    choice.append(button("Release", false, () => act(one.name, "release")));
  }
  line.append(choice);
  return made;
}

const station = (one) => card(one, one.other ? `drives ${one.other}${driver(one)}` : "no vehicle")[0];

function auditRow(one) {
  const made = element("tr");
  for (const text of [new Date(1000 * one.time).toLocaleString(), one.what, one.vehicle, one.station, one.by]) made.append(element("td", text));
  return made;
}

async function refreshSpeeds() {
  const sent = now(),
    found = await (await request("/api/speeds", AbortSignal.timeout(5000))).json();
  speeds = Object.fromEntries(Object.entries(found).map(([name, one]) => [name, { speed: one.speed, at: sent - one.reported_ms }]));
}

// Writes speeds, and removes those that are too old, whatever the cause: ages are counted from the present.
function showSpeeds() {
  for (const output of document.querySelectorAll("[data-vehicle]")) {
    const found = speeds[output.dataset.vehicle],
      text = found && age(found.at) <= MAX_AGE ? `${(3.6 * found.speed).toFixed(1)} km/h` : "";
    if (output.textContent !== text) output.textContent = text;
  }
}
setInterval(showSpeeds, WATCHDOG_PERIOD);

let shown = "";

async function refresh() {
  const status = byId("status");
  try {
    const fleet = await (await request("/api/fleet", AbortSignal.timeout(5000))).json();
    const audit = await (await request("/api/audit", AbortSignal.timeout(5000))).json();
    const text = JSON.stringify([fleet, audit]);
    if (text !== shown && document.activeElement?.tagName !== "SELECT") {
      const mayChange = !fleet.you || fleet.you.role === "operator";
      byId("you").textContent = fleet.you ? `${fleet.you.name}, ${fleet.you.role}` : "";
      byId("vehicles").replaceChildren(...fleet.vehicles.map((one) => vehicle(one, fleet.stations, mayChange)));
      byId("stations").replaceChildren(...fleet.stations.map(station));
      byId("audit").replaceChildren(...audit.map(auditRow));
      byId("none").hidden = fleet.vehicles.length > 0;
      shown = text;
    }
    byId("token").hidden = true;
    status.textContent = "live";
    status.dataset.state = "live";
  } catch (error) {
    const rejected = error instanceof NoToken;
    byId("token").hidden = !rejected;
    if (rejected) {
      for (const part of ["you", "vehicles", "stations", "audit"]) byId(part).replaceChildren();
      shown = "";
    }
    status.textContent = rejected ? tokenFault() : error.message;
    status.dataset.state = "lost";
  }
}

byId("token").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", event.target.elements.token.value.trim());
  refresh();
});

async function repeat(action, period) {
  for (;;) {
    if (!document.hidden) await action();
    await new Promise((done) => setTimeout(done, period));
  }
}
repeat(refresh, REFRESH_PERIOD);
repeat(() => refreshSpeeds().catch(() => {}), SPEEDS_PERIOD); // failures are reported by `refresh`
