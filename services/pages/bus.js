// Dashboard of the event bus: plots, nodes, queues and warnings from /api/live and /api/history.
"use strict";

const PLOTS = [
  { key: "bandwidth", title: "Bandwidth", unit: "rate" },
  { key: "latency", title: "Latency", unit: "seconds" },
  { key: "sums", title: "Total bandwidth", unit: "rate", legend: true },
  { key: "lost", title: "Lost messages", unit: "count" },
  { key: "messages", title: "Messages", unit: "count" },
  { key: "size", title: "Mean message size", unit: "bytes" },
];
const TITLES = {
  node: { bandwidth: "Bandwidth by node", lost: "Lost messages per period", messages: "Messages per period" },
  topic: { bandwidth: "Bandwidth by topic", lost: "Lost messages per second", messages: "Messages per second" },
};
const METRICS = ["bandwidth", "latency", "lost", "messages", "size"],
  KINDS = ["mean", "min", "max"];
const SUMS = [
  ["in", 0],
  ["out", 1],
  ["difference", 3],
];

let by = "node"; // or "topic": what a line of the plots stands for
const selected = { node: new Set(), topic: new Set() }; // names of the selected nodes and topics; empty: all
let range = { seconds: 300 }; // or {from, to}
let shownWindow = null; // time window that is displayed, as /api/history returns it
let plots = null;
let stopped = new AbortController();

// ---- windows

// Replaces the latest buckets of a window by those of an update and drops the buckets before `begin`.
function merged(old, fresh, begin) {
  if (!old || old.step !== fresh.step) return fresh;
  const middle = begin + old.step / 2 - 1e-6,
    first = old.times.findIndex((time) => time >= middle);
  const after = old.times.findIndex((time) => time >= fresh.times[0] - 1e-6);
  const past = after < 0 ? old.times.length : after,
    kept = first < 0 ? 0 : Math.max(0, past - first);
  if (!kept) return fresh;
  const join = (a, b) => [
    ...(a ? a.slice(first, past) : Array(kept).fill(null)),
    ...(b ?? Array(fresh.times.length).fill(null)),
  ];
  const before = new Map(old.nodes.map((node) => [node.name, node])),
    now = new Map(fresh.nodes.map((node) => [node.name, node]));
  const nodes = [...new Map([...before, ...now]).values()].map(({ name, number }) => {
    const node = { name, number };
    for (const metric of METRICS) {
      const a = before.get(name)?.[metric],
        b = now.get(name)?.[metric],
        kinds = a?.min || b?.min ? KINDS : ["mean"];
      node[metric] = Object.fromEntries(kinds.map((kind) => [kind, join(a?.[kind] ?? a?.mean, b?.[kind] ?? b?.mean)]));
    }
    return node;
  });
  const sums = Object.fromEntries(SUMS.map(([name]) => [name, join(old.sums[name], fresh.sums[name])]));
  return { ...fresh, times: join(old.times, fresh.times), nodes, sums };
}

function draw(from, to) {
  for (const plot of plots) {
    const series =
      plot.key === "sums"
        ? SUMS.map(([name, number]) => ({ name, number, mean: shownWindow.sums[name] }))
        : shownWindow.nodes.map(({ name, number, ...metrics }) => ({ name, number, ...metrics[plot.key] }));
    plot.plot.show(shownWindow.times, series, [from, to]);
  }
}

function applyUpdate(update) {
  update.nodes ??= update.topics; // lines of the plots
  showState(update.state);
  plots ??= PLOTS.map((one) => ({ ...one, plot: new Plot(byId("plots"), { ...one, ranged: showPast }) }));
  for (const { key, title, plot } of plots)
    plot.describe(TITLES[by][key] ?? title, by === "node" ? update.state.limits[key] : undefined);
  if (range.seconds) {
    shownWindow = merged(shownWindow, update, update.begin);
    draw(update.state.now - range.seconds, update.state.now);
  } else {
    shownWindow = update;
    draw(range.from, range.to);
  }
}

// ---- tables and messages

function showState(state) {
  const { topic, servers, connected, limits, nodes, runs, counts, last_rejected, events_topic, events_rejected } = state;
  byId("topic").textContent = `${topic} and ${events_topic} on ${servers}`;
  nodes.sort((a, b) => a.name.localeCompare(b.name, undefined, { numeric: true })); // node_2 before node_10
  const gone = nodes.filter((node) => node.gone);
  showAlarms(state.alarms, events_topic, gone.length > 0);
  showRuns(runs, state.now);
  showQueues(state.queues);
  if (range.seconds) status(connected ? "live" : "lost", connected ? "live" : "Kafka is unreachable");
  const empty = byId("empty");
  empty.hidden = nodes.length > 0 || runs.length > 0;
  byId("plots").hidden = !nodes.length && runs.length > 0;
  empty.textContent = connected
    ? `No records on topic ${topic} yet.`
    : `Kafka at ${servers} doesn't answer; retrying.`;
  showChips(by === "node" ? nodes : state.topics.map(({ topic, number }) => ({ name: topic, number, gone: false })));
  byId("nodes").tBodies[0].replaceChildren(...nodes.filter((node) => !node.gone).map((node) => row(node, limits)));
  showGone(gone, limits);
  showTopics(state.topics);
  const warnings = nodes.flatMap((node) => [
    ...node.warnings.map((text) => `${node.name}: ${text}`),
    ...(node.dropped ? [`${node.name}: ${node.dropped} records were dropped because the outbox was full`] : []),
  ]);
  byId("warnings").replaceChildren(
    ...(warnings.length ? [...new Set(warnings)] : ["none"]).map((text) => element("li", text)),
  );
  const { shown, ...rejected } = counts;
  byId("counts").textContent =
    `${shown ?? 0} records shown` +
    (Object.keys(rejected).length ? `; rejected: ${listed(rejected)} (last: ${last_rejected})` : "") +
    (Object.keys(events_rejected.counts).length
      ? `; rejected events: ${listed(events_rejected.counts)} (last: ${events_rejected.last})`
      : "");
}

function listed(counts) {
  return Object.entries(counts)
    .map(([reason, count]) => `${count} ${reason}`)
    .join(", ");
}

// Nodes that are silent, folded away, with their last values, and a button that retires each.
function showGone(gone, limits) {
  const folded = byId("gone"),
    table = folded.querySelector("table"),
    shown = JSON.stringify([gone.map(({ silent, ...node }) => node), limits, alarmUser(), document.documentElement.dataset.theme]);
  folded.hidden = !gone.length;
  folded.querySelector("summary").textContent = `${gone.length} gone`;
  if (!table.tHead) {
    table.prepend(byId("nodes").tHead.cloneNode(true));
    table.tHead.rows[0].append(element("th"));
  }
  if (table.dataset.shown !== shown) {
    table.dataset.shown = shown;
    const rows = gone.map((node) => {
      const made = row(node, limits),
        cell = element("td");
      cell.append(retireButton(node.name));
      made.append(cell);
      return made;
    });
    table.tBodies[0].replaceChildren(...rows);
    return;
  }
  const { rows } = table.tBodies[0]; // don't replace buttons that may be about to be clicked
  gone.forEach((node, index) => (rows[index].cells[1].textContent = stateOf(node)));
}

const stateOf = (node) => (node.gone ? `gone, silent for ${duration(node.silent)}` : `every ${+node.period.toPrecision(3)} s`);

// Buttons that select nodes or topics; nodes that are silent are folded away.
function showChips(lines) {
  const chips = byId("chips"),
    chosen = selected[by],
    unlisted = [...chosen].filter((name) => !lines.some((line) => line.name === name));
  if (by === "node" && lines.length && unlisted.length) {
    // retired nodes have no button that deselects them
    for (const name of unlisted) chosen.delete(name);
    return begin();
  }
  const open = chips.querySelector("details")?.open,
    gone = lines.filter((one) => one.gone),
    shown = JSON.stringify([
      by,
      lines.map(({ name, number, gone }) => [name, number, gone]),
      [...chosen],
      document.documentElement.dataset.theme,
    ]);
  if (chips.dataset.shown === shown) return; // don't replace elements that may be about to be clicked
  chips.dataset.shown = shown;
  chips.classList.toggle("some", chosen.size > 0);
  chips.replaceChildren(...lines.filter((one) => !one.gone).map(chip));
  if (!gone.length) return;
  const folded = element("details"),
    inside = element("div", undefined, "choice");
  inside.append(...gone.map(chip));
  folded.append(element("summary", `${gone.length} gone`, "soft"), inside);
  folded.open = open ?? gone.some((one) => chosen.has(one.name));
  chips.append(folded);
}

function chip({ name, number, gone }) {
  const chosen = selected[by],
    made = element("button", undefined, gone ? "gone" : "");
  made.type = "button";
  made.title = chosen.has(name) ? `${name}: deselect` : `${name}: show only selected ${by}s`;
  made.setAttribute("aria-pressed", chosen.has(name));
  made.append(key(number), element("span", name));
  made.addEventListener("click", () => {
    if (!chosen.delete(name)) chosen.add(name);
    begin();
  });
  return made;
}

function row(node, limits) {
  const made = element("tr"),
    name = element("td");
  name.append(key(node.number), element("span", node.name));
  made.append(
    name,
    element("td", stateOf(node), node.gone ? "bad" : ""),
  );
  const machine = element("td");
  machine.append(element("span", [node.host, node.ip].filter(Boolean).join(" · ")));
  made.append(machine);
  for (const [metric, unit] of [
    ["bandwidth", "rate"],
    ["latency", "seconds"],
    ["lost", "count"],
    ["messages", "count"],
    ["size", "bytes"],
  ]) {
    const value = node.latest[metric];
    made.append(
      element(
        "td",
        value === null ? "–" : UNITS[unit](value),
        value !== null && value > limits[metric] ? "n bad" : "n",
      ),
    );
  }
  made.append(
    element("td", node.topics, "n"),
    element("td", node.cpu === null ? "–" : `${Math.round(node.cpu)} %`, "n"),
    element("td", node.dropped, node.dropped ? "n bad" : "n"),
  );
  return made;
}

function showQueues(queues) {
  const rows = queues.map((one) => {
    const made = element("tr"),
      name = element("td");
    name.append(element("span", one.queue));
    made.append(
      name,
      element("td", one.silent ? "silent" : "live", one.silent ? "bad" : ""),
      element("td", perSecond(one.arrived), "n"),
      element("td", perSecond(one.done), "n"),
      element("td", perSecond(one.rejected), one.rejected ? "n bad" : "n"),
      element("td", one.waiting, "n"),
      element("td", one.done ? UNITS.seconds(one.oldest_done) : "–", "n"),
      element("td", one.workers, "n"),
    );
    return made;
  });
  byId("queues").querySelector("tbody").replaceChildren(...rows);
  byId("queues").hidden = !rows.length;
}

function status(state, text) {
  byId("status").dataset.state = state;
  byId("status").textContent = text;
}

// ---- requests

function query(values) {
  return new URLSearchParams([...Object.entries({ ...values, by }), ...[...selected[by]].map((name) => [`${by}s`, name])]);
}

async function begin() {
  stopped.abort();
  const { signal } = (stopped = new AbortController());
  shownWindow = null;
  for (let pause = 500; !signal.aborted;) {
    try {
      if (!range.seconds) {
        applyUpdate(await (await request(`/api/history?${query(range)}`, signal)).json());
        status("past", "past");
        return;
      }
      await followEvents(`/api/live?${query(range)}`, signal, (update) => {
        pause = 500;
        if (!signal.aborted) applyUpdate(update);
      });
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof NoToken) return askForToken();
      status("lost", range.seconds ? "the service doesn't answer" : error.message);
      if (!range.seconds) return;
      shownWindow = null;
      await new Promise((done) => setTimeout(done, (pause = Math.min(5000, 2 * pause))));
    }
  }
}

function askForToken() {
  byId("token").hidden = false;
  status("lost", tokenFault());
}

function showLive(seconds) {
  range = { seconds };
  press();
  begin();
}

function showPast(from, to) {
  range = { from, to };
  fill(from, to);
  press();
  begin();
}

// Writes a range in seconds into the form, as local times.
function fill(from, to) {
  const local = (time) => new Date(time - 60000 * new Date(time).getTimezoneOffset()).toISOString().slice(0, 19);
  for (const [name, seconds] of [
    ["from", from],
    ["to", to],
  ])
    byId("range").elements[name].value = local(1000 * seconds);
}

function showBy(kind) {
  by = kind;
  press();
  begin();
}

function press() {
  for (const button of document.querySelectorAll("[data-seconds]"))
    button.setAttribute("aria-pressed", Number(button.dataset.seconds) === range.seconds);
  for (const button of document.querySelectorAll("[data-by]")) button.setAttribute("aria-pressed", button.dataset.by === by);
}

for (const button of document.querySelectorAll("[data-seconds]"))
  button.addEventListener("click", () => showLive(Number(button.dataset.seconds)));
for (const button of document.querySelectorAll("[data-by]"))
  button.addEventListener("click", () => showBy(button.dataset.by));
byId("range").addEventListener("submit", (event) => {
  event.preventDefault();
  const at = (name) => new Date(event.target.elements[name].value).getTime() / 1000;
  showPast(at("from"), at("to"));
});
byId("token").addEventListener("submit", (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", event.target.elements.token.value.trim());
  event.target.hidden = true;
  begin();
});
fill(Date.now() / 1000 - range.seconds, Date.now() / 1000);
begin();
