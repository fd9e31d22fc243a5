// Fleet management: who is there, on which links; joins, hands over, takes back and releases.
"use strict";

const EVERY = 1000;

function tell(fault) {
  byId("fault").hidden = !fault;
  byId("fault").textContent = fault ?? "";
}

async function act(vehicle, what, body) {
  try {
    tell(null);
    await send("POST", `/api/vehicles/${encodeURIComponent(vehicle)}/${what}`, body && JSON.stringify(body));
  } catch (error) {
    tell(error.message);
  }
  await look();
}

function pill(text, good) {
  const made = element("span", text, "pill");
  made.dataset.state = good ? "running" : "failed";
  return made;
}

function linked(link) {
  const trip = link.round_trip === null ? "" : ` ${Math.round(link.round_trip)} ms`;
  const loss = link.loss ? ` ${(100 * link.loss).toFixed(1)} % lost` : "";
  return pill(`${link.name}${link.up ? `${trip}${loss} ${link.rate.toFixed(1)} Mbit/s` : " down"}`, link.up);
}

const time = (seconds) => new Date(1000 * seconds).toLocaleTimeString();

function card(one, doing) {
  const made = element("article", undefined, "run"),
    line = element("div", undefined, "bar");
  const speed = one.speed === null ? "" : `${(3.6 * one.speed).toFixed(1)} km/h`;
  const old = one.age === null ? "" : `${Math.round(one.age)} ms`;
  line.append(
    element("b", one.name),
    pill(one.there ? "there" : `gone since ${time(one.since)}`, one.there),
    element("span", one.address, "soft"),
    element("span", doing, "soft"),
    element("span", [speed, old].filter(Boolean).join(", ")),
    ...one.links.map(linked),
  );
  made.append(line);
  if (one.told) made.append(element("p", one.told, "failure"));
  return [made, line];
}

function vehicle(one, stations) {
  const [made, line] = card(one, one.other ? `driven from ${one.other}` : "nobody drives it");
  const choice = element("span", undefined, "choice"),
    select = element("select");
  const free = stations.filter((station) => station.there && station.pair === null);
  select.ariaLabel = `station for ${one.name}`;
  select.append(...free.map((station) => element("option", station.name)));
  const chosen = () => ({ station: select.value });
  if (free.length && one.there) choice.append(select);
  if (one.pair === null) choice.append(button("Join", !free.length || !one.there, () => act(one.name, "join", chosen())));
  else {
    choice.append(button("Hand over", !free.length, () => act(one.name, "hand-over", chosen())));
    if (one.before) choice.append(button(`Back to ${one.before}`, false, () => act(one.name, "take-back")));
    choice.append(button("Release", false, () => act(one.name, "release")));
  }
  line.append(choice);
  return made;
}

const station = (one) => card(one, one.other ? `drives ${one.other}` : "drives nobody")[0];

function entry(one) {
  const made = element("tr");
  for (const text of [new Date(1000 * one.time).toLocaleString(), one.what, one.vehicle, one.station, one.by]) made.append(element("td", text));
  return made;
}

let shown = "";

async function look() {
  const status = byId("status");
  try {
    const told = await (await ask("/api/fleet", AbortSignal.timeout(5000))).json();
    const audit = await (await ask("/api/audit", AbortSignal.timeout(5000))).json();
    const text = JSON.stringify([told, audit]);
    if (text !== shown && document.activeElement?.tagName !== "SELECT") {
      byId("vehicles").replaceChildren(...told.vehicles.map((one) => vehicle(one, told.stations)));
      byId("stations").replaceChildren(...told.stations.map(station));
      byId("audit").replaceChildren(...audit.map(entry));
      byId("none").hidden = told.vehicles.length > 0;
      shown = text;
    }
    byId("token").hidden = true;
    status.textContent = "live";
    status.dataset.state = "live";
  } catch (error) {
    byId("token").hidden = !(error instanceof NoToken);
    status.textContent = error instanceof NoToken ? "needs a token" : error.message;
    status.dataset.state = "lost";
  }
}

byId("token").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", event.target.elements.token.value);
  look();
});

(async () => {
  for (;;) {
    if (!document.hidden) await look();
    await new Promise((done) => setTimeout(done, EVERY));
  }
})();
