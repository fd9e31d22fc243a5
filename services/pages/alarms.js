// Alarms on the dashboard of the event bus: the strip at the top, the table with buttons to acknowledge and mute them, and
// the button that retires a node.
"use strict";

const NAMED_ALARMS = 3; // alarms that are named in the strip at the top

function alarmState(one) {
  if (one.until !== undefined) return "cleared";
  const muted = one.muted_until > Date.now() / 1000 ? `, muted until ${moment(one.muted_until)}` : "";
  return (one.acknowledged_by ? `acknowledged by ${one.acknowledged_by}` : "raised") + muted;
}

// `gone`: whether there are nodes that can be retired.
function showAlarms({ raised, cleared }, events_topic, gone) {
  const strip = byId("alarm"),
    urgent = raised.filter((one) => !one.acknowledged_by && one.muted_until < Date.now() / 1000);
  strip.hidden = !urgent.length;
  const text = urgent.length
    ? `${urgent.length === 1 ? "Alarm" : `${urgent.length} alarms`}: ` +
      urgent
        .slice(0, NAMED_ALARMS)
        .map((one) => `${one.rule}, ${one.subject}, since ${moment(one.since)}`)
        .join("; ") +
      (urgent.length > NAMED_ALARMS ? `; and ${urgent.length - NAMED_ALARMS} more` : "")
    : "";
  if (strip.textContent !== text) strip.textContent = text; // so that a screen reader announces it once
  byId("handling").hidden = !raised.length && !gone;
  const shown = JSON.stringify([raised, cleared, alarmUser(), Math.floor(Date.now() / 10000)]); // mutings end by time
  const table = byId("alarms");
  if (table.dataset.shown === shown) return; // don't replace buttons that may be about to be clicked
  table.dataset.shown = shown;
  const rows = [...raised, ...cleared].map((one) => {
    const row = element("tr"),
      rule = element("td");
    rule.append(element("span", one.rule));
    row.append(
      rule,
      element("td", alarmState(one), one.until === undefined && !one.acknowledged_by ? "bad" : ""),
      element("td", one.subject),
      element("td", +one.value.toPrecision(4), "n"),
      element("td", one.since === null ? "–" : moment(one.since), "n"),
      element("td", one.until === undefined ? "" : moment(one.until), "n"),
      alarmButtons(one),
    );
    return row;
  });
  table.tBodies[0].replaceChildren(...rows);
  table.parentElement.hidden = !rows.length;
  byId("calm").textContent = rows.length ? "" : `None on ${events_topic}.`;
}

// ---- commands

const handling = byId("handling").elements;

function alarmUser() {
  return handling.by.value.trim();
}

function alarmButtons(one) {
  const cell = element("td"),
    place = element("div", undefined, "choice");
  if (one.until === undefined) {
    const muted = one.muted_until > Date.now() / 1000,
      anonymous = !alarmUser();
    const { rule, subject } = one,
      acknowledge = () => command("acknowledge", `${rule}, ${subject}`, "alarms/acknowledge", { rule, subject }),
      seconds = () => (muted ? 0 : Number(handling.seconds.value)),
      mute = () => command("mute", `${rule}, ${subject}`, "alarms/mute", { rule, subject, seconds: seconds() });
    place.append(
      button("Acknowledge", anonymous || one.acknowledged_by !== "", acknowledge),
      button(muted ? "Unmute" : "Mute", anonymous, mute),
    );
    if (anonymous) for (const one of place.children) one.title = "Enter your name first";
  }
  cell.append(place);
  return cell;
}

// A button that retires a node that is gone for good.
function retireButton(node) {
  const made = button("Retire", !alarmUser(), () => command("retire", node, "nodes/retire", { node }));
  made.title = alarmUser() ? `${node} is gone for good: end its alarms, and don't list it` : "Enter your name at Alarms first";
  return made;
}

// Sends a command to the alarm node, which publishes alarms again when it has followed it.
async function command(action, what, path, body) {
  const answer = byId("answer");
  answer.className = "soft";
  answer.textContent = `${action}: ${what} ...`;
  try {
    await send("POST", `/api/${path}`, JSON.stringify({ ...body, by: alarmUser() }));
    answer.textContent = `Sent to the alarm node: ${action} ${what}.`;
  } catch (error) {
    answer.className = "bad";
    answer.textContent = error.message;
  }
}

handling.by.value = localStorage.getItem("name") ?? "";
handling.by.addEventListener("input", () => localStorage.setItem("name", alarmUser()));
byId("handling").addEventListener("submit", (event) => event.preventDefault());
