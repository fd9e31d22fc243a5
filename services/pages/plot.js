// Time series plot: means as lines, strokes from minimum to maximum, red dots above a limit.
"use strict";

const HUES = [212, 32, 140, 275, 182, 55, 318, 95, 245],
  DASHES = [[], [7, 4], [2, 4], [10, 4, 2, 4]];

// Values that the crosshair lists in the plot under the pointer, and in the others.
const MAX_VALUES = 24,
  MAX_VALUES_ASIDE = 8;

function lineStyle(number) {
  return { hue: HUES[number % HUES.length], dash: DASHES[Math.floor(number / HUES.length) % DASHES.length] };
}

function cssVariable(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function colour(number) {
  return `hsl(${lineStyle(number).hue} 62% ${cssVariable("--light")})`;
}

// Sample of a line's style, for legends.
function key(number) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg"),
    line = document.createElementNS(svg.namespaceURI, "line");
  const shape = {
    x1: 0,
    x2: 20,
    y1: 4,
    y2: 4,
    stroke: colour(number),
    "stroke-width": 3,
    "stroke-dasharray": lineStyle(number).dash.join(" "),
  };
  for (const [name, value] of Object.entries(shape)) line.setAttribute(name, value);
  svg.setAttribute("class", "key");
  svg.append(line);
  return svg;
}

// Formats a value with three digits in the largest fitting unit of a list of [smallest value, name, factor].
function scaled(value, units) {
  const [, name, size] = units.findLast(([smallest]) => Math.abs(value) >= smallest);
  const shown = value / size;
  return `${Math.abs(shown) >= 100 ? Math.round(shown) : +shown.toPrecision(3)} ${name}`.trim();
}

const UNITS = {
  bytes: (v) =>
    scaled(v, [
      [0, "B", 1],
      [1e3, "kB", 1e3],
      [1e6, "MB", 1e6],
      [1e9, "GB", 1e9],
    ]),
  rate: (v) =>
    scaled(v, [
      [0, "B/s", 1],
      [1e3, "kB/s", 1e3],
      [1e6, "MB/s", 1e6],
      [1e9, "GB/s", 1e9],
    ]),
  seconds: (v) =>
    v === 0
      ? "0"
      : scaled(v, [
          [0, "µs", 1e-6],
          [1e-3, "ms", 1e-3],
          [1, "s", 1],
        ]),
  count: (v) =>
    scaled(v, [
      [0, "", 1],
      [1e5, "k", 1e3],
      [1e6, "M", 1e6],
    ]),
};

class Plot {
  // `unit`: a key of UNITS; `ranged(from, to)`: called with seconds when the user selects a range; `legend`: whether the
  // lines are named beside the title.
  constructor(place, { unit, ranged, legend }) {
    this.unit = UNITS[unit];
    this.ranged = ranged;
    this.legend = legend;
    this.figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    this.title = document.createElement("b");
    this.readout = document.createElement("output");
    caption.append(this.title, this.readout);
    this.box = document.createElement("div");
    this.values = document.createElement("div");
    this.values.className = "values";
    this.values.hidden = true;
    this.figure.append(caption, this.box, this.values);
    place.append(this.figure);
    new ResizeObserver(() => this.chart?.setSize(this.size())).observe(this.box);
    addEventListener("theme", () => this.rebuild());
    this.times = [];
    this.series = [];
  }

  // Sets the title, and the upper limit, if there is one.
  describe(title, limit) {
    this.limit = limit;
    this.title.textContent = title;
  }

  size() {
    return { width: Math.max(200, this.box.clientWidth), height: 190 };
  }

  // `times`: seconds; `series`: [{name, number, mean, min, max}], lists as long as `times`, null where there is no data.
  show(times, series, window) {
    const lines = (list) => JSON.stringify(list.map((one) => [one.name, one.number]));
    const same = this.chart && lines(series) === lines(this.series);
    [this.times, this.series, this.window] = [times, series, window];
    if (same) this.chart.setData(this.data());
    else this.rebuild();
    this.updateReadout();
  }

  data() {
    return [this.times, ...this.series.map((one) => one.mean)];
  }

  rebuild() {
    this.chart?.destroy();
    this.focused = null;
    const axis = {
      stroke: cssVariable("--soft"),
      grid: { stroke: cssVariable("--line"), width: 1 },
      ticks: { show: false },
      font: "12px system-ui",
    };
    const options = {
      ...this.size(),
      legend: { show: false },
      padding: [8, 6, 0, 0],
      cursor: {
        sync: { key: "time", setSeries: false },
        drag: { x: true, y: false, setScale: false },
        focus: { prox: 24 },
      },
      focus: { alpha: 0.25 },
      scales: { x: { time: true, range: () => this.window }, y: { range: () => this.range() } },
      axes: [
        { ...axis, size: 26, values: clock, space: 54 },
        { ...axis, size: 70, values: (_, ticks) => ticks.map(this.unit) },
      ],
      series: [
        {},
        ...this.series.map((one) => ({
          label: one.name,
          stroke: colour(one.number),
          dash: lineStyle(one.number).dash,
          width: 1.5,
          points: { show: true, filter: isolated, size: 4, fill: colour(one.number) },
        })),
      ],
      hooks: {
        drawAxes: [(u) => this.drawSpread(u)],
        draw: [(u) => this.drawLimit(u)],
        setCursor: [() => this.chart && this.updateReadout()],
        setSeries: [
          (_, line) => {
            this.focused = line; // the line nearest to the pointer; null: none is near
            if (this.chart) this.updateReadout();
          },
        ],
        setSelect: [
          (u) => {
            if (u.select.width < 8) return;
            this.ranged(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
            u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          },
        ],
      },
    };
    this.box.replaceChildren();
    this.chart = new uPlot(options, this.data(), this.box);
  }

  range() {
    let low = 0,
      high = 0;
    for (const one of this.series) {
      for (const v of one.min ?? one.mean) if (v < low) low = v;
      for (const v of one.max ?? one.mean) if (v > high) high = v;
    }
    if (this.limit !== undefined && this.limit <= 2 * high) high = Math.max(high, this.limit);
    return low === high ? [0, 1] : [low * 1.08, high * 1.08];
  }

  // Strokes from the minimum to the maximum of each bucket.
  drawSpread(u) {
    inside(u, (context, x, y) => {
      context.globalAlpha = 0.4;
      for (const one of this.series.filter((some) => some.min)) {
        context.strokeStyle = colour(one.number);
        context.lineWidth = devicePixelRatio;
        context.beginPath();
        this.times.forEach((time, i) => {
          if (one.max[i] > one.min[i]) {
            context.moveTo(x(time), y(one.min[i]));
            context.lineTo(x(time), y(one.max[i]));
          }
        });
        context.stroke();
      }
    });
  }

  // The limit as a dashed line, and a filled dot wherever a node exceeded it.
  drawLimit(u) {
    if (this.limit === undefined) return;
    inside(u, (context, x, y) => {
      context.strokeStyle = context.fillStyle = cssVariable("--bad");
      context.lineWidth = devicePixelRatio;
      context.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
      context.beginPath();
      context.moveTo(u.bbox.left, y(this.limit));
      context.lineTo(u.bbox.left + u.bbox.width, y(this.limit));
      context.stroke();
      for (const [i, value] of this.exceeded()) {
        context.beginPath();
        context.arc(x(this.times[i]), y(value), 3 * devicePixelRatio, 0, 2 * Math.PI);
        context.fill();
      }
    });
  }

  // Values that exceed the limit: [index, value] each.
  exceeded() {
    const found = [];
    for (const one of this.series)
      (one.max ?? one.mean).forEach((value, i) => {
        if (value !== null && value > this.limit) found.push([i, value]);
      });
    return found;
  }

  // Text beside the title: the time under the pointer, else how often the limit is exceeded.
  updateReadout() {
    const { idx, left } = this.chart.cursor,
      pointed = left >= 0 && idx !== null && idx !== undefined && idx < this.times.length;
    this.readout.className = "";
    this.showValues(pointed ? idx : null, left);
    if (pointed) {
      this.readout.textContent = new Date(1000 * this.times[idx]).toLocaleTimeString([], { hour12: false });
    } else if (this.limit !== undefined) {
      const count = this.exceeded().length;
      this.readout.className = count ? "bad" : "";
      this.readout.textContent = count ? `${count} above ${this.unit(this.limit)}` : `limit ${this.unit(this.limit)}`;
    } else if (this.legend) {
      this.readout.replaceChildren(...this.series.flatMap((one) => [key(one.number), ` ${one.name} `]));
    } else this.readout.textContent = "";
  }

  // List of all values at the crosshair, the largest first, on its free side; `index` null: none.
  showValues(index, left) {
    const known = index === null ? [] : this.series.filter((one) => one.mean[index] !== null);
    this.values.hidden = !known.length;
    if (!known.length) return;
    known.sort((a, b) => b.mean[index] - a.mean[index]);
    const nearest = this.series[this.focused - 1],
      room = this.figure.matches(":hover") ? MAX_VALUES : MAX_VALUES_ASIDE;
    const rows = known.slice(0, room).map((one) => {
      const row = document.createElement("div"),
        name = document.createElement("span"),
        value = document.createElement("b");
      [name.textContent, value.textContent] = [one.name, this.unit(one.mean[index])];
      row.className = one === nearest ? "nearest" : "";
      row.append(key(one.number), name, value);
      return row;
    });
    if (known.length > room) {
      const more = document.createElement("div");
      more.textContent = `and ${known.length - room} lower ones`;
      rows.push(more);
    }
    this.values.replaceChildren(...rows);
    const over = this.chart.over,
      isRight = left < over.clientWidth / 2,
      gap = 14;
    const start = over.getBoundingClientRect().left - this.figure.getBoundingClientRect().left;
    this.values.style.left = isRight ? `${start + left + gap}px` : "";
    this.values.style.right = isRight ? "" : `${this.figure.clientWidth - start - left + gap}px`;
    this.values.style.maxWidth = `${Math.max(left, over.clientWidth - left) - gap}px`;
  }
}

// Calls `draw(context, x, y)` clipped to the plot; `x` and `y` convert seconds and values to pixels of the canvas.
function inside(u, draw) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  draw(
    ctx,
    (seconds) => u.valToPos(seconds, "x", true),
    (value) => u.valToPos(value, "y", true),
  );
  ctx.restore();
}

// Points without a neighbour, which no line shows.
function isolated(u, number) {
  const values = u.data[number];
  return values.flatMap((value, i) => (value != null && values[i - 1] == null && values[i + 1] == null ? [i] : []));
}

function clock(_, ticks, axis, space, step) {
  const days = ticks.length && ticks.at(-1) - ticks[0] > 86400;
  const format = {
    hour12: false,
    hour: "2-digit",
    minute: "2-digit",
    ...(step < 60 && { second: "2-digit" }),
    ...(days && { day: "2-digit", month: "2-digit" }),
  };
  return ticks.map((tick) => new Date(1000 * tick).toLocaleString([], format));
}
