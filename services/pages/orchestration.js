// Page of the services in OSM: shows their state, refreshed every two seconds, and onboards, instantiates and deletes them.
"use strict";

const REFRESH_PERIOD = 2000; // ms

function showError(error) {
  byId("fault").hidden = !error;
  byId("fault").textContent = error ?? "";
}

async function act(service, action, body) {
  try {
    showError(null);
    await send("POST", `/api/services/${encodeURIComponent(service)}/${action}`, body && JSON.stringify(body));
  } catch (error) {
    showError(error.message);
  }
  await refresh();
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
  const packages = service.missing.length ? `missing: ${service.missing.join(", ")}` : service.onboarded ? "in OSM" : "not in OSM";
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

async function refresh() {
  const status = byId("status");
  try {
    const state = await (await request("/api/services", AbortSignal.timeout(15000))).json();
    byId("osm").textContent = state.osm;
    byId("empty").hidden = state.services.length > 0;
    const text = JSON.stringify(state.services);
    if (text !== shown) byId("services").replaceChildren(...state.services.map(card)); // keeps focus if nothing changed
    shown = text;
    byId("token").hidden = true;
    status.textContent = "live";
    status.dataset.state = "live";
  } catch (error) {
    byId("token").hidden = !(error instanceof NoToken);
    status.textContent = error instanceof NoToken ? tokenFault() : error.message;
    status.dataset.state = "lost";
  }
}

byId("token").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", event.target.elements.token.value.trim());
  refresh();
});

byId("upload").addEventListener("submit", async (event) => {
  event.preventDefault();
  try {
    showError(null);
    for (const file of event.target.elements.files.files) await send("PUT", "/api/packages", file, "application/gzip");
    event.target.reset();
  } catch (error) {
    showError(error.message);
  }
  refresh();
});

(async () => {
  for (;;) {
    if (!document.hidden) await refresh();
    await new Promise((done) => setTimeout(done, REFRESH_PERIOD));
  }
})();
