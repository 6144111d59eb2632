"use strict";
// Panels over one axis: a zoom, a cursor or a button in one of them acts on all.
(function () {
  const told = JSON.parse(document.getElementById("plot-numbers").textContent);
  const place = document.getElementById("plots");
  const bar = place.querySelector(".bar");
  const whole = [told.x[0], told.x[told.x.length - 1]];
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  let charts = [];
  let range = whole.slice();
  let busy = false;

  function show(low, high) {
    range = [Math.max(low, whole[0]), Math.min(high, whole[1])];
    busy = true;
    charts.forEach((chart) => chart.setScale("x", { min: range[0], max: range[1] }));
    busy = false;
  }

  function zoom(factor) {
    const middle = (range[0] + range[1]) / 2;
    const half = (factor * (range[1] - range[0])) / 2;
    show(middle - half, middle + half);
  }

  function width() {
    return Math.max(260, place.clientWidth);
  }

  function line(series, colours) {
    return {
      label: series.label,
      stroke: colours[series.role],
      width: series.role === "truth" ? 2 : 1.5,
      dash: series.dashed ? [6, 4] : undefined,
      paths: series.stepped ? uPlot.paths.stepped({ align: 1 }) : undefined,
      points: { show: false },
      value: (chart, value) => (value == null ? "–" : value.toPrecision(4)),
    };
  }

  function upright(panel, axis) {
    const made = { ...axis, size: 56, label: panel.unit, labelSize: 18 };
    if (panel.marks.length) {
      made.splits = () => panel.marks.map((mark) => mark[0]);
      made.values = () => panel.marks.map((mark) => mark[1]);
    }
    return made;
  }

  function options(panel, colours, last) {
    const axis = {
      stroke: colours.faint,
      grid: { stroke: colours.grid, width: 1 },
      ticks: { stroke: colours.grid, width: 1 },
    };
    return {
      width: width(),
      height: panel.height + (last ? 30 : 0),
      cursor: { sync: { key: "opc4" }, drag: { x: true, y: false } },
      scales: { x: { time: false, range: () => range } },
      axes: [
        { ...axis, label: last ? told.axis : undefined, labelSize: last ? 24 : 0 },
        upright(panel, axis),
      ],
      series: [{ label: told.axis, value: (chart, v) => (v == null ? "–" : v.toFixed(4)) }]
        .concat(panel.series.map((series) => line(series, colours))),
      hooks: {
        setSelect: [
          (chart) => {
            const { left, width: wide } = chart.select;
            if (wide > 2) show(chart.posToVal(left, "x"), chart.posToVal(left + wide, "x"));
            chart.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          },
        ],
      },
    };
  }

  function draw() {
    const colours = told.themes[dark.matches ? "dark" : "light"];
    place.querySelectorAll(".panel").forEach((old) => old.remove());
    charts.forEach((chart) => chart.destroy());
    charts = told.panels.map((panel, i) => {
      const box = document.createElement("div");
      box.className = "panel";
      const title = document.createElement("h3");
      title.textContent = panel.title;
      box.appendChild(title);
      place.appendChild(box);
      const data = [told.x].concat(panel.series.map((series) => series.y));
      const last = i === told.panels.length - 1;
      const made = options(panel, colours, last);
      made.cursor.drag.setScale = false;
      const chart = new uPlot(made, data, box);
      chart.over.addEventListener("dblclick", () => show(whole[0], whole[1]));
      return chart;
    });
    window.opc4Plots = charts;
  }

  function button(name, act) {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = name;
    made.addEventListener("click", act);
    bar.appendChild(made);
  }

  button("whole", () => show(whole[0], whole[1]));
  told.windows.forEach(([name, low, high]) => button(name, () => show(low, high)));
  button("+", () => zoom(0.5));
  button("−", () => zoom(2));
  draw();
  dark.addEventListener("change", draw);
  let waiting = 0;
  window.addEventListener("resize", () => {
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(() =>
      charts.forEach((chart) => chart.setSize({ width: width(), height: chart.height })));
  });
})();
