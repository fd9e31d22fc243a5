// Table of topics on the dashboard of the event bus, sorted by the column that the user chooses.
"use strict";

const perSecond = (value) => `${+value.toPrecision(3)}/s`;
const TOPIC_COLUMNS = [
  ["topic", String],
  ["type", String],
  ["publishers", String],
  ["subscribers", String],
  ["published", perSecond],
  ["received", perSecond],
  ["bandwidth", UNITS.rate],
  ["latency", UNITS.seconds],
  ["lost", perSecond],
  ["size", UNITS.bytes],
];
let sorting = { key: "bandwidth", descending: true };
let shownTopics = [];

// Order of two topics; unknown values come last either way.
function compareTopics(a, b) {
  const [x, y] = [a[sorting.key], b[sorting.key]],
    sign = sorting.descending ? -1 : 1;
  if (x === null || y === null) return (x === null) - (y === null);
  return sign * (typeof x === "string" ? x.localeCompare(y, undefined, { numeric: true }) : x - y);
}

function showTopics(topics) {
  shownTopics = topics;
  const rows = [...topics].sort(compareTopics).map((one) => {
    const row = element("tr");
    for (const [key, format] of TOPIC_COLUMNS) {
      const cell = element("td", undefined, key === "topic" || key === "type" ? "" : one.lost && key === "lost" ? "n bad" : "n");
      cell.append(element("span", one[key] === null ? "–" : format(one[key])));
      row.append(cell);
    }
    return row;
  });
  byId("topics").querySelector("tbody").replaceChildren(...rows);
  byId("topics").hidden = !rows.length;
}

function sortBy(key) {
  sorting = { key, descending: sorting.key === key ? !sorting.descending : !["topic", "type"].includes(key) };
  markSorting();
  showTopics(shownTopics);
}

function markSorting() {
  for (const head of byId("topics").querySelectorAll("th"))
    head.setAttribute(
      "aria-sort",
      head.dataset.key !== sorting.key ? "none" : sorting.descending ? "descending" : "ascending",
    );
}

for (const head of byId("topics").querySelectorAll("th")) {
  const control = button(head.textContent, false, () => sortBy(head.dataset.key));
  head.replaceChildren(control);
}
markSorting();
