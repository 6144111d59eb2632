"use strict";
// Groups of panels over one axis: a zoom, a cursor or a button in one panel acts on its group.
(function () {
  const themes = JSON.parse(document.getElementById("themes").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const PAPER_WIDTH = 680;
  let printing = false;

  const STEPPED = ["stepped", "sampled"];

  function line(series, colours, dot) {
    const colour = colours(series.role);
    const hasDots = ["dots", "marked"].includes(series.style);
    const made = {
      label: series.label,
      stroke: colour,
      width: series.width,
      dash: series.dashed ? [6, 4] : undefined,
      spanGaps: series.style === "marked",
      points: { show: hasDots, size: dot, fill: colour, width: 0 },
      value: (chart, value) => (value == null ? "–" : value.toPrecision(4)),
    };
    if (STEPPED.includes(series.style)) made.paths = uPlot.paths.stepped({ align: 1 });
    if (series.style === "dots") made.paths = () => null;
    return made;
  }

  function upright(panel, axis, size) {
    const space = panel.height < 150 ? 16 : 30; // or a low panel has a single number on its axis
    const made = { ...axis, size, label: panel.unit || undefined, labelSize: 18, space };
    if (!panel.unit) made.size += made.labelSize; // so that all panels begin at the same x
    if (panel.ticks.length) {
      made.splits = () => panel.ticks.map((tick) => tick[0]);
      made.values = () => panel.ticks.map((tick) => tick[1]);
    }
    return made;
  }

  // A line that never changes is in the middle, and what was drawn across is always visible.
  function tall(panel) {
    if (panel.limits) return () => [Math.min(...panel.limits), Math.max(...panel.limits)];
    return (chart, least, most) => {
      const known = [least, most, ...panel.include].filter((value) => value != null);
      const [low, high] = known.length ? [Math.min(...known), Math.max(...known)] : [0, 1];
      if (low < high) return uPlot.rangeNum(low, high, 0.1, true);
      const room = Math.abs(low) / 10 || 1;
      return [low - room, high + room];
    };
  }

  // Names are under the lowest panel only, and upright where they would not fit side by side.
  function level(content, axis, last, wide) {
    const made = { ...axis, size: 26, label: undefined, labelSize: 0 };
    if (last) Object.assign(made, { size: 40, label: content.axis, labelSize: 20 });
    if (!content.ticks.length) return made;
    const names = content.ticks.map((tick) => tick[1]);
    const letters = Math.max(...names.map((name) => name.length));
    made.splits = () => content.ticks.map((tick) => tick[0]);
    made.values = () => names.map((name) => (last ? name : ""));
    if (last && 7 * letters * names.length > wide) {
      made.rotate = -90;
      made.size = 20 + 7 * letters;
    }
    return made;
  }

  // What uPlot has no series for: spans and bands below the lines, rules and texts above them.
  function drawing(chart, colours, widest) {
    const { ctx, bbox } = chart;
    const ratio = uPlot.pxRatio;
    const ends = { x: [bbox.left, bbox.left + bbox.width], y: [bbox.top + bbox.height, bbox.top] };
    const at = (value, axis, end) => (value == null ? ends[axis][end] : chart.valToPos(value, axis, true));
    const font = (size, bold) => `${bold ? "bold " : ""}${size * ratio}px system-ui, sans-serif`;

    function inside(act) {
      ctx.save();
      ctx.beginPath();
      ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
      ctx.clip();
      act();
      ctx.restore();
    }

    // Whether a text lies within the panel's height and on none that was written before it.
    const taken = [];
    function isFree(words, x, y, { align = "center", base = "middle", turned = false, bold = false, size = 11 }) {
      ctx.font = font(size, bold);
      const [wide, high] = [ctx.measureText(words).width, size * ratio];
      const before = (place) => ({ left: 0, top: 0, center: 0.5, middle: 0.5, right: 1, bottom: 1 })[place];
      const box = turned // its beginning is below
        ? [x - before(base) * high, y - (1 - before(align)) * wide, high, wide]
        : [x - before(align) * wide, y - before(base) * high, wide, high];
      const [left, top, across, down] = box;
      const free = top >= bbox.top - 2 * ratio && top + down <= bbox.top + bbox.height + 2 * ratio
        && !taken.some(([l, t, a, d]) => left < l + a && l < left + across && top < t + d && t < top + down);
      if (free) taken.push(box);
      return free;
    }

    function text(words, x, y, look) {
      const { role = "ink", align = "center", base = "middle", turned = false, bold = false, size = 11, outlined = true } = look;
      ctx.save();
      ctx.translate(x, y);
      if (turned) ctx.rotate(-Math.PI / 2);
      ctx.font = font(size, bold);
      ctx.textAlign = align;
      ctx.textBaseline = base;
      if (outlined) {
        ctx.strokeStyle = colours("paper");
        ctx.lineWidth = 3 * ratio;
        ctx.strokeText(words, 0, 0);
      }
      ctx.fillStyle = colours(role);
      ctx.fillText(words, 0, 0);
      ctx.restore();
    }

    function dark(colour) {
      const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
      return 0.299 * r + 0.587 * g + 0.114 * b <= 110;
    }

    function span([start, end, low, high, role, label, style]) {
      const [first, last] = [Math.max(at(start, "x", 0), ends.x[0]), Math.min(at(end, "x", 1), ends.x[1])];
      if (last < ends.x[0] || first > ends.x[1]) return;
      const [bottom, top] = [at(low, "y", 0), at(high, "y", 1)];
      const [y, wide, deep] = [Math.min(top, bottom), Math.max(last - first, ratio), Math.abs(bottom - top)];
      ctx.fillStyle = ctx.strokeStyle = colours(role);
      ctx.globalAlpha = { solid: 1, pale: 0.35, hatched: 0.6 }[style];
      ctx.fillRect(first, y, wide, Math.max(deep, ratio));
      ctx.globalAlpha = 1;
      if (!label) return;
      ctx.font = font(11);
      const fits = ctx.measureText(label).width + 4 * ratio <= wide;
      if (!fits && (wide < 9 * ratio || ctx.measureText(label).width * 0.8 > deep)) return;
      const plain = style === "solid";
      const ink = !plain ? "ink" : dark(colours(role)) ? "#ffffff" : "#1a1a1a";
      const look = { role: ink, turned: !fits, size: fits ? 11 : 9, outlined: !plain };
      text(label, first + wide / 2, y + deep / 2, look);
    }

    function band([x, low, high, role]) {
      ctx.fillStyle = colours(role);
      ctx.globalAlpha = 0.15;
      ctx.beginPath();
      x.forEach((value, k) => ctx.lineTo(at(value, "x", 0), at(high[k], "y", 1)));
      x.map((_, k) => x.length - 1 - k).forEach((k) => ctx.lineTo(at(x[k], "x", 0), at(low[k], "y", 0)));
      ctx.fill();
      ctx.globalAlpha = 1;
    }

    function rule([value, , role, axis, style]) {
      const spot = at(value, axis, 0);
      const across = axis === "y";
      ctx.strokeStyle = colours(role);
      ctx.lineWidth = ratio;
      ctx.setLineDash({ solid: [], dashed: [6, 4], dotted: [2, 3] }[style].map((v) => v * ratio));
      ctx.beginPath();
      ctx.moveTo(across ? ends.x[0] : spot, across ? spot : ends.y[0]);
      ctx.lineTo(across ? ends.x[1] : spot, across ? spot : ends.y[1]);
      ctx.stroke();
      ctx.setLineDash([]);
    }

    function ruleText([value, words, role, axis]) {
      const spot = at(value, axis, 0);
      const look = axis === "y" ? { role, align: "left", base: "top" } : { role, base: "bottom", turned: true };
      const place = axis === "y" ? [ends.x[0] + 3 * ratio, spot + 3 * ratio] : [spot - 3 * ratio, (ends.y[0] + ends.y[1]) / 2];
      if (words && isFree(words, ...place, look)) text(words, ...place, look);
    }

    function note([x, y, words, role, align, up, bold]) {
      const aside = { left: 4, center: 0, right: -4 }[align] * ratio;
      const look = { role, align, base: up > 0 ? "bottom" : up < 0 ? "top" : "middle", bold };
      const high = 12 * ratio; // at the edge it moves into the panel
      const [highest, lowest] = { bottom: [high, 0], middle: [high / 2, high / 2], top: [0, high] }[look.base];
      const level = Math.min(Math.max(at(y, "y", 0) - up * ratio, ends.y[1] + highest), ends.y[0] - lowest);
      const place = [at(x, "x", 0) + aside, level];
      if (isFree(words, ...place, look)) text(words, ...place, look);
    }

    return {
      background: (panel) => inside(() => panel.spans.filter((s) => s[2] == null).forEach(span)),
      below: (panel) => inside(() => {
        panel.spans.filter((s) => s[2] != null).forEach(span);
        panel.bands.forEach(band);
      }),
      above: (panel) => inside(() => {
        const { min, max } = chart.scales.x;
        const shown = ([x]) => x >= min && x <= max;
        const rules = panel.rules.filter((item) => item[3] === "y" || shown(item));
        const notes = panel.notes.filter(shown);
        const room = max - min <= widest;
        rules.forEach(rule);
        if (!room) return;
        notes.forEach(note);
        rules.forEach(ruleText);
      }),
    };
  }

  // Colours that no line has: squares with their names, or a strip from low to high.
  function keys(panel, colours) {
    const made = document.createElement("p");
    made.className = "keys";
    const entries = panel.keys.map(([name, role]) => [name, colours(role)]);
    if (panel.scale) {
      const [label, low, high, strip] = panel.scale;
      entries.push([`${label}: ${low.toPrecision(3)} to ${high.toPrecision(3)}`, `linear-gradient(to right, ${strip})`]);
    }
    entries.forEach(([name, background]) => {
      const item = document.createElement("span");
      const square = document.createElement("i");
      square.style.background = background;
      item.append(square, name);
      made.appendChild(item);
    });
    return made;
  }

  // `onCursor`: the group is an instrument. Panels share the height there is, each with its name and its
  // values at the cursor on its left; the cursor stays where it was put, and a drag moves it.
  function group(place, number, content, onCursor) {
    const names = content.panels.flatMap((panel) => panel.ticks.map((tick) => tick[1].length));
    const size = onCursor ? 52 : Math.max(56, 7 * Math.max(0, ...names) + 6);
    const holder = place.querySelector(".panels");
    const whole = content.ends;
    // texts of a longer part would cover each other
    const widest = content.zooms.length ? 1.5 * Math.max(...content.zooms.map((zoom) => zoom[2] - zoom[1])) : Infinity;
    // powers and roots instead of sums and halves on a logarithmic axis
    const to = content.log ? Math.log : (value) => value;
    const from = content.log ? Math.exp : (value) => value;
    let range = whole.slice();
    let charts = [];
    let reads = []; // of each chart: (x) => writes its values
    let spot = content.ends[0];

    // After uPlot's own microtask: only then a chart that is new or zoomed knows where its values lie.
    function cursor(x) {
      spot = x;
      queueMicrotask(() => {
        const inside = spot >= range[0] && spot <= range[1];
        charts.forEach((chart) => chart.setCursor({ left: inside ? chart.valToPos(spot, "x") : -10, top: 0 }, false));
        reads.forEach((read) => read(spot));
      });
    }

    function show(low, high) {
      if (!(high > low)) return;
      range = [Math.max(low, whole[0]), Math.min(high, whole[1])];
      charts.forEach((chart) => chart.setScale("x", { min: range[0], max: range[1] }));
      if (onCursor) cursor(spot);
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
      if (onCursor) return Math.max(120, (holder.querySelector(".draws") || holder).clientWidth);
      return printing ? PAPER_WIDTH : Math.max(260, holder.clientWidth);
    }

    function heights() {
      if (!onCursor) return content.panels.map((panel) => panel.height);
      const least = content.panels.map((panel) => 10 + 16 * (panel.ticks.length || 1 + reading(panel).length));
      const sum = (values) => values.reduce((a, b) => a + b, 0);
      const rest = Math.max(0, holder.clientHeight - 26 - sum(least) - least.length) / sum(content.panels.map((panel) => panel.height));
      return content.panels.map((panel, i) => Math.floor(least[i] + rest * panel.height));
    }

    function options(panel, colours, last, height) {
      const axis = {
        stroke: colours("faint"),
        grid: { stroke: colours("grid"), width: 1 },
        ticks: { stroke: colours("grid"), width: 1 },
      };
      const across = level(content, axis, last, width() - 60);
      const up = upright(panel, axis, size);
      if (onCursor) {
        Object.assign(up, { label: undefined, size, space: 18 });
        if (panel.ticks.length) up.values = () => panel.ticks.map(() => "");
        Object.assign(across, last ? { size: 24, label: undefined } : { size: 0, values: () => [], ticks: { show: false } });
      }
      const still = Object.fromEntries(["mousedown", "mouseup", "click", "dblclick", "mousemove", "mouseleave", "mouseenter"]
        .map((name) => [name, () => null]));
      const named = (chart, v) => {
        if (v == null) return "–";
        if (!content.ticks.length) return String(Number(v.toPrecision(7)));
        // points of one choice stand next to each other, around its tick
        return content.ticks.reduce((a, b) => (Math.abs(b[0] - v) < Math.abs(a[0] - v) ? b : a))[1];
      };
      return {
        width: width(),
        height: height + across.size,
        legend: { show: !onCursor },
        padding: onCursor ? [6, 18, 6, 0] : undefined,
        cursor: onCursor ? { bind: still, y: false, points: { show: false } } : {
          sync: { key: "opc4 " + number },
          drag: { x: true, y: false, setScale: false },
        },
        scales: {
          x: { time: false, distr: content.log ? 3 : 1, range: () => range },
          y: { range: tall(panel) },
        },
        axes: [across, up],
        series: [{ label: content.axis, value: named }]
          .concat(panel.series.map((series) => line(series, colours, content.ticks.length ? 10 : 4))),
        hooks: {
          drawClear: [(chart) => drawing(chart, colours, widest).background(panel)],
          drawAxes: [(chart) => drawing(chart, colours, widest).below(panel)],
          draw: [(chart) => drawing(chart, colours, widest).above(panel)],
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
      const theme = themes[dark.matches && !printing ? "dark" : "light"];
      const colours = (role) => theme[role] || role;
      const scrolled = holder.scrollTop;
      charts.forEach((chart) => chart.destroy());
      holder.replaceChildren();
      reads = [];
      const high = heights();
      charts = content.panels.map((panel, i) => {
        const box = document.createElement("div");
        box.className = "panel";
        holder.appendChild(box);
        if (onCursor) return instrument(box, panel, colours, high[i], i === content.panels.length - 1);
        const title = document.createElement("h4");
        title.textContent = panel.title;
        box.appendChild(title);
        const values = [content.x].concat(panel.series.map((series) => series.y));
        if (panel.keys.length || panel.scale) box.appendChild(keys(panel, colours));
        const chart = new uPlot(options(panel, colours, i === content.panels.length - 1, high[i]), values, box);
        chart.root.querySelectorAll(".u-legend .u-series").forEach((row, k) => {
          if (k && !panel.series[k - 1].label) row.style.display = "none";
        });
        chart.over.addEventListener("dblclick", () => show(whole[0], whole[1]));
        touch(chart.over, chart);
        return chart;
      });
      holder.scrollTop = scrolled;
      if (onCursor) cursor(spot);
    }

    // A panel with what is read at the cursor on its left.
    function instrument(box, panel, colours, height, last) {
      const [read, draws] = [document.createElement("div"), document.createElement("div")];
      const lanes = panel.ticks.length > 0;
      [box.className, read.className, draws.className] = ["panel beside", "read", "draws"];
      box.replaceChildren(read, draws);
      const chart = new uPlot(options(panel, colours, last, height), [content.x, ...panel.series.map((series) => series.y)], draws);
      const rows = lanes ? panel.ticks.map(([lane, name]) => ({ name, lane })) : reading(panel);
      const texts = (...all) => {
        const row = document.createElement("div");
        row.append(...all.map((text) => Object.assign(document.createElement("span"), { textContent: text, title: text })));
        read.append(row);
        return row;
      };
      const both = rows.some((row) => row.before);
      read.classList.toggle("both", both);
      if (!lanes) texts(panel.unit ? `${panel.title}, ${panel.unit}` : panel.title, ...(!reads.length && both ? ["now", "before"] : [])).className = "name";
      const cells = rows.map(({ name, series }) => {
        const row = texts(name, ...(both ? ["", ""] : [""]));
        if (series) row.firstChild.prepend(Object.assign(document.createElement("i"), { style: `background:${colours(series.role)}` }));
        else row.className = "lane";
        return [...row.children];
      });
      reads.push((x) => rows.forEach(({ series, before, lane }, i) => {
        if (series) [series, before].slice(0, both ? 2 : 1).forEach((one, k) => { cells[i][1 + k].textContent = one ? figure(valueAt(one, x)) : ""; });
        else {
          cells[i][1].textContent = stateAt(panel, lane, x);
          cells[i][0].parentNode.style.top = `${chart.bbox.top / uPlot.pxRatio + chart.valToPos(lane, "y")}px`;
        }
      }));
      const set = (event) => onCursor(Math.min(Math.max(chart.posToVal(event.clientX - chart.over.getBoundingClientRect().left, "x"), range[0]), range[1]));
      chart.over.style.touchAction = "pan-y";
      chart.over.addEventListener("pointerdown", (event) => { chart.over.setPointerCapture(event.pointerId); set(event); });
      chart.over.addEventListener("pointermove", (event) => { if (event.buttons) set(event); });
      return chart;
    }

    const valueAt = (series, x) => window.opc4At(content.x, series.y, x, series.style !== "line");

    function button(name, label, act) {
      const made = document.createElement("button");
      made.type = "button";
      made.textContent = name;
      made.setAttribute("aria-label", label);
      made.addEventListener("click", act);
      place.querySelector(".bar").appendChild(made);
    }

    place.querySelector(".bar").replaceChildren();
    button("whole", "show everything", () => show(whole[0], whole[1]));
    content.zooms.forEach(([name, low, high]) => button(name, name, () => show(low, high)));
    const about = () => (onCursor && spot > range[0] && spot < range[1] ? spot : undefined);
    button("+", "zoom in", () => zoom(0.5, about()));
    button("−", "zoom out", () => zoom(2, about()));
    button("←", "earlier", () => move(-0.5));
    button("→", "later", () => move(0.5));
    if (onCursor) place.querySelector(".bar").append(Object.assign(document.createElement("span"), { textContent: content.axis, className: "faint" }));
    draw();
    return {
      draw,
      fit: () => onCursor ? draw() : charts.forEach((chart) => chart.setSize({ width: width(), height: chart.height })),
      charts: () => charts,
      range: () => (range[0] > whole[0] || range[1] < whole[1] ? range : null),
      show,
      cursor,
    };
  }

  // The lines that are read at the cursor, each with the one of the run before.
  function reading(panel) {
    const named = panel.series.filter((series) => series.label && !series.label.endsWith(", before"));
    return named.map((series) => ({ name: series.label, series,
      before: panel.series.find((other) => other.label === `${series.label}, before`) }));
  }

  function stateAt(panel, lane, x) {
    const there = panel.spans.find(([from, to, low, high]) => x >= (from ?? -Infinity) && x < (to ?? Infinity)
      && lane >= (low ?? -Infinity) && lane <= (high ?? Infinity));
    return there ? there[5] || "on" : "–";
  }

  const figure = (value) => (value == null ? "–" : value.toFixed(Math.abs(value) < 99.5 ? 2 : 0));

  // A line's value at x; a stepped one holds until its next point.
  window.opc4At = (xs, ys, x, stepped) => {
    let [low, high] = [0, xs.length - 1];
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (xs[middle] <= x + 1e-9) low = middle;
      else high = middle - 1;
    }
    const [here, next] = [ys[low], ys[low + 1]];
    if (stepped || here == null || next == null) return here;
    return here + Math.min(1, Math.max(0, (x - xs[low]) / (xs[low + 1] - xs[low]))) * (next - here);
  };

  const groups = new Map();
  document.querySelectorAll(".plots").forEach((place, number) => {
    const stored = place.querySelector("script");
    if (stored) groups.set(place, group(place, number, JSON.parse(stored.textContent)));
  });
  window.opc4Plots = () => Array.from(groups.values(), (one) => one.charts());
  // Draws other content in a group as an instrument; the part of the axis that was shown stays.
  window.opc4Draw = (place, content, onCursor) => {
    const before = groups.get(place);
    const shown = before && before.range();
    if (before) before.charts().forEach((chart) => chart.destroy());
    const made = group(place, `live ${Array.from(document.querySelectorAll(".plots")).indexOf(place)}`, content, onCursor);
    groups.set(place, made);
    if (shown) made.show(...shown);
    return made;
  };
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
