// Script of the pages. It receives events, replaces changed parts of the page, and draws curves.
"use strict";

(() => {
  // Okabe and Ito's colours, for all kinds of colour vision.
  const COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d00", "#7f7f7f"];
  const NARROWEST = 200, HEIGHT = 220;
  // Colour (an index of COLOURS) and y range of each chart, by the name of the chart's element.
  const CURVES = {
    return: { colour: 0 },
    success: { colour: 2, range: [0, 100] },
    length: { colour: 3 },
    speed: { colour: 1, range: [0, null] },
  };
  const REPORT_REST = 10_000;

  const live = document.getElementById("live");
  const plots = new Map();
  const shown = new Map();
  let charts = null;

  const style = (name) => getComputedStyle(document.body).getPropertyValue(name).trim();
  const over = () => document.querySelector("input[name=over]:checked")?.value ?? "episodes";
  const short = (number) =>
    number === null || number === undefined ? "–"
      : Math.abs(number) >= 1e4 ? number.toLocaleString("en", { notation: "compact", maximumFractionDigits: 1 })
      : number.toLocaleString("en", { maximumFractionDigits: 2 });

  function say(words, state) {
    if (live.textContent !== words) live.textContent = words;
    live.dataset.state = state;
  }

  // Shows times in the reader's time zone.
  function localTimes(within) {
    for (const element of within.querySelectorAll("time[datetime]")) {
      element.title = element.textContent;
      const time = new Date(element.dateTime);
      element.textContent = time.toLocaleString([], { dateStyle: "medium", timeStyle: "short" });
    }
  }

  function options(place, series, range, label) {
    const ink = style("--ink-soft"), line = style("--line");
    const axis = { stroke: ink, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 }, font: "12px system-ui" };
    const ticks = (self, values) => values.map(short);
    return {
      width: Math.max(NARROWEST, place.clientWidth),
      height: HEIGHT,
      scales: { x: { time: false }, y: range ? { range: (self, least, most) => [range[0], range[1] ?? most * 1.05] } : {} },
      axes: [
        { ...axis, values: ticks, size: 46, label, labelSize: 18, labelFont: "12px system-ui", space: 60 },
        { ...axis, values: ticks, size: 52 },
      ],
      series: [{ label, value: (self, value) => short(value) }, ...series],
      legend: { show: series.length === 1 },
      cursor: { drag: { x: true, y: false }, points: { size: 7 } },
    };
  }

  // Draws `data` in a figure. Keeps the figure's plot if `key` and the colours of the page are unchanged, else makes a new one.
  function plot(figure, key, data, make) {
    const place = figure.querySelector(".plot");
    const known = plots.get(figure);
    if (known?.key === key && known.theme === style("--ink")) {
      known.plot.setData(data);
      return;
    }
    known?.plot.destroy();
    place.replaceChildren();
    plots.set(figure, { key, theme: style("--ink"), plot: new uPlot(make(place), data, place) });
    sizes.observe(place);
  }

  // Removes the chart of a run that was started again and has no data yet.
  function clear(figure) {
    const known = plots.get(figure), place = figure.querySelector(".plot");
    if (!known) return;
    known.plot.destroy();
    plots.delete(figure);
    place.replaceChildren();
    place.setAttribute("aria-label", figure.querySelector("figcaption").textContent);
    delete figure.dataset.points;
    delete figure.dataset.reach;
  }

  function drawCurve(figure, curve) {
    const name = figure.dataset.chart, { colour, range } = CURVES[name];
    if (!curve || curve.episodes.length === 0) return clear(figure);
    const by = over(), label = by === "steps" ? "environment steps" : "episodes";
    const stroke = COLOURS[colour];
    const one = {
      label: figure.querySelector("figcaption").textContent,
      stroke,
      width: 2,
      spanGaps: true,
      points: { show: curve.episodes.length < 12, size: 6, fill: stroke },
      value: (self, value) => short(value),
    };
    const key = `${by} ${one.points.show}`;
    plot(figure, key, [curve[by], curve[name]], (place) => options(place, [one], range, label));
    const last = curve[name][curve[name].length - 1];
    figure.querySelector(".plot").setAttribute("aria-label", `${one.label} over ${label}; the last point is ${short(last)}`);
    figure.dataset.points = curve.episodes.length;
    figure.dataset.reach = curve[by][curve[by].length - 1];
  }

  // Draws the curves of several runs, with one colour for each kind of run (`run.kind`).
  function drawRuns(figure, runs, name) {
    figure.parentElement.hidden = runs.length === 0;
    if (runs.length === 0) return clear(figure);
    const by = over();
    const kinds = [...new Set(runs.map((run) => run.kind))];
    const colour = (run) => COLOURS[kinds.indexOf(run.kind) % COLOURS.length];
    const data = uPlot.join(runs.map((run) => [run[by], run[name]]));
    const series = runs.map((run) => ({
      label: run.id, stroke: colour(run), width: 1.5, spanGaps: true, points: { show: false },
    }));
    const key = [by, ...runs.map((run) => run.id)].join();
    const label = by === "steps" ? "environment steps" : "episodes";
    plot(figure, key, data, (place) => options(place, series, CURVES[name].range, label));
    figure.dataset.points = data[0].length;
    let legend = figure.querySelector("ul");
    if (!legend) {
      legend = document.createElement("ul");
      legend.className = "legend";
      figure.append(legend);
    }
    legend.replaceChildren(...kinds.map((kind, place) => {
      const item = document.createElement("li"), swatch = document.createElement("span");
      swatch.className = "swatch";
      swatch.style.backgroundColor = COLOURS[place % COLOURS.length];
      item.append(swatch, kind);
      return item;
    }));
  }

  function draw() {
    if (!charts) return;
    for (const figure of document.querySelectorAll("figure.chart")) {
      const name = figure.dataset.chart;
      if (name === "cells") drawRuns(figure, charts.cells ?? [], "success");
      else if (charts.runs) drawRuns(figure, charts.runs.filter((run) => run.episodes.length > 1), name);
      else drawCurve(figure, charts.curve);
    }
  }

  const sizes = new ResizeObserver((entries) => {
    for (const { target } of entries) {
      const known = plots.get(target.parentElement);
      const width = Math.max(NARROWEST, Math.floor(target.clientWidth));
      if (known && known.plot.width !== width) known.plot.setSize({ width, height: HEIGHT });
    }
  });

  // Adapts the report's height to its content, and reloads a changed report.
  const report = document.querySelector("iframe.report");
  let reported = 0, later = null;
  function fit() {
    const page = report.contentDocument?.documentElement;
    if (page) report.style.height = `${page.scrollHeight + 4}px`;
  }
  function showReport(state) {
    if (!report || report.dataset.report === state) return;
    clearTimeout(later);
    later = setTimeout(() => {
      reported = Date.now();
      report.dataset.report = state;
      report.contentWindow.location.replace(report.src);
    }, Math.max(0, reported + REPORT_REST - Date.now()));
  }
  if (report) {
    report.addEventListener("load", fit);
    new ResizeObserver(fit).observe(report.parentElement);
  }

  // Returns a key that identifies an element among its siblings: the address of its first link or picture, or null.
  const keyOf = (node) =>
    node.nodeType !== Node.ELEMENT_NODE ? null
      : node.getAttribute("href") ?? node.getAttribute("src") ?? node.querySelector("[href], [src]")?.getAttribute("href")
        ?? node.querySelector("[src]")?.getAttribute("src") ?? null;
  const alike = (a, b) => a.nodeType === b.nodeType && a.nodeName === b.nodeName && keyOf(a) === keyOf(b);

  // Makes the element `old` equal to `fresh`. Changes only the parts that differ, so that focus, clicks and playing films
  // are not disturbed.
  function become(old, fresh) {
    if (old.isEqualNode(fresh)) return;
    if (old.nodeType !== Node.ELEMENT_NODE) {
      old.data = fresh.data;
      return;
    }
    for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name)) old.removeAttribute(name);
    for (const { name, value } of fresh.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
    fill(old, fresh);
  }

  function fill(place, fresh) {
    const left = [...place.childNodes];
    for (const child of [...fresh.childNodes]) {
      const found = left.findIndex((old) => alike(old, child));
      const [old] = found < 0 ? [] : left.splice(found, 1);
      // Elements before the found one are kept if they occur later in `fresh`, otherwise removed.
      if (old && found === 0) become(old, child);
      else if (old) {
        const gone = left.splice(0, found);
        if (gone.some((one) => [...fresh.childNodes].some((later) => alike(one, later)))) {
          left.unshift(...gone);
          place.insertBefore(old, gone[0]);
        } else gone.forEach((one) => one.remove());
        become(old, child);
      } else place.insertBefore(child, left[0] ?? null);
    }
    left.forEach((old) => old.remove());
  }

  function replace(place, part) {
    const template = document.createElement("template");
    template.innerHTML = part;
    localTimes(template.content);
    const had = document.activeElement, address = had?.getAttribute("href");
    fill(place, template.content);
    if (address && document.activeElement !== had) place.querySelector(`[href="${CSS.escape(address)}"]`)?.focus();
  }

  // Shows the link to the curves of the chosen trainings if at least two trainings are chosen.
  const charted = document.getElementById("charted");
  const curves = charted?.getAttribute("href");
  function showChosen() {
    if (!charted) return;
    const most = Number(charted.dataset.most);
    const chosen = [...document.querySelectorAll("input[name=charted]:checked")].map((input) => input.value);
    charted.href = `${curves}?runs=${chosen.slice(0, most).join()}`;
    charted.textContent = chosen.length > most ? `Curves of the first ${most} chosen trainings in one chart`
      : `Curves of ${chosen.length} trainings in one chart`;
    charted.parentElement.hidden = chosen.length < 2;
  }

  function apply(update) {
    if (update.gone) return say(update.gone, "lost");
    say("live", "live");
    document.title = update.title;
    for (const [name, part] of Object.entries(update.parts)) {
      const place = document.getElementById(name);
      if (place && shown.get(name) !== part) {
        shown.set(name, part);
        replace(place, part);
      }
    }
    charts = update.charts;
    draw();
    showChosen();
    showReport(update.report);
    document.body.dataset.updates = Number(document.body.dataset.updates ?? 0) + 1;
  }

  // Hidden pages close their connection, because browsers allow only few connections to a server.
  let source = null;
  function listen() {
    if (source || document.hidden) return;
    say("connecting …", "lost");
    source = new EventSource(document.body.dataset.events);
    source.onmessage = (event) => apply(JSON.parse(event.data));
    source.onopen = () => say("live", "live");
    source.onerror = () => {
      if (source.readyState === EventSource.CLOSED) {
        source.close();
        source = null;
        say("not live: the server refuses, perhaps because too many pages are open; trying again", "lost");
        setTimeout(listen, 10_000);
      } else {
        say("not live: the connection is lost; trying again", "lost");
      }
    };
  }
  document.addEventListener("visibilitychange", () => {
    if (!document.hidden) return listen();
    source?.close();
    source = null;
  });
  for (const input of document.querySelectorAll("input[name=over]")) input.addEventListener("change", draw);
  document.addEventListener("change", showChosen);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  localTimes(document);
  listen();
})();
