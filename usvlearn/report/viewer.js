// The viewer of a report's runs: speed, open-loop simulation and commands over time, a track, and errors against speed and command.
// It needs no library and no network.
(() => {
  const $ = (id) => document.getElementById(id);
  const data = JSON.parse($("viewer-data").textContent);
  const hidden = new Set(data.hidden); // estimators that are not drawn
  let columns = [], waiting = false;

  function draw() {
    waiting = false;
    const style = getComputedStyle(document.documentElement);
    const [ink, soft, line] = ["--ink", "--soft", "--line"].map((name) => style.getPropertyValue(name));
    const theme = { ink, soft, line };
    const own = data.output, error = $("viewer-error").value;
    const next = limits(columns, "measured", `next ${own}`), free = limits(columns, "measured", `free ${own}`);
    const sizes = columns.flatMap(({ run }) => Array.from(run.of[error] || [], Math.abs)).filter(Number.isFinite);
    const largest = sizes.sort((a, b) => a - b)[Math.floor(0.98 * sizes.length)] || 1;
    const ends = columns.flatMap(({ run }) => ["speed", "command"].flatMap((x) =>
      (run.bins[`${error} against ${x}`] || []).flatMap((row) => [Math.abs(row[2]), Math.abs(row[3])])));
    const high = 1.1 * Math.max(0.01, ...ends);
    $("viewer-largest").textContent = `${largest.toPrecision(2)} m/s and more`;
    for (const column of columns) {
      const { run, window, canvases } = column;
      const names = data.shown.filter((name) => !hidden.has(name));
      for (const [place, kind, range, label] of [
        [canvases.next, "next", next, "Speed, m/s, predicted one step ahead"],
        [canvases.free, "free", free, "Speed, m/s, from the commands alone (open-loop simulation)"],
      ]) {
        const made = run.of[`${kind} ${own}`] ? label : `${label} (not in these folders)`;
        const box = axes(place, theme, window, range, made, true);
        if (kind === "next" && !hidden.has(own)) {
          band(box, run, run.of[`next ${own}`], run.of.halfwidth, window, data.colours[own]);
        }
        curve(box, run, run.of.measured, window, theme.ink, 2);
        for (const name of names) {
          curve(box, run, run.of[`${kind} ${name}`], window, data.colours[name], name === own ? 1.6 : 1);
        }
        cursorLine(box, theme, column.cursor);
      }
      const sides = limits(columns, "left", "right");
      const box = axes(canvases.commands, theme, window, sides, "Commands, share of full", true);
      for (const side of ["left", "right"]) curve(box, run, run.of[side], window, data.sides[side], 1.4);
      cursorLine(box, theme, column.cursor);
      column.place = track(canvases.track, theme, column, run.of[error], largest, data.colours[own]);
      for (const [name, label] of [["speed", "measured speed, m/s"], ["command", "mean command"]]) {
        const rows = run.bins[`${error} against ${name}`] || [];
        bins(canvases[name], theme, rows, data.colours[own], `Error, m/s, against ${label}`, [-high, high]);
      }
      column.readout.textContent = read(column);
    }
  }

  /** The numbers at the cursor, in words. */
  function read({ run, cursor, window }) {
    if (cursor === null) return `${clock(window[0], 1)} to ${clock(window[1], 1)} of the run`;
    const k = Math.max(0, Math.min(run.at.length - 1, bucket(run, cursor + run.width / 2) - 1));
    const number = (name, unit = "") => {
      const line = run.of[name], x = line ? line[line.length > run.at.length ? 2 * k : k] : NaN;
      return Number.isNaN(x) ? "–" : x.toFixed(3) + unit;
    };
    const own = data.output;
    return `${clock(cursor, 0.1)}: measured ${number("measured")}, ${own} ${number(`next ${own}`)} ± ` +
      `${number("halfwidth")}, free ${number(`free ${own}`, " m/s")}; left ${number("left")}, right ${number("right")}`;
  }

  function later() {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  }

  // ---- what a person does

  function look(column, from, span) {
    const [first, last] = column.run.ends, least = Math.max(4 * column.run.width, 2);
    span = Math.min(last - first, Math.max(least, span));
    from = Math.min(last - span, Math.max(first, from));
    column.window = [from, from + span];
    later();
  }

  function zoom(column, factor, share) {
    const [from, to] = column.window, at = from + share * (to - from), span = (to - from) * factor;
    look(column, at - share * span, span);
  }

  const pan = (column, share) => look(column, column.window[0] + share * (column.window[1] - column.window[0]),
    column.window[1] - column.window[0]);
  const reset = (column) => look(column, column.run.ends[0], Infinity);

  /** Mouse, wheel, touch and keys on the canvases of one run. */
  function listen(column, area) {
    const touching = new Map();
    const share = (x) => (x - area.getBoundingClientRect().left - LEFT) / (area.clientWidth - LEFT - RIGHT);
    area.addEventListener("wheel", (event) => {
      const full = column.window[1] - column.window[0] >= column.run.ends[1] - column.run.ends[0];
      if (event.deltaY > 0 && full) return; // the page scrolls
      event.preventDefault();
      zoom(column, Math.exp(Math.sign(event.deltaY) * 0.25), share(event.clientX));
    }, { passive: false });
    area.addEventListener("pointerdown", (event) => {
      touching.set(event.pointerId, event.clientX);
      area.setPointerCapture(event.pointerId);
    });
    area.addEventListener("pointermove", (event) => {
      if (touching.has(event.pointerId)) {
        const before = [...touching.values()];
        touching.set(event.pointerId, event.clientX);
        const now = [...touching.values()];
        if (now.length === 1) pan(column, share(before[0]) - share(now[0]));
        else if (Math.abs(now[0] - now[1]) > 1) {
          zoom(column, Math.abs((before[0] - before[1]) / (now[0] - now[1])), share((now[0] + now[1]) / 2));
        }
      }
      const [from, to] = column.window;
      column.cursor = from + Math.min(1, Math.max(0, share(event.clientX))) * (to - from);
      later();
    });
    for (const name of ["pointerup", "pointercancel"]) {
      area.addEventListener(name, (event) => touching.delete(event.pointerId));
    }
    area.addEventListener("pointerleave", () => { column.cursor = null; later(); });
    area.addEventListener("dblclick", () => reset(column));
    area.addEventListener("keydown", (event) => {
      const closer = () => zoom(column, 0.7, 0.5), farther = () => zoom(column, 1 / 0.7, 0.5);
      const done = { ArrowLeft: () => pan(column, -0.2), ArrowRight: () => pan(column, 0.2), "+": closer, "=": closer,
        "-": farther, 0: () => reset(column), Home: () => reset(column) }[event.key];
      if (!done || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      done();
    });
  }

  /** A click on the track goes to the nearest moment; where a track was forecast, closer, and the next click back. */
  function pick(column, event) {
    const { run } = column, box = column.canvases.track.getBoundingClientRect();
    if (column.near && forecastAt(run, column.cursor)) { column.near = false; later(); return; }
    let least = Infinity;
    for (let k = 0; k < run.at.length; k++) {
      const [x, y] = column.place(k), away = Math.hypot(x - event.clientX + box.left, y - event.clientY + box.top);
      if (away < least) { least = away; column.cursor = run.at[k]; }
    }
    column.near = true;
    later();
  }

  function element(tag, attributes, ...children) {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
  }

  function column(index) {
    const run = opened(data.runs[index]), canvases = {};
    const canvas = (name, label) =>
      (canvases[name] = element("canvas", { class: name, role: "img", "aria-label": label }));
    const area = element("div", { class: "plots", tabindex: 0, role: "group",
      "aria-label": "Time axis. Arrows move it, plus and minus zoom, 0 shows the whole run." },
    canvas("next", "Measured and predicted speed over time"), canvas("free", "Measured and simulated speed over time"),
    canvas("commands", "Commands over time"));
    const made = { run, canvases, window: [...run.ends], cursor: null, readout: element("p", { class: "readout" }) };
    const set = run.learned ? "with the first parameters that were saved, which have learned from it"
      : "with parameters that were saved before it";
    const ahead = run.ahead?.length ? " Click on the track: it shows the track that was forecast there, with the " +
      "ellipses of 90 % and where the boat was then. The next click shows the whole track." : "";
    const head = element("h3", {}, `${run.boat}, ${run.name}`);
    made.element = element("div", { class: "column" }, head, area, made.readout,
      element("div", { class: "beside" }, canvas("track", "Track, coloured by the error"),
        canvas("speed", "Error against speed"), canvas("command", "Error against command")),
      element("p", { class: "facts" }, `The run is simulated ${set}. ${run.track}${ahead}`));
    listen(made, area);
    canvases.track.addEventListener("click", (event) => pick(made, event));
    return made;
  }

  /** Show the chosen runs; a run that stays keeps its window. */
  function choose() {
    const wanted = [$("viewer-run").value, $("viewer-beside").value].filter((each) => each !== "");
    columns = wanted.map((each, k) => columns[k]?.run === data.runs[each] ? columns[k] : column(+each));
    $("viewer-columns").replaceChildren(...columns.map((each) => each.element));
    later();
  }

  for (const id of ["viewer-run", "viewer-beside"]) $(id).addEventListener("change", choose);
  $("viewer-names").addEventListener("change", ({ target }) => {
    hidden[target.checked ? "delete" : "add"](target.value);
    later();
  });
  $("viewer-error").value = data.runs.some((run) => "error" in run.series) ? "error" : "free error";
  $("viewer-error").addEventListener("change", later);
  $("viewer-reset").addEventListener("click", () => columns.forEach(reset));
  for (const link of document.querySelectorAll("a[data-run]")) {
    link.addEventListener("click", () => { $("viewer-run").value = link.dataset.run; choose(); });
  }
  window.addEventListener("hashchange", () => {
    const part = document.getElementById(location.hash.slice(1))?.closest("details");
    if (part) part.open = true;
  });
  window.addEventListener("resize", later);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", later);
  $("viewer").hidden = false;
  if (data.runs.length) $("viewer-run").value = data.runs.length - 1;
  if (data.runs.length) choose();
})();
