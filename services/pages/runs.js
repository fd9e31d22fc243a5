// Runs on the dashboard of the event bus, from the state in /api/live (services/monitoring/dashboard/state.py).
"use strict";

const details = new Map(); // by run: details, which the service sends only when they have changed
const unfolded = new Map(); // by run: whether its tasks are unfolded, if the user chose

function duration(seconds) {
  if (seconds === null || seconds === undefined) return "";
  if (seconds < 60) return `${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s`;
  const minutes = Math.floor(seconds / 60),
    two = (n) => String(n).padStart(2, "0");
  return minutes < 60
    ? `${minutes}:${two(Math.floor(seconds % 60))} min`
    : `${Math.floor(minutes / 60)}:${two(minutes % 60)} h`;
}

// Time of day for a time of today, date and time for others.
function moment(seconds) {
  const at = new Date(1000 * seconds),
    time = at.toLocaleTimeString([], { hour12: false });
  return at.toDateString() === new Date().toDateString() ? time : `${at.toLocaleDateString()} ${time}`;
}

function progressBar(fraction, label) {
  const made = element("progress");
  made.max = 1;
  made.value = fraction;
  made.setAttribute("aria-label", label);
  return made;
}

function showRuns(runs, now) {
  for (const run of runs) if (run.details) details.set(run.run, run.details);
  for (const name of details.keys()) if (!runs.some(({ run }) => run === name)) details.delete(name);
  byId("runs").hidden = !runs.length;
  const place = byId("runs").querySelector("div");
  const before = new Map([...place.children].map((one) => [one.dataset.run, one]));
  const shown = runs.map((run) => {
    const known = before.get(run.run) ?? card(run.run);
    fillCard(known, run, now);
    return known;
  });
  if (shown.some((one, i) => place.children[i] !== one) || place.children.length !== shown.length)
    place.replaceChildren(...shown);
}

function card(name) {
  const made = element("details", undefined, "run"),
    summary = element("summary");
  made.dataset.run = name;
  summary.addEventListener("click", () => unfolded.set(name, !made.open));
  made.append(summary, element("p", undefined, "failure"), element("div", undefined, "scroll"), element("p", undefined, "soft"));
  return made;
}

function fillCard(made, { run, silent, version, came }, now) {
  const { last, steps, known, others } = details.get(run),
    [summary, failure, scroll, rest] = made.children;
  const state = silent ? "silent" : (last?.state ?? "running");
  const label = silent ? `silent for ${duration(now - came)}` : state;
  made.open = unfolded.get(run) ?? (state === "running" || state === "failed");
  const fingerprint = `${version} ${label}`;
  if (made.dataset.shown === fingerprint) return; // don't replace elements that may be selected or about to be clicked
  made.dataset.shown = fingerprint;
  const done = steps.filter((step) => step.state === "done").length + (others.done ?? 0) + (others.cached ?? 0);
  const finished = last ? last.done + last.cached : done,
    all = last ? last.steps : known;
  const pill = element("output", label, "pill");
  pill.dataset.state = state;
  summary.replaceChildren(
    pill,
    element("b", last ? `${last.command} ${last.source}` : "unknown run"),
    ...(all ? [progressBar(finished / all, "Tasks done")] : []),
    element("span", !all ? "" : `${finished} of ${all} tasks${last?.cached ? `, ${last.cached} cached` : ""}`, "soft"),
    element("span", last?.failed ? `${last.failed} failed` : "", "bad"),
    element("span", last ? `${duration(last.seconds)} on ${last.host}` : "", "soft"),
  );
  failure.textContent = last?.message ?? "";
  failure.hidden = !failure.textContent;
  scroll.replaceChildren(table(steps, state));
  scroll.hidden = !steps.length;
  const counted = ["failed", "done", "cached", "waiting"]
    .filter((one) => others[one])
    .map((one) => `${others[one]} ${one}`);
  rest.textContent = counted.length ? `${steps.length ? "and " : ""}${counted.join(", ")}` : "";
  rest.hidden = !rest.textContent;
}

function table(steps, state) {
  const made = element("table"),
    head = element("tr");
  for (const [name, kind] of [["task"], ["state"], ["progress"], ["time", "n"], ["peak memory", "n"], ["machine"], [""]])
    head.append(element("th", name, kind));
  made.createTHead().append(head);
  made.createTBody().append(
    ...steps.map((step) => {
      const row = element("tr", undefined, step.state === "failed" ? "failed" : ""),
        name = element("td"),
        progress = element("td"),
        interrupted = step.state === "running" && state !== "running"; // its run ended, or fell silent
      name.append(element("span", step.tile ? `${step.tile}/${step.step}` : step.step));
      if (step.state === "running") progress.append(progressBar(step.progress, `Progress of ${step.step}`));
      row.append(
        name,
        element("td", interrupted ? "not finished" : step.state, step.state === "failed" ? "bad" : ""),
        progress,
        element("td", duration(step.seconds), "n"),
        element("td", step.memory === null ? "" : UNITS.bytes(step.memory), "n"),
        element("td", step.host ?? ""),
        element("td", step.message, "message"),
      );
      return row;
    }),
  );
  return made;
}
