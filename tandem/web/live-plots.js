// Time series that scroll, and the plots of them.

const KEPT_S = 120;
const PAUSED_KEPT_S = 900;
// A time so much before the last one means that a clock was set.
const CLOCK_SET_S = 5;
const WINDOW_S = 30;
const WINDOW_SAMPLES = 100;

// Rows of numbers with rising times. A gap in time is a row without values, so that no line is drawn through it.
class Stream {
  constructor() { this.clear(); }

  clear() {
    this.t = [];
    this.columns = new Map();
    this.interval = null;
  }

  get newest() { return this.t.length ? this.t[this.t.length - 1] : null; }

  push(t, values) {
    const last = this.newest;
    if (last !== null && t < last - CLOCK_SET_S) this.clear();
    else if (last !== null) {
      if (t <= last) return;
      const usual = this.interval ?? t - last;
      if (t - last > Math.max(0.3, 6 * usual)) this.append(last + usual / 2, {});
      else this.interval = usual + 0.05 * (t - last - usual);
    }
    this.append(t, values);
  }

  append(t, values) {
    const row = this.t.length;
    this.t.push(t);
    for (const name of Object.keys(values)) {
      if (!this.columns.has(name)) this.columns.set(name, new Array(row).fill(null));
    }
    for (const [name, column] of this.columns) column.push(values[name] ?? null);
  }

  trim(before) {
    const count = this.after(before);
    if (count < 500) return;
    this.t.splice(0, count);
    for (const column of this.columns.values()) column.splice(0, count);
  }

  // The first row that is not before a time.
  after(time) {
    let low = 0, high = this.t.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.t[middle] < time) low = middle + 1; else high = middle;
    }
    return low;
  }

  // Times and columns from a time on, and the row before it, where the line comes from.
  slice(names, from) {
    const first = Math.max(0, this.after(from) - 1);
    const empty = () => new Array(this.t.length - first).fill(null);
    return [this.t.slice(first), ...names.map((name) => this.columns.get(name)?.slice(first) ?? empty())];
  }
}

const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const FONT = "11px system-ui, sans-serif";
const two = (number) => String(number).padStart(2, "0");
const clock = (seconds, parts = 0) => {
  const date = new Date(seconds * 1000);
  const whole = [date.getHours(), date.getMinutes(), date.getSeconds()].map(two).join(":");
  return parts ? `${whole}.${String(date.getMilliseconds()).padStart(3, "0").slice(0, parts)}` : whole;
};
const tickLabel = (value) => {
  const rounded = Number(value.toPrecision(6)), size = Math.abs(rounded);
  return size !== 0 && (size < 1e-3 || size >= 1e5) ? rounded.toExponential() : String(rounded);
};
const short = (value) => {
  if (value === null || value === undefined) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-3 ? value.toExponential(2) : value.toPrecision(4);
};

// One plot: title, meaning, unit; series [{stream, column, label, color, dash, step}], those in front last; bounds() as
// [low, high].
class Plot {
  constructor(parent, {title, meaning, unit, series, bounds, zero}, shared) {
    Object.assign(this, {series, shared, zero, bounds: bounds ?? (() => [null, null]), range: null, visible: true});
    this.streams = [...new Set(series.map((one) => one.stream))];
    const figure = parent.appendChild(document.createElement("figure"));
    const caption = figure.appendChild(document.createElement("figcaption"));
    caption.appendChild(document.createElement("b")).textContent = title;
    caption.appendChild(document.createElement("span")).textContent = meaning ?? "";
    this.ordered = this.streams.flatMap((stream) => series.filter((one) => one.stream === stream));
    const width = () => Math.max(120, figure.clientWidth - 20);
    this.u = new uPlot(this.options(width(), unit), [[], ...series.map(() => [])], figure);
    new ResizeObserver(() => this.u.setSize({width: width(), height: this.u.height})).observe(figure);
    new IntersectionObserver(([seen]) => { this.visible = seen.isIntersecting; }).observe(figure);
    this.figure = figure;
  }

  options(width, unit) {
    const grid = {stroke: () => color("line"), width: 1};
    const axis = {stroke: () => color("dim"), font: FONT, ticks: {show: false}, grid};
    const nearest = (u, which, row) => {
      const values = u.data[which];
      if (which === 0 || row === null || values[row] != null) return row;
      for (let step = 1; step < values.length; step++) {
        if (values[row - step] != null) return row - step;
        if (values[row + step] != null) return row + step;
      }
      return row;
    };
    return {
      width, height: 150, padding: [8, 28, 0, 0],
      scales: {x: {time: true, auto: false}, y: {auto: false}},
      cursor: {y: false, sync: {key: "time"}, drag: {x: true, y: false}, points: {size: 6}, dataIdx: nearest},
      axes: [
        {...axis, size: 22, space: 80, values: (_u, splits) => splits.map((one) => clock(one))},
        {...axis, size: 54, space: 26, values: (_u, splits) => splits.map(tickLabel),
          label: unit && unit !== "1" ? unit : undefined, labelSize: 16, labelFont: FONT, labelGap: 0},
      ],
      series: [
        {label: "at", value: (_u, t) => (t == null ? "" : clock(t, 2))},
        ...this.ordered.map(({label, color: name, dash, step, width: line}) => ({
          label, dash, stroke: () => color(name), width: line ?? 1.5, points: {show: false},
          value: (_u, value) => short(value), paths: step ? uPlot.paths.stepped({align: 1}) : undefined,
        })),
      ],
      hooks: {
        drawClear: [(u) => this.drawBounds(u)],
        draw: [(u) => this.drawMarks(u)],
        setSelect: [(u) => { if (u.select.width > 0) this.shared.pause(); }],
      },
    };
  }

  drawBounds({ctx, bbox, valToPos}) {
    const [low, high] = this.bounds();
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (const [bound, end] of [[low, bbox.top + bbox.height], [high, bbox.top]]) {
      if (bound === null) continue;
      const at = valToPos(bound, "y", true);
      ctx.fillStyle = color("shade");
      ctx.fillRect(bbox.left, Math.min(at, end), bbox.width, Math.abs(end - at));
      line(ctx, "bound", [], bbox.left, at, bbox.left + bbox.width, at);
    }
    ctx.restore();
  }

  drawMarks({ctx, bbox, valToPos, scales}) {
    for (const {t, text} of this.shared.marks) {
      if (t < scales.x.min || t > scales.x.max) continue;
      const at = valToPos(t, "x", true);
      line(ctx, "dim", [4, 4], at, bbox.top, at, bbox.top + bbox.height);
      const right = at > bbox.left + bbox.width / 2;
      ctx.save();
      Object.assign(ctx, {fillStyle: color("dim"), textAlign: right ? "right" : "left", textBaseline: "top"});
      ctx.font = FONT.replace("11px", `${10 * devicePixelRatio}px`);
      ctx.fillText(text, at + (right ? -4 : 4) * devicePixelRatio, bbox.top + 3);
      ctx.restore();
    }
  }

  draw(from, to, fit) {
    const tables = this.streams.map((stream) => stream.slice(
      this.ordered.filter((one) => one.stream === stream).map((one) => one.column), from));
    const data = tables.length > 1 ? uPlot.join(tables) : tables[0];
    const {u} = this;
    this.fitRange(data, fit);
    u.batch(() => {
      u.setData(data, false);
      u.setScale("x", {min: from, max: to});
      if (this.range) u.setScale("y", {min: this.range[0], max: this.range[1]});
    });
    if (!(u.cursor.left >= 0)) {
      const last = (values) => values.findLastIndex((value) => value != null);
      u.setLegend({idxs: data.map((values) => { const at = last(values); return at < 0 ? null : at; })});
    }
  }

  // Wide enough for the data, and for the bounds unless it is to fit the data. It grows at once and shrinks rarely.
  fitRange(data, fit) {
    let [low, high] = [Infinity, -Infinity];
    const take = (value) => { if (value != null) { low = Math.min(low, value); high = Math.max(high, value); } };
    for (const values of data.slice(1)) for (const value of values) take(value);
    if (!fit) this.bounds().forEach(take);
    if (this.zero) take(0);
    if (low > high) return;
    const room = 0.08 * (high - low) || 0.05 * Math.abs(high) || 0.5;
    const wanted = [this.zero && low >= 0 ? 0 : low - room, high + room];
    const now = this.range;
    const inside = now && now[0] <= low && now[1] >= high;
    if (!inside || this.fitted !== fit || wanted[1] - wanted[0] < 0.6 * (now[1] - now[0])) this.range = wanted;
    this.fitted = fit;
  }
}

function line(ctx, name, dash, x0, y0, x1, y1) {
  ctx.save();
  ctx.strokeStyle = color(name);
  ctx.lineWidth = devicePixelRatio;
  ctx.setLineDash(dash.map((one) => one * devicePixelRatio));
  ctx.beginPath();
  ctx.moveTo(x0, y0);
  ctx.lineTo(x1, y1);
  ctx.stroke();
  ctx.restore();
}
