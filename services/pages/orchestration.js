// The page of services in OSM: asks how things stand every two seconds, and sends what its buttons are for.
"use strict";

const EVERY = 2000;

function tell(fault) {
  byId("fault").hidden = !fault;
  byId("fault").textContent = fault ?? "";
}

async function act(service, what, body) {
  try {
    tell(null);
    await send("POST", `/api/services/${encodeURIComponent(service)}/${what}`, body && JSON.stringify(body));
  } catch (error) {
    tell(error.message);
  }
  await look();
}

function pill(name, state) {
  const made = element("span", `${name} ${state.toLowerCase().replaceAll("_", " ")}`, "pill");
  made.dataset.state = { READY: "done", BROKEN: "failed", BUILDING: "running" }[state] ?? "waiting";
  return made;
}

function card(service) {
  const busy = service.doing !== "",
    made = element("article", undefined, "run"),
    line = element("div", undefined, "bar"),
    buttons = element("div", undefined, "choice");
  const packages = service.missing.length ? `lacks ${service.missing.join(", ")}` : service.onboarded ? "in OSM" : "not in OSM";
  const start = () => {
    const name = prompt("Name of the instance (a-z, 0-9, -)", service.id.slice(0, 41).replace(/-+$/, ""));
    if (name) act(service.id, "instantiate", { name });
  };
  const remove = () => {
    if (confirm(`Remove ${service.id}, its instances and its packages from OSM?`)) act(service.id, "delete");
  };
  buttons.append(
    button("Onboard", busy || service.onboarded || service.missing.length > 0, () => act(service.id, "onboard")),
    button("Instantiate", busy || !service.onboarded, start),
    button("Delete", busy || !(service.onboarded || service.instances.length), remove),
  );
  line.append(
    element("b", service.title || service.id),
    element("span", service.id, "soft"),
    element("span", packages, "soft"),
    ...service.instances.map(([name, state]) => pill(name, state)),
    buttons,
  );
  made.append(line);
  if (busy) made.append(element("p", `${service.doing} ...`, "soft"));
  else if (service.failed) made.append(element("p", service.failed, "failure"));
  return made;
}

let shown = "";

async function look() {
  const status = byId("status");
  try {
    const told = await (await ask("/api/services", AbortSignal.timeout(15000))).json();
    byId("osm").textContent = told.osm;
    byId("empty").hidden = told.services.length > 0;
    const text = JSON.stringify(told.services);
    if (text !== shown) byId("services").replaceChildren(...told.services.map(card)); // keeps focus where nothing changed
    shown = text;
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

byId("upload").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    tell(null);
    for (const file of event.target.elements.files.files) await send("PUT", "/api/packages", file, "application/gzip");
    event.target.reset();
  } catch (error) {
    tell(error.message);
  }
  look();
});

(async () => {
  for (;;) {
    if (!document.hidden) await look();
    await new Promise((done) => setTimeout(done, EVERY));
  }
})();
