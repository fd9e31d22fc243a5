// A plot of lines over time, as all pages have it: means as lines, strokes from least to most, red dots beyond a limit.
"use strict";

const HUES = [212, 32, 140, 275, 182, 55, 318, 95, 245],
  DASHES = [[], [7, 4], [2, 4], [10, 4, 2, 4]];

function look(number) {
  return { hue: HUES[number % HUES.length], dash: DASHES[Math.floor(number / HUES.length) % DASHES.length] };
}

function styled(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function colour(number) {
  return `hsl(${look(number).hue} 62% ${styled("--light")})`;
}

// How a line looks, for legends.
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
    "stroke-dasharray": look(number).dash.join(" "),
  };
  for (const [name, value] of Object.entries(shape)) line.setAttribute(name, value);
  svg.setAttribute("class", "key");
  svg.append(line);
  return svg;
}

// A value in the largest of some units, [least value, name, size], with three digits.
function scaled(value, units) {
  const [, name, size] = units.findLast(([least]) => Math.abs(value) >= least);
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
  // `unit`: a key of UNITS; `limit`: a value, or none; `ranged(from, to)`: called with seconds when a range is drawn;
  // `legend`: whether lines are named beside the title.
  constructor(place, { title, unit, limit, ranged, legend }) {
    this.unit = UNITS[unit];
    this.limit = limit;
    this.ranged = ranged;
    this.legend = legend;
    this.figure = document.createElement("figure");
    const caption = document.createElement("figcaption"),
      name = document.createElement("b");
    name.textContent = title;
    this.told = document.createElement("output");
    caption.append(name, this.told);
    this.box = document.createElement("div");
    this.figure.append(caption, this.box);
    place.append(this.figure);
    new ResizeObserver(() => this.chart?.setSize(this.size())).observe(this.box);
    addEventListener("theme", () => this.rebuild());
    this.times = [];
    this.series = [];
  }

  size() {
    return { width: Math.max(200, this.box.clientWidth), height: 190 };
  }

  // `times`: seconds; `series`: [{name, number, mean, min, max}], lists as long as times, null where nothing is known.
  show(times, series, window) {
    const lines = (list) => JSON.stringify(list.map((one) => [one.name, one.number]));
    const same = this.chart && lines(series) === lines(this.series);
    [this.times, this.series, this.window] = [times, series, window];
    if (same) this.chart.setData(this.data());
    else this.rebuild();
    this.tell();
  }

  data() {
    return [this.times, ...this.series.map((one) => one.mean)];
  }

  rebuild() {
    this.chart?.destroy();
    this.focused = null;
    const axis = {
      stroke: styled("--soft"),
      grid: { stroke: styled("--line"), width: 1 },
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
        y: false,
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
          dash: look(one.number).dash,
          width: 1.5,
          points: { show: true, filter: lonely, size: 4, fill: colour(one.number) },
        })),
      ],
      hooks: {
        drawAxes: [(u) => this.drawSpread(u)],
        draw: [(u) => this.drawLimit(u)],
        setCursor: [() => this.chart && this.tell()],
        setSeries: [
          (_, line) => {
            this.focused = line; // the one that is nearest to the pointer; null: none is near
            if (this.chart) this.tell();
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

  // Strokes from the least to the most of a bucket.
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

  // The limit as a dashed line, and a filled dot wherever a node was beyond it.
  drawLimit(u) {
    if (this.limit === undefined) return;
    inside(u, (context, x, y) => {
      context.strokeStyle = context.fillStyle = styled("--bad");
      context.lineWidth = devicePixelRatio;
      context.setLineDash([5 * devicePixelRatio, 4 * devicePixelRatio]);
      context.beginPath();
      context.moveTo(u.bbox.left, y(this.limit));
      context.lineTo(u.bbox.left + u.bbox.width, y(this.limit));
      context.stroke();
      for (const [i, value] of this.beyond()) {
        context.beginPath();
        context.arc(x(this.times[i]), y(value), 3 * devicePixelRatio, 0, 2 * Math.PI);
        context.fill();
      }
    });
  }

  // Where nodes were beyond the limit: [index, value] each.
  beyond() {
    const found = [];
    for (const one of this.series)
      (one.max ?? one.mean).forEach((value, i) => {
        if (value !== null && value > this.limit) found.push([i, value]);
      });
    return found;
  }

  // Beside the title: what is under the pointer, else what is beyond the limit.
  tell() {
    const { idx, left } = this.chart.cursor;
    this.told.className = "";
    if (left >= 0 && idx !== null && idx !== undefined) {
      const one = this.series[this.focused - 1],
        value = one?.mean[idx];
      const shown = one ? ` · ${one.name} · ${value === null ? "–" : this.unit(value)}` : "";
      this.told.textContent = new Date(1000 * this.times[idx]).toLocaleTimeString([], { hour12: false }) + shown;
    } else if (this.limit !== undefined) {
      const times = this.beyond().length;
      this.told.className = times ? "bad" : "";
      this.told.textContent = times ? `${times} beyond ${this.unit(this.limit)}` : `limit ${this.unit(this.limit)}`;
    } else if (this.legend) {
      this.told.replaceChildren(...this.series.flatMap((one) => [key(one.number), ` ${one.name} `]));
    } else this.told.textContent = "";
  }
}

// Calls `draw(context, x, y)`, whose `x` and `y` turn seconds and values into pixels of the canvas, inside the plot.
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

// Points that have no neighbour, and so no line.
function lonely(u, number) {
  const values = u.data[number];
  return values.flatMap((value, i) => (value != null && values[i - 1] == null && values[i + 1] == null ? [i] : []));
}

function clock(_, ticks, axis, space, step) {
  const days = ticks.length && ticks.at(-1) - ticks[0] > 86400;
  const told = {
    hour12: false,
    hour: "2-digit",
    minute: "2-digit",
    ...(step < 60 && { second: "2-digit" }),
    ...(days && { day: "2-digit", month: "2-digit" }),
  };
  return ticks.map((tick) => new Date(1000 * tick).toLocaleString([], told));
}
