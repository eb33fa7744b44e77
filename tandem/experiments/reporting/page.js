"use strict";
// Draws every chart of the page with uPlot: zoom, values under the cursor, series that can be switched off.
(() => {
  const VERMILION = "#D55E00", GREY = "#6F6F6F";
  const DARK = {
    "#000000": "#f0f0f0", "#0072B2": "#7d9bff", "#882255": "#d87aa8", [GREY]: "#a8a8a8", [VERMILION]: "#f0813a",
  };
  const HEIGHT = 260;
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  let printing = false;
  const dark = () => scheme.matches && !printing;
  const colour = (name) => (dark() && DARK[name]) || name;
  const css = (name) => (printing ? { "--ink": "#000", "--soft": "#333", "--grid": "#ddd" }[name]
    : getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  const faint = (name, share) => colour(name) + Math.round(255 * share).toString(16).padStart(2, "0");
  const text = (value, digits) => String(Number(value.toPrecision(digits))).replace("-", "−");
  const shown = (value, digits = 4) => (value == null ? "" : text(value, digits));

  // The index of the nearest sample that this series has: series of other periods have gaps.
  function nearest(u, series, index) {
    const values = u.data[series];
    for (let off = 0; off < values.length; off++) {
      if (values[index - off] != null) return index - off;
      if (values[index + off] != null) return index + off;
    }
    return index;
  }

  // 1, 2 and 5 of every decade, or every so many decades where there are many.
  function decades(low, high) {
    const first = Math.floor(Math.log10(low)), last = Math.ceil(Math.log10(high));
    const every = Math.ceil((last - first) / 8);
    const steps = last - first > 3 ? [1] : [1, 2, 5], found = [];
    for (let power = first; power <= last; power++) {
      if ((power - first) % every === 0) found.push(...steps.map((step) => Number(`${step}e${power}`)));
    }
    return found.filter((tick) => tick >= low && tick <= high);
  }

  // Leaves out the labels that would touch the one before.
  function apart(u, splits) {
    let last = Infinity;
    return splits.map((split) => {
      const at = u.valToPos(split, "y");
      if (Math.abs(last - at) < 13) return null;
      last = at;
      return split;
    });
  }

  function rangeOfY(chart) {
    return (u, low, high) => {
      // No line to show, as when a person has switched off all. A logarithmic axis cannot begin at 0.
      if (low == null || high == null) return chart.scale === "log" ? [0.1, 10] : [0, 1];
      if (chart.scale === "log") {
        const levels = (chart.levels || []).map((level) => level.y).filter((y) => y > 0);
        return [Math.min(low, ...levels) / 1.3, Math.max(high, ...levels) * 1.8];
      }
      if (chart.scale === "asinh") {
        return [Math.min(1.3 * low, -chart.linear / 2), Math.max(1.3 * high, chart.linear / 2)];
      }
      const reach = 0.6 * (high - low);
      const near = [...(chart.bounds || []), ...(chart.levels || []).map((level) => level.y)]
        .filter((y) => y != null && y > low - reach && y < high + reach);
      low = Math.min(low, ...near); high = Math.max(high, ...near);
      const margin = 0.06 * (high - low || Math.abs(high) || 1);
      return [low - margin, high + margin];
    };
  }

  // What lies behind the lines: the outside of the bounds, a span of time, levels.
  function background(chart) {
    return (u) => {
      const { ctx, bbox } = u, ratio = devicePixelRatio;
      ctx.save();
      ctx.beginPath(); ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height); ctx.clip();
      const across = (y) => Math.round(u.valToPos(y, "y", true));
      const line = (y, name, dash) => {
        ctx.strokeStyle = colour(name); ctx.lineWidth = ratio; ctx.setLineDash(dash.map((length) => length * ratio));
        ctx.beginPath(); ctx.moveTo(bbox.left, across(y)); ctx.lineTo(bbox.left + bbox.width, across(y)); ctx.stroke();
      };
      const [low, high] = chart.bounds || [];
      ctx.fillStyle = faint(VERMILION, 0.13);
      if (low != null && low > u.scales.y.min) {
        ctx.fillRect(bbox.left, across(low), bbox.width, bbox.height); line(low, VERMILION, [6, 3]);
      }
      if (high != null && high < u.scales.y.max) {
        ctx.fillRect(bbox.left, bbox.top, bbox.width, across(high) - bbox.top); line(high, VERMILION, [6, 3]);
      }
      if (chart.span) {
        const [first, last] = chart.span.map((t) => u.valToPos(t, "x", true));
        ctx.fillStyle = faint(GREY, 0.35);
        ctx.fillRect(first, bbox.top, Math.max(last - first, 2 * ratio), bbox.height);
      }
      ctx.font = `${12 * ratio}px system-ui, sans-serif`; ctx.textAlign = "left"; ctx.textBaseline = "bottom";
      for (const level of chart.levels || []) {
        if (level.y <= u.scales.y.min || level.y >= u.scales.y.max) continue;
        line(level.y, GREY, [2, 3]);
        ctx.fillStyle = css("--soft");
        const at = across(level.y), above = at - 16 * ratio > bbox.top;
        ctx.fillText(level.label, bbox.left + 4 * ratio, above ? at - 2 * ratio : at + 16 * ratio);
      }
      ctx.restore();
    };
  }

  // The style of a line as that of a border, for the legend.
  function borderOf(dash) {
    if (!dash?.length) return "solid";
    return dash[0] < 4 ? "dotted" : "dashed";
  }

  function optionsOf(chart, width, linked) {
    const series = [{ label: chart.xLabel, value: (u, value) => shown(value) }], data = [chart.x], bands = [];
    for (const line of chart.lines || []) {
      const own = series.length;
      series.push({
        label: line.label, caseName: line.name,
        stroke: () => colour(line.color), width: 2, dash: line.dash, spanGaps: true,
        points: { show: chart.x.length < 30, size: 6 },
        value: (u, value, s, index) => {
          if (value == null || index == null || !line.low) return shown(value);
          return `${shown(value)} (${shown(line.low[index])} to ${shown(line.high[index])})`;
        },
      });
      data.push(line.y);
      if (!line.low) continue;
      for (const edge of [line.high, line.low]) {
        series.push({
          label: line.label, caseName: line.name, class: "band",
          stroke: "transparent", width: 0, spanGaps: true, points: { show: false },
        });
        data.push(edge);
      }
      bands.push({ series: [own + 1, own + 2], fill: () => faint(line.color, 0.17) });
    }
    const grid = () => css("--grid");
    const axis = (more) => ({
      stroke: () => css("--soft"), grid: { stroke: grid, width: 1 }, ticks: { stroke: grid },
      font: "12px system-ui, sans-serif", labelFont: "13px system-ui, sans-serif", labelSize: 22, ...more,
    });
    const numbers = (u, values) => values.map((value) => shown(value, 6));
    const y = { label: chart.yLabel, size: 52, values: numbers };
    if (chart.ticks) y.splits = (u, index, low, high) => chart.ticks.filter((tick) => tick >= low && tick <= high);
    else if (chart.scale === "log") y.splits = (u, index, low, high) => decades(low, high);
    if (y.splits) y.filter = (u, splits) => apart(u, splits);
    const x = { label: chart.xLabel, values: numbers, size: 30 };
    if (chart.whole) x.incrs = [1, 2, 5, 10, 20, 50, 100, 1000];
    const [first, last] = [chart.x[0], chart.x[chart.x.length - 1]];
    return [{
      width, height: HEIGHT, series, bands, scales: {
        x: {
          time: false,
          range: (u, low, high) =>
            (low === high ? [low - 0.5, high + 0.5] : [Math.max(low, first), Math.min(high, last)]),
        },
        y: { distr: { log: 3, asinh: 4 }[chart.scale] || 1, asinh: chart.linear, range: rangeOfY(chart) },
      },
      axes: [axis(x), axis(y)],
      cursor: { drag: { x: true, y: false, setScale: true }, dataIdx: nearest, points: { size: 7 } },
      legend: { live: true, markers: { dash: (u, index) => borderOf(u.series[index].dash) } },
      hooks: {
        drawAxes: [background(chart)],
        setScale: [(u, key) => { if (key === "x") linked.zoom(u); }],
        setSeries: [(u, index, changed) => {
          if (index != null && changed.show != null) linked.toggle(u, index, changed.show);
        }],
      },
    }, data];
  }

  const ends = (u) => [u.data[0][0], u.data[0][u.data[0].length - 1]];

  // The charts of one group zoom in time together, and switch the same series off.
  function link() {
    const charts = [];
    let busy = true;
    const free = () => { busy = false; };
    // uPlot applies a scale after this turn and tells it as if a person had zoomed: until then nothing is passed on.
    const alone = (work) => { if (!busy) { busy = true; work(); setTimeout(free, 0); } };
    const zoomed = (u) => { const [first, last] = ends(u); return u.scales.x.min > first || u.scales.x.max < last; };
    return {
      charts,
      free,
      zoom: (from) => alone(() => {
        const { min, max } = from.scales.x;
        for (const u of charts) {
          const [first, last] = ends(u);
          if (u === from || u.unit !== from.unit || max <= first || min >= last) continue;
          u.setScale("x", zoomed(from) ? { min, max } : { min: first, max: last });
        }
      }),
      toggle: (from, index, show) => alone(() => {
        const name = from.series[index].caseName;
        for (const u of charts) {
          u.series.forEach((one, i) => {
            if (i && one.caseName === name && one.show !== show) u.setSeries(i, { show });
          });
        }
      }),
    };
  }

  function zoomBy(u, factor, centre) {
    const { min, max } = u.scales.x, [first, last] = ends(u);
    const at = centre ?? (min + max) / 2;
    const low = Math.max(first, at - (at - min) * factor), high = Math.min(last, at + (max - at) * factor);
    if (high > low) u.setScale("x", { min: low, max: high });
  }

  const resize = (u, width) => u.setSize({ width, height: HEIGHT });
  const reset = (u) => { const [min, max] = ends(u); u.setScale("x", { min, max }); };

  // One finger moves the cursor, two fingers zoom; a vertical swipe still scrolls the page.
  function touch(u) {
    const fingers = new Map();
    let spread = 0;
    const left = (event) => event.clientX - u.over.getBoundingClientRect().left;
    const drop = (event) => { fingers.delete(event.pointerId); spread = 0; };
    u.over.addEventListener("pointerdown", (event) => {
      if (event.pointerType === "touch") fingers.set(event.pointerId, left(event));
    });
    u.over.addEventListener("pointermove", (event) => {
      if (!fingers.has(event.pointerId)) return;
      fingers.set(event.pointerId, left(event));
      const at = [...fingers.values()];
      if (at.length === 1) { u.setCursor({ left: at[0], top: 10 }); return; }
      const now = Math.max(20, Math.abs(at[0] - at[1]));
      if (spread) zoomBy(u, spread / now, u.posToVal((at[0] + at[1]) / 2, "x"));
      spread = now;
    });
    for (const name of ["pointerup", "pointercancel", "pointerleave"]) u.over.addEventListener(name, drop);
  }

  function bar(box, chart, of) {
    const head = document.createElement("div"), title = document.createElement("strong");
    head.className = "bar"; title.textContent = chart.title || ""; head.append(title);
    for (const [text, name, act] of [
      ["+", "zoom in", () => zoomBy(of(), 0.5)],
      ["−", "zoom out", () => zoomBy(of(), 2)],
      ["reset", "show all", () => reset(of())],
    ]) {
      const button = document.createElement("button");
      button.type = "button"; button.textContent = text; button.title = name; button.setAttribute("aria-label", name);
      button.addEventListener("click", act);
      head.append(button);
    }
    box.append(head);
  }

  function keyboard(u) {
    u.root.querySelectorAll(".u-series:not(.band) th").forEach((cell, i) => {
      if (!i) return;
      cell.tabIndex = 0; cell.setAttribute("role", "button"); cell.title = "show or hide";
      cell.addEventListener("keydown", (event) => {
        if (event.key === "Enter" || event.key === " ") { event.preventDefault(); cell.click(); }
      });
    });
  }

  function draw(box, linked) {
    const chart = JSON.parse(box.querySelector("script").textContent);
    let u = null;
    bar(box, chart, () => u);
    const [options, data] = optionsOf(chart, Math.max(240, box.clientWidth), linked);
    u = new uPlot(options, data, box);
    u.unit = chart.xLabel;
    linked.charts.push(u);
    touch(u); keyboard(u);
    const fit = () => { if (!printing && box.clientWidth && box.clientWidth !== u.width) resize(u, box.clientWidth); };
    new ResizeObserver(fit).observe(box);
    return u;
  }

  const plots = [];
  for (const section of document.querySelectorAll("section")) {
    const linked = link();
    for (const box of section.querySelectorAll(".chart")) plots.push(draw(box, linked));
    setTimeout(linked.free, 0);
  }
  const redraw = () => plots.forEach((u) => u.redraw());
  scheme.addEventListener("change", redraw);
  addEventListener("beforeprint", () => { printing = true; plots.forEach((u) => resize(u, 440)); });
  addEventListener("afterprint", () => {
    printing = false;
    plots.forEach((u) => resize(u, u.root.parentElement.clientWidth));
  });

  // Tables that are wider than the page say so.
  function cue(wide) {
    const box = wide.querySelector(".scroll"), over = box.scrollWidth - box.clientWidth;
    wide.querySelector(".cue").hidden = over < 2;
    wide.classList.toggle("more", over - box.scrollLeft > 2);
  }
  for (const wide of document.querySelectorAll(".wide")) {
    wide.querySelector(".scroll").addEventListener("scroll", () => cue(wide), { passive: true });
    new ResizeObserver(() => cue(wide)).observe(wide.querySelector(".scroll"));
    cue(wide);
  }
  if (matchMedia("(max-width: 1099px)").matches) document.querySelector("nav details").open = false;
})();
