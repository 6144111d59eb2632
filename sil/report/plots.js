"use strict";
// Groups of panels over one axis: a zoom, a cursor or a button in one panel acts on its group.
(function () {
  const themes = JSON.parse(document.getElementById("themes").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const PAPER_WIDTH = 680;
  let printing = false;

  function line(series, colours, dot) {
    const colour = colours[series.role];
    const made = {
      label: series.label,
      stroke: colour,
      width: series.role === "truth" || series.role === "measured" ? 2.2 : 1.5,
      dash: series.dashed ? [6, 4] : undefined,
      spanGaps: series.joined,
      points: { show: series.dotted, size: dot, fill: colour, width: 0 },
      value: (chart, value) => (value == null ? "–" : value.toPrecision(4)),
    };
    if (series.stepped) made.paths = uPlot.paths.stepped({ align: 1 });
    if (series.dotted) made.paths = () => null;
    return made;
  }

  function upright(panel, axis) {
    const space = panel.height < 150 ? 16 : 30; // or a low panel has a single number on its axis
    const made = { ...axis, size: 56, label: panel.unit, labelSize: 18, space };
    if (panel.marks.length) {
      made.splits = () => panel.marks.map((mark) => mark[0]);
      made.values = () => panel.marks.map((mark) => mark[1]);
    }
    return made;
  }

  // A line that never changes lies in the middle, and a band is always in sight.
  function tall(panel) {
    return (chart, least, most) => {
      let [low, high] = least == null ? [0, 1] : [least, most];
      if (panel.band) [low, high] = [Math.min(low, panel.band[0]), Math.max(high, panel.band[1])];
      if (low < high) return uPlot.rangeNum(low, high, 0.1, true);
      const room = Math.abs(low) / 10 || 1;
      return [low - room, high + room];
    };
  }

  function shade(panel, colours) {
    return (chart) => {
      if (!panel.band) return;
      const box = chart.bbox;
      const [a, b] = panel.band.map((value) => chart.valToPos(value, "y", true));
      const top = Math.max(box.top, Math.min(a, b));
      const end = Math.min(box.top + box.height, Math.max(a, b));
      chart.ctx.save();
      chart.ctx.fillStyle = colours.grid;
      chart.ctx.fillRect(box.left, top, box.width, Math.max(0, end - top));
      chart.ctx.restore();
    };
  }

  // Names stand under the lowest panel only, and upright where they would not fit side by side.
  function level(told, axis, last, wide) {
    const made = { ...axis, size: 26, label: undefined, labelSize: 0 };
    if (last) Object.assign(made, { size: 40, label: told.axis, labelSize: 20 });
    if (!told.names.length) return made;
    const letters = Math.max(...told.names.map((name) => name.length));
    made.splits = () => told.x;
    made.values = () => told.names.map((name) => (last ? name : ""));
    if (last && 7 * letters * told.names.length > wide) {
      made.rotate = -90;
      made.size = 20 + 7 * letters;
    }
    return made;
  }

  function group(place, number) {
    const told = JSON.parse(place.querySelector("script").textContent);
    const holder = place.querySelector(".panels");
    const known = told.x.filter((value) => value != null);
    const room = told.names.length ? 0.5 : 0;
    const whole = [known[0] - room, known[known.length - 1] + room];
    // powers and roots instead of sums and halves on a logarithmic axis
    const to = told.log ? Math.log : (value) => value;
    const from = told.log ? Math.exp : (value) => value;
    let range = whole.slice();
    let charts = [];

    function show(low, high) {
      if (!(high > low)) return;
      range = [Math.max(low, whole[0]), Math.min(high, whole[1])];
      charts.forEach((chart) => chart.setScale("x", { min: range[0], max: range[1] }));
    }

    function zoom(factor, about) {
      const [low, high] = range.map(to);
      const middle = about === undefined ? (low + high) / 2 : to(about);
      show(from(middle - factor * (middle - low)), from(middle + factor * (high - middle)));
    }

    function move(share) {
      let [low, high] = range.map(to);
      const [first, last] = whole.map(to);
      const by = Math.min(Math.max(share * (high - low), first - low), last - high);
      show(from(low + by), from(high + by));
    }

    // One finger moves along the axis, two zoom; up and down the page scrolls.
    function touch(over, chart) {
      let held = null;
      const spot = (t) => chart.posToVal(t.clientX - over.getBoundingClientRect().left, "x");
      const apart = (ts) => Math.abs(ts[0].clientX - ts[1].clientX);
      over.style.touchAction = "pan-y";
      over.addEventListener("touchstart", (event) => {
        const ts = event.touches;
        held = ts.length === 2 ? { apart: apart(ts) } : { x: ts[0].clientX };
      }, { passive: true });
      over.addEventListener("touchmove", (event) => {
        const ts = event.touches;
        if (!held) return;
        if (ts.length === 2 && held.apart) {
          event.preventDefault();
          const now = Math.max(8, apart(ts));
          zoom(held.apart / now, (spot(ts[0]) + spot(ts[1])) / 2);
          held.apart = now;
        } else if (ts.length === 1 && held.x !== undefined) {
          move((held.x - ts[0].clientX) / over.clientWidth);
          held.x = ts[0].clientX;
        }
      }, { passive: false });
      over.addEventListener("touchend", () => { held = null; });
    }

    function width() {
      return printing ? PAPER_WIDTH : Math.max(260, holder.clientWidth);
    }

    function options(panel, colours, last) {
      const axis = {
        stroke: colours.faint,
        grid: { stroke: colours.grid, width: 1 },
        ticks: { stroke: colours.grid, width: 1 },
      };
      const across = level(told, axis, last, width() - 60);
      const named = (chart, v) => {
        if (v == null) return "–";
        return told.names.length ? told.names[told.x.indexOf(v)] : v.toPrecision(5);
      };
      return {
        width: width(),
        height: panel.height + (last ? across.size - 6 : 0),
        cursor: {
          sync: { key: "opc4 " + number },
          drag: { x: true, y: false, setScale: false },
        },
        scales: {
          x: { time: false, distr: told.log ? 3 : 1, range: () => range },
          y: { range: tall(panel) },
        },
        axes: [across, upright(panel, axis)],
        series: [{ label: told.axis, value: named }]
          .concat(panel.series.map((series) => line(series, colours, told.names.length ? 10 : 4))),
        hooks: {
          drawClear: [shade(panel, colours)],
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
      const colours = themes[dark.matches && !printing ? "dark" : "light"];
      charts.forEach((chart) => chart.destroy());
      holder.replaceChildren();
      charts = told.panels.map((panel, i) => {
        const box = document.createElement("div");
        box.className = "panel";
        const title = document.createElement("h4");
        title.textContent = panel.title;
        box.appendChild(title);
        holder.appendChild(box);
        const values = [told.x].concat(panel.series.map((series) => series.y));
        const chart = new uPlot(options(panel, colours, i === told.panels.length - 1), values, box);
        chart.over.addEventListener("dblclick", () => show(whole[0], whole[1]));
        touch(chart.over, chart);
        return chart;
      });
    }

    function button(name, label, act) {
      const made = document.createElement("button");
      made.type = "button";
      made.textContent = name;
      made.setAttribute("aria-label", label);
      made.addEventListener("click", act);
      place.querySelector(".bar").appendChild(made);
    }

    button("whole", "show everything", () => show(whole[0], whole[1]));
    told.windows.forEach(([name, low, high]) => button(name, name, () => show(low, high)));
    button("+", "zoom in", () => zoom(0.5));
    button("−", "zoom out", () => zoom(2));
    button("←", "earlier", () => move(-0.5));
    button("→", "later", () => move(0.5));
    draw();
    return {
      draw,
      fit: () => charts.forEach((chart) => chart.setSize({ width: width(), height: chart.height })),
      charts: () => charts,
    };
  }

  const groups = Array.from(document.querySelectorAll(".plots"), group);
  window.opc4Plots = () => groups.map((one) => one.charts());
  const redraw = () => groups.forEach((one) => one.draw());
  dark.addEventListener("change", redraw);
  window.addEventListener("beforeprint", () => { printing = true; redraw(); });
  window.addEventListener("afterprint", () => { printing = false; redraw(); });
  let waiting = 0;
  window.addEventListener("resize", () => {
    if (printing) return;
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(() => groups.forEach((one) => one.fit()));
  });
})();
