"use strict";
// The live bench. All that is shown follows from `state`, which is in the address: a reload, a second
// tab or a restarted server gives the same picture.
(function () {
  const $ = (id) => document.getElementById(id);
  const make = (tag, properties = {}, ...inside) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...inside);
    return made;
  };
  const button = (text, act, properties = {}) => make("button", { type: "button", textContent: text, onclick: act, ...properties });
  const TABS = ["shift", "bus", "runs"];
  const EMPTY = { tab: "shift", scenario: "full_shift", settings: {}, requests: null, faults: {}, duration_s: null, before: null };
  const AFTER_REQUEST_S = 0.7;
  const themes = JSON.parse($("themes").textContent);
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const colour = (role) => themes[dark.matches ? "dark" : "light"][role];
  let state = { ...EMPTY };
  let offered = null; // what the server offers
  let values = null; // the scenario's own values
  let run = null; // the run shown
  let bus = null; // its frames
  let now = 0; // ms of simulated time: the cursor
  let playing = 0; // wall clock of the last picture, 0: paused
  let heard = null; // frames of another process's run
  let socket = null;
  const drawn = {}; // plots by tab

  // --- server ------------------------------------------------------------------------------------
  let waiting = 0; // looks every two seconds whether the server answers again

  async function ask(path, body) {
    const how = body === undefined ? {} : { method: "POST", body: JSON.stringify(body) };
    const answer = await fetch(path, how).catch(() => null);
    if (!answer || answer.status === 403) waiting = waiting || setInterval(again, 2000);
    if (!answer) throw new Error(`The server does not answer. This page goes on when it does: opc4 live --port ${location.port}`);
    if (answer.status === 403) throw new Error("opc4 live was started again. Open the address that it printed; this page then goes on too.");
    const content = await answer.json().catch(() => ({ error: `the server answered ${answer.status}` }));
    if (!answer.ok) throw new Error(content.error);
    return content;
  }

  const again = guarded(async () => {
    const before = offered.started;
    offered = await ask("/api/vocabulary");
    clearInterval(waiting);
    waiting = 0;
    note(offered.started === before ? "The server answers again." : "opc4 live was started again; the values are those of before, computed anew.");
    await refill();
    refresh();
  });

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

  let fading = 0;
  function note(text) {
    $("note").textContent = text;
    clearTimeout(fading);
    fading = setTimeout(() => { $("note").textContent = ""; }, 12000);
  }

  // While one call is under way only the newest of those that follow is made.
  function latest(act) {
    let [busy, next] = [false, null];
    return async (...given) => {
      next = given;
      if (busy) return;
      for (busy = true; next;) {
        const taken = next;
        next = null;
        await act(...taken);
      }
      busy = false;
    };
  }

  function asked(settings = state.settings) {
    const { scenario, requests, faults, duration_s } = state;
    return { scenario, settings, requests, faults, duration_s };
  }

  // --- state ---------------------------------------------------------------------------------------
  function restored() {
    state = { ...EMPTY };
    try {
      Object.assign(state, JSON.parse(decodeURIComponent(location.hash.slice(1))));
    } catch { /* none, or not one of ours */ }
    if (!TABS.includes(state.tab)) state.tab = "shift";
    if (!offered.scenarios.includes(state.scenario)) state = { ...EMPTY, tab: state.tab };
  }

  function set(path, value, original) {
    const { [path]: _, ...settings } = state.settings;
    state.settings = value === original ? settings : { ...settings, [path]: value };
  }

  const chosen = (path, original) => (path in state.settings ? state.settings[path] : original);

  function changed(parts) { // another scenario, or none of the changes
    state = { ...EMPTY, tab: state.tab, ...parts };
    refill().then(refresh);
  }

  // --- all tabs ------------------------------------------------------------------------------------
  const refresh = latest(guarded(async (moved) => {
    history.replaceState(null, "", "#" + encodeURIComponent(JSON.stringify(state)));
    if (state.tab === "runs") return list();
    if (state.tab === "bus") {
      if (!socket) heard = null;
      bus = await ask("/api/frames", asked());
      drawn.bus = window.opc4Draw($("bus-plots"), bus.plots, move);
      const names = [...new Set(bus.frames.map((frame) => frame[3]))].filter(Boolean).sort();
      choices($("only"), [["", "all messages"], ...names.map((name) => [name, name])], $("only").value);
      if (!$("fault").children.length) faultForm(names);
    }
    const before = run;
    run = await ask("/api/compare", [asked(state.before || {}), asked()]);
    if (!before || before.name !== run.name) now = run.requests.length ? 1e3 * run.requests[0].at_s : 0;
    now = Math.min(now, run.duration_ms);
    if (state.tab === "shift") drawn.shift = window.opc4Draw($("shift-plots"), run.plots, move);
    metrics(run.metrics);
    $("trace").textContent = run.trace_sha256;
    $("copy-command").disabled = !run.command;
    $("copy-command").title = run.command || "requests or faults were changed: copy it as a scenario";
    $("copy-command").dataset.text = run.command;
    $("copy-scenario").dataset.text = run.toml;
    picture();
    if (moved) requestAnimationFrame(() => window.opc4Latency.push(performance.now() - moved));
    return undefined;
  }));
  window.opc4Latency = []; // ms from a slider's movement to the curves on the screen

  const refill = guarded(async () => {
    values = await ask("/api/values", { ...asked(), requests: null, faults: {}, duration_s: null });
    const refused = Object.entries(values.reset); // by then another value may have been moved: only these go
    refused.forEach(([path]) => set(path));
    if (refused.length) note(`Reset, because ${state.scenario} does not take it: ${refused.map(([, why]) => why).join("; ")}`);
    choices($("scenario"), offered.scenarios.map((name) => [name, name]), state.scenario);
    choices($("strategy"), offered.strategies.map((name) => [name, name]), chosen("controller.strategy", values.strategy));
    $("damper").value = chosen("plant.damper", values.damper);
    $("filter").checked = chosen("controller.filter", values.filter);
    $("sliders").replaceChildren(...values.sliders.map(slider));
    $("fault").replaceChildren();
    faultList();
  });

  function choices(select, pairs, value) {
    select.replaceChildren(...pairs.map(([key, name]) => new Option(name, key)));
    select.value = pairs.some(([key]) => key === value) ? value : pairs[0][0];
  }

  const row = (texts, isNumber) => make("tr", {}, ...texts.map((text, i) => make("td", { className: isNumber(i) ? "n" : "" }, text)));

  function show(tab) {
    state.tab = tab;
    TABS.forEach((name) => {
      $(name).hidden = name !== tab;
      $("tab-" + name).setAttribute("aria-selected", name === tab);
      $("tab-" + name).tabIndex = name === tab ? 0 : -1;
    });
    if (tab !== "runs") $(tab + "-plots").before($("transport")); // one playback for both
    pause();
    refresh();
  }

  // --- shift ---------------------------------------------------------------------------------------
  const at = (column) => window.opc4At(run.time_ms, run.trace[column], now, /^(estimate|coil|valve)/.test(column));
  const box = (x, y, width, height, fill, more = "") =>
    `<rect x="${x.toFixed(2)}" y="${y}" width="${Math.max(0, width).toFixed(2)}" height="${height}" fill="${fill}" ${more}/>`;
  const words = (x, y, text, more = "") => `<text x="${x.toFixed(1)}" y="${y}" text-anchor="middle" ${more}>${text}</text>`;
  const dot = (x, y, role) => `<circle cx="${x.toFixed(2)}" cy="${y}" r="6" fill="${colour(role)}"/>`;

  function actuator() {
    const scale = 90 / run.stroke_mm;
    const [middle, left, right, thick, top, deep] = [350, 160, 540, 11, 44, 46];
    const [stay, free, estimate] = [at("stay") * scale, run.free_mm * scale, at("estimate")];
    const [one, two] = [left + at("piston_1") * scale, right - at("piston_2") * scale];
    const edge = `stroke="${colour("faint")}"`;
    const parts = [];
    for (const [name, from, to, x] of [["B", 50, one, 110], ["N", one + thick, two - thick, 335], ["F", two, 650, 560]]) {
      const [bar, coil, open] = [at(`pressure_${name}`), at(`coil_${name}`) > 0, at(`valve_${name}`)];
      parts.push(box(from, top, to - from, deep, colour(name), `fill-opacity="${Math.min(0.9, Math.max(0.05, bar / run.supply_bar)).toFixed(3)}"`),
        words(x - 35, 110, `${name} ${bar.toFixed(1)} bar`),
        box(x, 100, 11, 11, coil ? colour("alarm") : "none", edge), words(x + 28, 110, "coil", 'class="faint"'),
        box(x + 48, 100, 11, 11, colour(name), `fill-opacity="${open.toFixed(2)}" ${edge}`), words(x + 80, 110, "valve", 'class="faint"'));
    }
    parts.push(box(50, top, 600, deep, "none", `stroke="${colour("ink")}" stroke-width="2"`),
      box(left + stay - 10, top + deep / 2 - 3, right - left + 20, 6, colour("faint"))); // the stay
    for (const [x, width] of [[left + stay - 10, 10], [left + stay + free + thick, 7], [right + stay, 10], [right + stay - free - thick - 7, 7]])
      parts.push(box(x, top + deep / 2 - 12, width, 24, colour("faint"))); // nuts and collars
    parts.push(box(one, top + 1, thick, deep - 2, colour("ink")), box(two - thick, top + 1, thick, deep - 2, colour("ink")));
    for (const [name, side] of [["forward", -90], ["neutral", 0], ["backward", 90]])
      parts.push(`<line x1="${middle + side}" x2="${middle + side}" y1="14" y2="40" stroke="${colour("grid")}" stroke-width="2"/>`, words(middle + side, 11, name, 'class="faint"'));
    parts.push(words(140, 24, "true position"), words(140, 38, "controller's estimate"), dot(middle + stay, 20, "truth"));
    if (estimate != null) parts.push(dot(middle + estimate * scale, 34, "estimate"));
    $("actuator").innerHTML = parts.join("");
    const late = estimate == null ? "unknown" : `${estimate.toFixed(2)} mm`;
    if (!playing) $("actuator").setAttribute("aria-label", `At ${now.toFixed(1)} ms: true position ${at("stay").toFixed(2)} mm, controller's estimate ${late}`);
  }

  function picture() {
    if (!run) return;
    $("clock").textContent = `${now.toFixed(1)} ms`;
    if (state.tab === "shift") actuator();
    if (state.tab === "bus") frames();
    if (state.tab !== "runs" && drawn[state.tab]) drawn[state.tab].cursor(now);
  }

  function turn(at) {
    if (!playing) return;
    now = Math.min(run.duration_ms, now + (at - playing) * Number($("speed").value));
    playing = at;
    if (now >= run.duration_ms) pause();
    picture();
    requestAnimationFrame(turn);
  }

  function pause(begin = 0) {
    playing = begin;
    $("play").textContent = begin ? "Pause" : "Play";
  }

  function play() {
    const begin = playing || !run ? 0 : performance.now();
    if (begin && now >= run.duration_ms) now = 0;
    pause(begin);
    if (begin) requestAnimationFrame(turn);
  }

  function move(to) {
    pause();
    now = Math.min(Math.max(0, to), run ? run.duration_ms : 0);
    picture();
  }

  const step = (by) => run && move(run.tick_ms * (by > 0 ? Math.floor(now / run.tick_ms + 1 + 1e-6) : Math.ceil(now / run.tick_ms - 1 - 1e-6)));

  function request(gear) {
    if (!run) return;
    const at_s = Math.round(now * 10) / 1e4;
    state.requests = [...run.requests.filter((one) => one.at_s < at_s), { at_s, gear }];
    state.duration_s = Math.min(offered.longest_s, Number((at_s + AFTER_REQUEST_S).toFixed(4)));
    refresh();
  }

  // A value: slider over round steps and a field over the model's range, in the unit shown.
  function slider({ path, name, factor, unit, step: by, low, high, own, value, stops }) {
    const title = make("span", { textContent: name });
    const range = make("input", { type: "range", min: 0, max: stops.length - 1, step: 1, ariaLabel: `${name}, ${unit}` });
    const field = make("input", { type: "number", min: low, max: high, step: "any", placeholder: "none", ariaLabel: `${name}, ${unit}` });
    range.dataset.path = field.dataset.field = path;
    const write = (is) => {
      range.value = stops.findLastIndex((stop) => stop <= (is ?? low) + 1e-9);
      field.value = is ?? "";
      range.setAttribute("aria-valuetext", `${is ?? "none"} ${unit}`);
      title.className = path in state.settings ? "changed" : "";
    };
    const take = (is) => {
      set(path, is === own ? value : Number((is / factor).toPrecision(12)), value);
      write(is);
      refresh(performance.now());
    };
    range.addEventListener("input", () => take(own == null && range.value === "0" ? own : stops[range.value]));
    field.addEventListener("change", () => take(field.value === "" ? own : Math.min(high, Math.max(low, Number(field.value)))));
    write(path in state.settings ? Number((state.settings[path] * factor).toPrecision(10)) : own);
    const tip = `--set ${path}=${value ?? ""}   (${low} to ${high} ${unit}, slider from ${by} ${unit} on)`;
    return make("label", { title: tip }, title, range, field, make("span", {}, unit));
  }

  function metrics(rows) {
    const text = (value, unit) => (value == null ? "never" : `${Number(value.toPrecision(4))} ${unit}`);
    $("metrics").tBodies[0].replaceChildren(...rows.map(([name, unit, before, after]) => {
      const made = row([name, text(before, unit), text(after, unit)], (i) => i > 0);
      if (before !== after) made.lastChild.classList.add("moved");
      return made;
    }));
  }

  // --- bus -----------------------------------------------------------------------------------------
  // The latest frames up to the cursor, as many as there is room for.
  function frames() {
    const all = heard || (bus ? bus.frames.filter((frame) => frame[1] <= now + 1e-9) : []);
    const only = $("only").value;
    const selected = only ? all.filter((frame) => frame[3] === only) : all;
    $("frames-of").textContent = heard ? `of ${$("channel").value}` : `until ${now.toFixed(1)} ms`;
    const room = Math.max(1, Math.floor($("frame-list").clientHeight / $("frames").tHead.offsetHeight) - 1);
    $("frames").tBodies[0].replaceChildren(...selected.slice(-room).reverse().map(([, at, ...rest]) =>
      row([at.toFixed(3), ...rest], (i) => i === 0)));
    $("load").textContent = `${selected.length} frames${heard || !bus ? "" : `, bus ${(100 * bus.bus_load).toFixed(1)} % loaded over the run`}`;
  }

  // A form made from the schema of the fault: every fault of a scenario, with its limits.
  function faultForm(names) {
    const kinds = Object.entries(offered.faults).flatMap(([table, list]) => list.flatMap((schema) =>
      schema.properties.kind.enum.map((kind) => ({ table, schema, kind }))));
    const select = make("select", {}, ...kinds.map(({ table, kind }, i) =>
      new Option(`${table.replace("_fault", "").replace("fault", "bus")}: ${kind}`, i)));
    const [about, fields] = [make("p", { className: "faint" }), make("div")];
    select.onchange = () => {
      const { schema } = kinds[select.value];
      about.textContent = (schema.description || "").split("\n")[0];
      fields.replaceChildren(...Object.entries(schema.properties)
        .filter(([name]) => !["kind", "start_s"].includes(name))
        .map(([name, kind]) => make("label", {}, name, field(name, kind, (schema.required || []).includes(name), names))));
    };
    const add = button("Break it", guarded(async () => {
      const { table, kind } = kinds[select.value];
      const fault = { kind, start_s: Math.round(now * 10) / 1e4 };
      fields.querySelectorAll("[name]").forEach((input) => {
        if (input.value !== "") fault[input.name] = input.dataset.number ? Number(input.value) : input.value;
      });
      const faults = { ...state.faults, [table]: [...(state.faults[table] || []), fault] };
      await ask("/api/values", { ...asked(), faults }); // refused with its line before it is added
      state.faults = faults;
      faultList();
      refresh();
    }));
    $("fault").replaceChildren(make("label", {}, "fault", select), about, fields, add);
    select.onchange();
  }

  // Of the messages those of this scenario come first.
  function field(name, kind, required, names) {
    const plain = kind.anyOf ? kind.anyOf.find((one) => one.type !== "null") : kind;
    if (plain.enum) {
      const sorted = [...plain.enum.filter((value) => names.includes(value)), ...plain.enum.filter((value) => !names.includes(value))];
      return make("select", { name }, ...(required ? sorted : ["", ...sorted]).map((value) => new Option(value, value)));
    }
    const input = make("input", { name, size: 12, required, value: kind.default ?? "" });
    if (plain.type !== "string") input.dataset.number = "yes"; // 0x... is one too
    return input;
  }

  function faultList() {
    $("faults").replaceChildren(...Object.entries(state.faults).flatMap(([table, list]) => list.map((fault, i) => {
      const { kind, start_s, ...rest } = fault;
      const more = Object.entries(rest).map(([name, value]) => `, ${name} ${value}`).join("");
      return make("li", {}, `${table} ${kind} from ${start_s} s${more} `, button("remove", () => {
        state.faults = { ...state.faults, [table]: list.filter((_, k) => k !== i) };
        faultList();
        refresh();
      }, { ariaLabel: `remove ${kind}` }));
    })));
  }

  function listen() {
    if (socket) return socket.close();
    heard = [];
    socket = new WebSocket(`ws://${location.host}/bus`);
    socket.onopen = () => socket.send($("channel").value);
    socket.onmessage = (event) => {
      const { frames: more, end } = JSON.parse(event.data);
      heard = heard.concat(more || []).slice(-20000);
      $("heard").textContent = end || `${heard.length} frames heard`;
      frames();
      if (end) socket.close();
    };
    socket.onclose = (event) => {
      if (!event.wasClean) $("heard").textContent = `The connection was lost after ${heard.length} frames; Listen begins again.`;
      socket = null;
      $("listen").textContent = "Listen";
    };
    $("listen").textContent = "Stop";
    $("heard").textContent = "waiting";
    return undefined;
  }

  // --- runs ----------------------------------------------------------------------------------------
  const picked = new Set();
  let listed = "";

  async function over() {
    const plots = window.opc4Draw($("runs-plots"), await ask("/api/runs", [...picked]), (x) => plots.cursor(x));
  }

  async function list() {
    const found = await ask("/api/runs");
    const studies = new Set(found.filter((entry) => entry.kind === "study").map((entry) => entry.name));
    const working = found.find((entry) => picked.has(entry.name) && entry.kind === "study" && entry.state !== "complete");
    if (working) await over();
    const text = JSON.stringify(found);
    if (text === listed) return; // the rows stay, and with them what has the focus
    listed = text;
    const figure = (value, factor) => (value == null ? "" : String(Number((value * factor).toPrecision(4))));
    $("listed").tBodies[0].replaceChildren(...found.map((entry) => {
      const { shift_time_s, impact_speed_m_s } = entry.figures || {};
      const tick = make("input", { type: "checkbox", checked: picked.has(entry.name), disabled: !entry.trace, ariaLabel: `compare ${entry.name}` });
      tick.onchange = guarded(async () => {
        if (!tick.checked) picked.delete(entry.name);
        else {
          if (entry.kind === "study") picked.clear(); // alone, as far as it is
          picked.forEach((name) => { if (studies.has(name)) picked.delete(name); });
          picked.add(entry.name);
        }
        if (picked.size) await over();
      });
      const name = entry.page ? make("a", { href: `/runs/${encodeURIComponent(entry.name)}/report.html` }, entry.name) : entry.name;
      return row([tick, name, entry.kind, entry.rows == null ? entry.state : `${entry.rows} rows, ${entry.state}`,
        figure(shift_time_s, 1e3), figure(impact_speed_m_s, 1)], (i) => i > 3);
    }));
    if (!found.length) $("listed").tBodies[0].append(row(["", "nothing yet"], () => false));
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
  document.querySelectorAll("#shift .panels, #bus .panels").forEach((panels) => panels.addEventListener("keydown", (event) => {
    const act = { ArrowRight: () => step(1), ArrowLeft: () => step(-1), " ": play }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }));
  document.querySelectorAll(".gear").forEach((button) => button.addEventListener("click", () => request(button.dataset.gear)));
  on("play", "click", play);
  on("back", "click", () => step(-1));
  on("step", "click", () => step(1));
  on("by-hand", "click", () => {
    Object.assign(state, { requests: [], duration_s: AFTER_REQUEST_S });
    now = 0;
    refresh();
  });
  on("only", "change", frames);
  on("listen", "click", listen);
  on("scenario", "change", () => {
    const by_hand = state.requests || Object.keys(state.faults).length;
    changed({ scenario: $("scenario").value, settings: state.settings });
    if (by_hand) note("Requests and faults of the other scenario were left out.");
  });
  const choice = (id, path, key, read) => on(id, "change", () => { set(path, read($(id)), values[key]); refresh(performance.now()); });
  choice("strategy", "controller.strategy", "strategy", (select) => select.value);
  choice("damper", "plant.damper", "damper", (select) => select.value);
  choice("filter", "controller.filter", "filter", (box) => box.checked);
  on("reset", "click", () => changed({ scenario: state.scenario }));
  on("keep", "click", () => { state.before = { ...state.settings }; refresh(); });
  on("keep-shipped", "click", () => { state.before = null; refresh(); });
  ["copy-command", "copy-scenario"].forEach((id) => on(id, "click", guarded(async () => {
    const { text } = $(id).dataset;
    let where = "";
    if (id === "copy-scenario") {
      const link = Object.assign(document.createElement("a"), { download: `${run.name}.toml`, href: URL.createObjectURL(new Blob([text])) });
      link.click();
      where = ` and saved as ${link.download} where the browser puts files: opc4 run ${link.download}`;
    }
    await navigator.clipboard.writeText(text);
    note(`Copied${where}`);
  })));
  $("messages").addEventListener("click", (event) => { event.target.textContent = ""; });
  dark.addEventListener("change", picture);
  document.addEventListener("visibilitychange", () => {
    if (document.hidden && playing) note("Playing was paused while this tab was hidden.");
    if (document.hidden) pause();
    else if (offered) refresh();
  });
  const others = new BroadcastChannel("opc4 live " + location.port);
  others.onmessage = () => note("A second tab was opened: each has values of its own, which are in its address.");
  others.postMessage("opened");
  window.addEventListener("hashchange", () => { restored(); refill().then(() => show(state.tab)); });
  setInterval(() => { if (state.tab === "runs" && !document.hidden && !waiting) guarded(list)(); }, 2000);
  guarded(async () => {
    offered = await ask("/api/vocabulary");
    restored();
    if (location.search) history.replaceState(null, "", location.pathname + location.hash); // the token
    await refill();
    show(state.tab);
  })();
})();
