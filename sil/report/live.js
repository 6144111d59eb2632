"use strict";
// The live bench. All that is shown follows from `state`, which is in the address: a reload, a second
// tab or a restarted server gives the same picture.
(function () {
  const $ = (id) => document.getElementById(id);
  const TABS = ["shift", "whatif", "bus", "runs"];
  const EMPTY = { tab: "shift", scenario: "full_shift", settings: {}, requests: null, faults: {}, duration_s: null, before: null };
  const AFTER_REQUEST_S = 0.7;
  const SHOWN_FRAMES = 250;
  const themes = JSON.parse($("themes").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const colour = (role) => themes[dark.matches ? "dark" : "light"][role];
  let state = { ...EMPTY };
  let offered = null; // what the server offers
  let values = null; // sliders and choices of the scenario as it is now
  let run = null; // the run of the tabs Shift and Bus
  let drawn = null; // its plots
  let now = 0; // ms of simulated time
  let playing = 0; // wall clock of the last picture, 0: paused
  let heard = null; // frames of another process's run
  let socket = null;

  // --- server ------------------------------------------------------------------------------------
  async function ask(path, body) {
    const how = body === undefined ? {} : { method: "POST", body: JSON.stringify(body) };
    let answer;
    try {
      answer = await fetch(path, how);
    } catch {
      throw new Error("the server does not answer; start opc4 live again and open its address");
    }
    const text = await answer.text();
    let found;
    try {
      found = JSON.parse(text);
    } catch {
      throw new Error(text.trim());
    }
    if (!answer.ok) throw new Error(found.error);
    return found;
  }

  function guarded(act) {
    return async (...given) => {
      try {
        await act(...given);
        $("error").textContent = "";
      } catch (error) {
        $("error").textContent = error.message;
      }
    };
  }

  // While one call is under way only the newest of those that follow is made.
  function latest(act) {
    let busy = false;
    let next = null;
    return async function call(...given) {
      if (busy) {
        next = given;
        return;
      }
      busy = true;
      try {
        await act(...given);
      } finally {
        busy = false;
        if (next) {
          const waiting = next;
          next = null;
          call(...waiting);
        }
      }
    };
  }

  function asked(settings = state.settings) {
    const { scenario, requests, faults, duration_s } = state;
    return { scenario, settings, requests, faults, duration_s };
  }

  // --- state ---------------------------------------------------------------------------------------
  function stored() {
    history.replaceState(null, "", "#" + encodeURIComponent(JSON.stringify(state)));
  }

  function restored() {
    try {
      const found = JSON.parse(decodeURIComponent(location.hash.slice(1)));
      state = { ...EMPTY, ...found };
    } catch {
      state = { ...EMPTY };
    }
    if (!TABS.includes(state.tab)) state.tab = "shift";
    if (!offered.scenarios.includes(state.scenario)) state = { ...EMPTY, tab: state.tab };
  }

  function set(path, value, original) {
    const settings = { ...state.settings };
    if (value === original) delete settings[path];
    else settings[path] = value;
    state.settings = settings;
  }

  // --- all tabs ------------------------------------------------------------------------------------
  const refresh = latest(guarded(async (moved) => {
    stored();
    if (state.tab === "runs") return list();
    if (state.tab === "whatif") {
      const before = asked(state.before || {});
      const found = await ask("/api/compare", [before, asked()]);
      window.opc4Draw($("whatif-plots"), found.plots);
      metrics(found.metrics);
      again(found);
      if (moved) requestAnimationFrame(() => window.opc4Latency.push(performance.now() - moved));
      return undefined;
    }
    const before = run;
    run = await ask("/api/run", asked());
    if (!before || before.name !== run.name) now = 0;
    $("time").max = run.duration_ms;
    now = Math.min(now, run.duration_ms);
    drawn = window.opc4Draw($("shift-plots"), run.plots);
    const names = [...new Set(run.frames.map((frame) => frame[3]))].filter(Boolean).sort();
    choices($("only"), [["", "all messages"], ...names.map((name) => [name, name])], $("only").value);
    again(run);
    picture();
    requestAnimationFrame(picture); // with the plots' axes
    return undefined;
  }));
  window.opc4Latency = []; // ms from a slider's movement to the curves on the screen

  function again(found) {
    $("trace").textContent = found.trace_sha256;
    $("copy-command").disabled = !found.command;
    $("copy-command").title = found.command || "requests or faults were changed: copy it as a scenario";
    $("copy-command").dataset.text = found.command;
    $("copy-scenario").dataset.text = found.toml;
  }

  const refill = guarded(async () => {
    const own = await ask("/api/values", { ...asked({}), requests: null, faults: {}, duration_s: null });
    values = own;
    choices($("scenario"), offered.scenarios.map((name) => [name, name]), state.scenario);
    choices($("strategy"), offered.strategies.map((name) => [name, name]), chosen("controller.strategy", own.strategy));
    $("damper").value = chosen("plant.damper", own.damper);
    $("filter").checked = chosen("controller.filter", own.filter);
    sliders();
    faultForm();
    faultList();
  });

  const chosen = (path, own) => (path in state.settings ? state.settings[path] : own);

  function choices(select, pairs, value) {
    select.replaceChildren(...pairs.map(([key, name]) => new Option(name, key)));
    select.value = pairs.some(([key]) => key === value) ? value : pairs[0][0];
  }

  function show(tab) {
    state.tab = tab;
    TABS.forEach((name) => {
      const open = name === tab;
      $(name).hidden = !open;
      $("tab-" + name).setAttribute("aria-selected", open);
      $("tab-" + name).tabIndex = open ? 0 : -1;
    });
    pause();
    refresh();
  }

  // --- shift ---------------------------------------------------------------------------------------
  function at(column) {
    const times = run.trace.time_ms;
    let low = 0;
    let high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= now + 1e-9) low = middle;
      else high = middle - 1;
    }
    const values = run.trace[column];
    if (low + 1 >= times.length || column.startsWith("estimate") || /^(coil|valve)/.test(column)) return values[low];
    const share = (now - times[low]) / (times[low + 1] - times[low]);
    return values[low] + Math.min(1, Math.max(0, share)) * (values[low + 1] - values[low]);
  }

  const box = (x, y, width, height, fill, more = "") =>
    `<rect x="${x.toFixed(2)}" y="${y}" width="${Math.max(0, width).toFixed(2)}" height="${height}" fill="${fill}" ${more}/>`;
  const words = (x, y, text, more = "") => `<text x="${x.toFixed(1)}" y="${y}" text-anchor="middle" ${more}>${text}</text>`;

  function actuator() {
    const scale = 105 / run.stroke_mm;
    const [left, right, thick, top, deep] = [175, 625, 14, 120, 90];
    const stay = at("stay_mm") * scale;
    const one = left + at("piston_1_mm") * scale;
    const two = right - at("piston_2_mm") * scale;
    const free = run.free_mm * scale;
    const parts = [];
    const chambers = { B: [60, one], N: [one + thick, two - thick], F: [two, 740] };
    for (const [name, [from, to]] of Object.entries(chambers)) {
      const bar = at(`pressure_${name}_bar`);
      parts.push(box(from, top, to - from, deep, colour(name), `fill-opacity="${Math.min(0.9, Math.max(0.05, bar / run.supply_bar)).toFixed(3)}"`));
      const coil = at(`coil_${name}`) > 0;
      const open = at(`valve_${name}`);
      const middle = { B: 130, N: 400, F: 670 }[name];
      parts.push(words(middle, top + deep + 20, `${name} ${bar.toFixed(1)} bar`));
      parts.push(box(middle - 60, 248, 56, 18, coil ? colour("alarm") : "none", `stroke="${colour("faint")}"`));
      parts.push(words(middle - 32, 282, coil ? "coil on" : "coil off", 'class="faint"'));
      parts.push(box(middle + 4, 248, 56, 18, colour(name), `fill-opacity="${open.toFixed(2)}" stroke="${colour("faint")}"`));
      parts.push(words(middle + 32, 282, open > 0.5 ? "open" : "closed", 'class="faint"'));
    }
    parts.push(box(60, top, 680, deep, "none", `stroke="${colour("ink")}" stroke-width="2"`));
    parts.push(box(left + stay - 10, top + deep / 2 - 5, right - left + 20, 10, colour("faint"))); // the stay
    for (const [x, width] of [[left + stay - 10, 10], [left + stay + free + thick, 8], [right + stay, 10], [right + stay - free - thick - 8, 8]])
      parts.push(box(x, top + deep / 2 - 20, width, 40, colour("faint"))); // nuts and collars
    parts.push(box(one, top + 2, thick, deep - 4, colour("ink")), box(two - thick, top + 2, thick, deep - 4, colour("ink")));
    for (const [name, mm] of [["forward", -run.stroke_mm], ["neutral", 0], ["backward", run.stroke_mm]]) {
      const x = 400 + mm * scale;
      parts.push(`<line x1="${x}" x2="${x}" y1="26" y2="98" stroke="${colour("grid")}" stroke-width="2"/>`, words(x, 18, name, 'class="faint"'));
    }
    parts.push(words(110, 50, "true position"), `<circle cx="${(400 + stay).toFixed(2)}" cy="46" r="12" fill="${colour("truth")}"/>`);
    const estimate = at("estimate_mm");
    parts.push(words(110, 88, "controller's estimate"));
    if (estimate != null) parts.push(`<circle cx="${(400 + estimate * scale).toFixed(2)}" cy="84" r="12" fill="${colour("estimate")}"/>`);
    $("actuator").innerHTML = parts.join("");
    const late = estimate == null ? "unknown" : `${estimate.toFixed(2)} mm`;
    const text = `true position ${at("stay_mm").toFixed(2)} mm, controller's estimate ${late}`;
    $("readout").textContent = text;
    if (!playing) $("actuator").setAttribute("aria-label", `At ${now.toFixed(1)} ms: ${text}`);
  }

  function picture() {
    if (!run) return;
    $("time").value = now;
    $("clock").textContent = `${now.toFixed(1)} of ${run.duration_ms.toFixed(0)} ms`;
    if (state.tab === "shift") {
      actuator();
      if (drawn) drawn.charts().forEach((chart) => chart.setCursor({ left: chart.valToPos(now, "x"), top: 0 }, false));
    }
    if (state.tab === "bus") frames();
  }

  function turn(at) {
    if (!playing) return;
    now += (at - playing) * Number($("speed").value);
    playing = at;
    if (now >= run.duration_ms) {
      now = run.duration_ms;
      pause();
    }
    picture();
    requestAnimationFrame(turn);
  }

  function pause() {
    playing = 0;
    $("play").textContent = "Play";
  }

  function play() {
    if (playing || !run) return pause();
    if (now >= run.duration_ms) now = 0;
    playing = performance.now();
    $("play").textContent = "Pause";
    requestAnimationFrame(turn);
    return undefined;
  }

  function move(to) {
    pause();
    now = Math.min(Math.max(0, to), run ? run.duration_ms : 0);
    picture();
  }

  function request(gear) {
    if (!run) return;
    const at_s = Math.round(now * 10) / 1e4;
    const earlier = run.requests.filter((one) => one.at_s < at_s);
    state.requests = [...earlier, { at_s, gear }];
    state.duration_s = Math.min(offered.longest_s, Number((at_s + AFTER_REQUEST_S).toFixed(4)));
    refresh();
  }

  // --- what if -------------------------------------------------------------------------------------
  function sliders() {
    $("sliders").replaceChildren(...values.sliders.map(([path, name, low, high, factor, unit, own]) => {
      const label = document.createElement("label");
      const title = document.createElement("span");
      title.textContent = name;
      const shown = document.createElement("output");
      const slider = document.createElement("input");
      const [least, most] = [Math.min(low, own), Math.max(high, own)];
      Object.assign(slider, { type: "range", min: 0, max: 1000, step: 1 });
      slider.dataset.path = path;
      const where = (value) => (1000 * (value - least)) / (most - least);
      const value = () => {
        if (Math.abs(slider.value - Math.round(where(own))) < 0.5) return own;
        return Number((least + (slider.value / 1000) * (most - least)).toPrecision(4));
      };
      const write = (is) => {
        shown.textContent = `${Number((is * factor).toPrecision(4))} ${unit}`;
        slider.setAttribute("aria-valuetext", shown.textContent);
        title.className = path in state.settings ? "changed" : "";
      };
      slider.value = where(chosen(path, own));
      write(chosen(path, own));
      slider.addEventListener("input", () => {
        set(path, value(), own);
        write(value());
        refresh(performance.now());
      });
      label.append(title, shown, slider);
      return label;
    }));
  }

  function metrics(rows) {
    const text = (value, unit) => (value == null ? "never" : `${Number(value.toPrecision(4))} ${unit}`);
    $("metrics").tBodies[0].replaceChildren(...rows.map(([name, unit, before, after]) => {
      const row = document.createElement("tr");
      [name, text(before, unit), text(after, unit)].forEach((content, i) => {
        const cell = row.insertCell();
        cell.textContent = content;
        if (i) cell.className = "n";
      });
      return row;
    }));
  }

  // --- bus -----------------------------------------------------------------------------------------
  function frames() {
    const all = heard || (run ? run.frames.filter((frame) => frame[1] <= now + 1e-9) : []);
    const only = $("only").value;
    const chosenFrames = only ? all.filter((frame) => frame[3] === only) : all;
    $("frames-of").textContent = heard ? `of ${$("channel").value}` : `until ${now.toFixed(1)} ms`;
    const rows = chosenFrames.slice(-SHOWN_FRAMES).reverse();
    $("frames").tBodies[0].replaceChildren(...rows.map(([, at, ...rest]) => {
      const row = document.createElement("tr");
      [at.toFixed(3), ...rest].forEach((text, i) => {
        const cell = row.insertCell();
        cell.textContent = text;
        if (!i) cell.className = "n";
      });
      return row;
    }));
    const load = heard || !run ? "" : `, bus ${(100 * run.bus_load).toFixed(1)} % loaded over the run`;
    $("load").textContent = `${chosenFrames.length} frames${load}`;
  }

  // A form made from the schema of the fault: every fault of a scenario, with its limits.
  function faultForm() {
    const form = $("fault");
    const kinds = Object.entries(offered.faults).flatMap(([table, list]) => list.flatMap((schema) =>
      schema.properties.kind.enum.map((kind) => ({ table, schema, kind }))));
    const select = document.createElement("select");
    kinds.forEach(({ table, kind }, i) => select.add(new Option(`${table.replace("_fault", "").replace("fault", "bus")}: ${kind}`, i)));
    const fields = document.createElement("div");
    const about = document.createElement("p");
    about.className = "faint";
    const add = document.createElement("button");
    add.type = "button";
    add.textContent = "Break it at the time shown";
    const fill = () => {
      const { schema } = kinds[select.value];
      about.textContent = (schema.description || "").split("\n")[0];
      fields.replaceChildren(...Object.entries(schema.properties)
        .filter(([name]) => !["kind", "start_s"].includes(name))
        .map(([name, kind]) => field(name, kind, (schema.required || []).includes(name))));
    };
    select.addEventListener("change", fill);
    add.addEventListener("click", guarded(async () => {
      const { table, kind } = kinds[select.value];
      const made = { kind, start_s: Math.round(now * 10) / 1e4 };
      fields.querySelectorAll("[name]").forEach((input) => {
        if (input.value !== "") made[input.name] = input.dataset.number ? Number(input.value) : input.value;
      });
      const faults = { ...state.faults, [table]: [...(state.faults[table] || []), made] };
      await ask("/api/values", { ...asked(), faults }); // refused with its line before it is added
      state.faults = faults;
      faultList();
      refresh();
    }));
    const label = document.createElement("label");
    label.append("Fault ", select);
    form.replaceChildren(label, about, fields, add);
    fill();
  }

  function field(name, kind, required) {
    const label = document.createElement("label");
    const plain = kind.anyOf ? kind.anyOf.find((one) => one.type !== "null") : kind;
    let input;
    if (plain.enum) {
      input = document.createElement("select");
      if (!required) input.add(new Option("", ""));
      plain.enum.forEach((value) => input.add(new Option(value, value)));
    } else {
      input = document.createElement("input");
      if (plain.type !== "string") input.dataset.number = "yes"; // 0x... is one too
      input.size = 12;
      input.required = required;
      if (kind.default != null) input.value = kind.default;
    }
    input.name = name;
    label.append(`${name} `, input);
    return label;
  }

  function faultList() {
    $("faults").replaceChildren(...Object.entries(state.faults).flatMap(([table, list]) => list.map((fault, i) => {
      const item = document.createElement("li");
      const { kind, start_s, ...rest } = fault;
      const more = Object.entries(rest).map(([name, value]) => `${name} ${value}`).join(", ");
      const remove = document.createElement("button");
      remove.type = "button";
      remove.textContent = "remove";
      remove.setAttribute("aria-label", `remove ${kind}`);
      remove.addEventListener("click", () => {
        state.faults = { ...state.faults, [table]: list.filter((_, k) => k !== i) };
        faultList();
        refresh();
      });
      item.append(`${table} ${kind} from ${start_s} s${more ? ", " + more : ""} `, remove);
      return item;
    })));
  }

  function listen() {
    if (socket) {
      socket.close();
      return;
    }
    heard = [];
    socket = new WebSocket(`ws://${location.host}/bus`);
    socket.addEventListener("open", () => socket.send($("channel").value));
    socket.addEventListener("message", (event) => {
      const { frames: more, end } = JSON.parse(event.data);
      heard = heard.concat(more || []).slice(-20000);
      $("heard").textContent = end || `${heard.length} frames heard`;
      frames();
      if (end) socket.close();
    });
    socket.addEventListener("close", () => {
      socket = null;
      $("listen").textContent = "Listen";
    });
    $("listen").textContent = "Stop";
    $("heard").textContent = "waiting";
  }

  // --- runs ----------------------------------------------------------------------------------------
  const picked = new Set();
  let listed = "";

  async function list() {
    const found = await ask("/api/runs");
    const studies = new Set(found.filter((entry) => entry.kind === "study").map((entry) => entry.name));
    const working = found.find((entry) => picked.has(entry.name) && entry.kind === "study" && entry.state !== "complete");
    if (working) window.opc4Draw($("runs-plots"), await ask("/api/runs", [...picked]));
    const text = JSON.stringify(found);
    if (text === listed) return; // the rows stay, and with them what has the focus
    listed = text;
    const figure = (value, factor) => (value == null ? "" : Number((value * factor).toPrecision(4)));
    $("listed").tBodies[0].replaceChildren(...found.map((entry) => {
      const row = document.createElement("tr");
      const tick = document.createElement("input");
      Object.assign(tick, { type: "checkbox", checked: picked.has(entry.name), disabled: !entry.trace });
      tick.setAttribute("aria-label", `compare ${entry.name}`);
      tick.addEventListener("change", guarded(async () => {
        if (!tick.checked) picked.delete(entry.name);
        else {
          if (entry.kind === "study") picked.clear(); // alone, as far as it is
          picked.forEach((name) => { if (studies.has(name)) picked.delete(name); });
          picked.add(entry.name);
        }
        if (picked.size) window.opc4Draw($("runs-plots"), await ask("/api/runs", [...picked]));
      }));
      row.insertCell().append(tick);
      const name = document.createElement(entry.page ? "a" : "span");
      name.textContent = entry.name;
      if (entry.page) name.href = `/runs/${encodeURIComponent(entry.name)}/report.html`;
      row.insertCell().append(name);
      const figures = entry.figures || {};
      [entry.kind, entry.rows == null ? entry.state : `${entry.rows} rows, ${entry.state}`,
        figure(figures.shift_time_s, 1e3), figure(figures.impact_speed_m_s, 1)].forEach((text, i) => {
        const cell = row.insertCell();
        cell.textContent = text;
        if (i > 1) cell.className = "n";
      });
      return row;
    }));
    if (!found.length) $("listed").tBodies[0].insertRow().insertCell().textContent = "nothing yet";
  }

  // --- start ---------------------------------------------------------------------------------------
  const on = (id, event, act) => $(id).addEventListener(event, act);
  TABS.forEach((name, i) => {
    on("tab-" + name, "click", () => show(name));
    on("tab-" + name, "keydown", (event) => {
      const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
      if (!by) return;
      const next = TABS[(i + by + TABS.length) % TABS.length];
      $("tab-" + next).focus();
      show(next);
    });
  });
  document.querySelectorAll(".gear").forEach((button) => button.addEventListener("click", () => request(button.dataset.gear)));
  on("play", "click", play);
  on("back", "click", () => move(now - run.tick_ms));
  on("step", "click", () => move(now + run.tick_ms));
  on("time", "input", () => move(Number($("time").value)));
  on("by-hand", "click", () => {
    Object.assign(state, { requests: [], duration_s: AFTER_REQUEST_S });
    now = 0;
    refresh();
  });
  on("only", "change", frames);
  on("listen", "click", listen);
  on("scenario", "change", () => {
    state = { ...EMPTY, tab: state.tab, scenario: $("scenario").value };
    refill().then(refresh);
  });
  on("strategy", "change", () => { set("controller.strategy", $("strategy").value, values.strategy); refresh(); });
  on("damper", "change", () => { set("plant.damper", $("damper").value, values.damper); refresh(); });
  on("filter", "change", () => { set("controller.filter", $("filter").checked, values.filter); refresh(performance.now()); });
  on("reset", "click", () => {
    state = { ...EMPTY, tab: state.tab, scenario: state.scenario };
    refill().then(refresh);
  });
  on("keep", "click", () => { state.before = { ...state.settings }; refresh(); });
  on("keep-shipped", "click", () => { state.before = null; refresh(); });
  ["copy-command", "copy-scenario"].forEach((id) => on(id, "click", guarded(async () => {
    await navigator.clipboard.writeText($(id).dataset.text);
    $("copied").textContent = "copied";
    setTimeout(() => { $("copied").textContent = ""; }, 2000);
  })));
  dark.addEventListener("change", picture);
  window.addEventListener("hashchange", () => { restored(); refill().then(() => show(state.tab)); });
  setInterval(() => { if (state.tab === "runs") guarded(list)(); }, 2000);
  guarded(async () => {
    offered = await ask("/api/vocabulary");
    restored();
    if (location.search) history.replaceState(null, "", location.pathname + location.hash); // the token
    await refill();
    show(state.tab);
  })();
})();
