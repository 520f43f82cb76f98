"use strict";
// What the viewer draws, on canvases, from the numbers in the page (`viewer_data.py` says in which form they are).
const UNKNOWN = -32768, LEVELS = 65534, GAP = 3; // GAP: s without a number at which a line ends
const LEFT = 46, RIGHT = 20; // pixels beside a plot, for its labels
const AHEAD = 15; // s, for which a forecast track is shown
const ERRORS = [[70, 120, 180], [200, 160, 40], [205, 50, 30]]; // colours from no error to a large one

const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;

function decode([text, low, step]) {
  return Float32Array.from(new Int16Array(bytes(text)), (k) => (k === UNKNOWN ? NaN : low + step * (k + LEVELS / 2)));
}

/** A run's series, decoded when it is first shown. */
function opened(run) {
  if (!run.at) {
    run.at = new Float32Array(bytes(run.time));
    run.of = Object.fromEntries(Object.entries(run.series).map(([name, each]) => [name, decode(each)]));
    run.ends = [run.at[0] ?? 0, Math.max((run.at[run.at.length - 1] ?? 0) + run.width, (run.at[0] ?? 0) + 1)];
  }
  return run;
}

/** The time of number k of a series: there are one or two in a bucket. */
const timeOf = (run, line, k) =>
  line.length > run.at.length ? run.at[k >> 1] + (k & 1) * run.width / 2 : run.at[k];

/** The first bucket that begins at a time or later. */
function bucket(run, time) {
  let low = 0, high = run.at.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (run.at[middle] < time) low = middle + 1; else high = middle;
  }
  return low;
}

/** The first number of a series in a window, and the one after the last. */
function within(run, line, [from, to]) {
  const share = line.length > run.at.length ? 2 : 1;
  return [share * Math.max(0, bucket(run, from) - 1), Math.min(line.length, share * (bucket(run, to) + 1))];
}

/** The least and the greatest number of some series in the windows of all columns, with room. */
function limits(columns, ...names) {
  const found = [];
  for (const { run, window } of columns) {
    for (const line of names.map((name) => run.of[name]).filter(Boolean)) {
      const [first, last] = within(run, line, window);
      for (let k = first; k < last; k++) if (Number.isFinite(line[k])) found.push(line[k]);
    }
  }
  if (!found.length) return [0, 1];
  found.sort((one, other) => one - other);
  const out = Math.floor(0.002 * found.length);  // a few outliers must not flatten the rest
  const low = found[out], high = found[found.length - 1 - out];
  const room = 0.08 * (high - low) + 0.02;
  return [low - room, high + room];
}

// ---- drawing

/** Distances between ticks: 1, 2 or 5 times a power of ten; of times also those of a clock. */
function spacing(span, count, clock) {
  const least = span / count;
  const times = clock && [1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 21600, 86400].find((x) => x >= least);
  if (times && least >= 1) return times;
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((x) => x * power >= least * 0.999);
}

function clock(t, step) {
  const rest = step < 1 ? (t % 60).toFixed(1).padStart(4, "0") : String(Math.round(t) % 60).padStart(2, "0");
  const minutes = Math.floor((step < 1 ? t : Math.round(t)) / 60);
  if (minutes < 60) return `${minutes}:${rest}`;
  return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")}:${rest}`;
}

/** Clear a canvas and draw its axes; returns what is needed to draw into them. */
function axes(canvas, theme, [x0, x1], [y0, y1], label, isTime) {
  const wide = canvas.clientWidth, high = canvas.clientHeight, dots = window.devicePixelRatio || 1;
  canvas.width = wide * dots;
  canvas.height = high * dots;
  const g = canvas.getContext("2d");
  g.scale(dots, dots);
  g.font = "12px system-ui, sans-serif";
  const left = LEFT, right = wide - RIGHT, top = 20, bottom = high - 20;
  const X = (x) => left + (x - x0) / (x1 - x0) * (right - left);
  const Y = (y) => bottom - (y - y0) / (y1 - y0) * (bottom - top);
  g.strokeStyle = theme.line;
  g.fillStyle = theme.soft;
  g.lineWidth = 1;
  const dx = spacing(x1 - x0, Math.max(2, (right - left) / 90), isTime);
  const dy = spacing(y1 - y0, Math.max(2, (bottom - top) / 34));
  g.beginPath();
  for (let k = Math.ceil(x0 / dx); k * dx <= x1; k++) {
    g.moveTo(X(k * dx), top);
    g.lineTo(X(k * dx), bottom);
    g.textAlign = "center";
    g.fillText(isTime ? clock(k * dx, dx) : String(+(k * dx).toPrecision(6)), X(k * dx), bottom + 14);
  }
  for (let k = Math.ceil(y0 / dy); k * dy <= y1; k++) {
    g.moveTo(left, Y(k * dy));
    g.lineTo(right, Y(k * dy));
    g.textAlign = "right";
    g.fillText(String(+(k * dy).toPrecision(6)), left - 5, Y(k * dy) + 4);
  }
  g.stroke();
  g.textAlign = "left";
  g.fillText(label, 4, 13);
  g.beginPath();
  g.rect(left, top, right - left, bottom - top);
  g.clip();
  return { g, X, Y, left, right, top, bottom };
}

/** A line over time. Of several points in one column of pixels the least and the greatest are drawn. */
function curve({ g, X, Y }, run, line, window, stroke, width) {
  if (!line) return;
  const [first, last] = within(run, line, window), gap = Math.max(GAP, 2.5 * run.width);
  let before = -Infinity, pixel = NaN, low = 0, high = 0, end = 0;
  g.beginPath();
  const flush = () => { if (high > low) for (const y of [low, high, end]) g.lineTo(pixel, Y(y)); };
  for (let k = first; k < last; k++) {
    const y = line[k], t = timeOf(run, line, k);
    if (Number.isNaN(y)) continue;
    const x = Math.round(X(t) * 2) / 2;
    if (t - before > gap) { flush(); g.moveTo(x, Y(y)); low = high = y; }
    else if (x !== pixel) { flush(); g.lineTo(x, Y(y)); low = high = y; }
    else { low = Math.min(low, y); high = Math.max(high, y); }
    before = t; pixel = x; end = y;
  }
  flush();
  g.strokeStyle = stroke;
  g.lineWidth = width;
  g.lineJoin = "round";
  g.stroke();
}

/** The interval about a prediction, as one bar for each number. */
function band({ g, X, Y }, run, line, half, window, fill) {
  if (!line || !half) return;
  const [first, last] = within(run, line, window), two = line.length > run.at.length;
  g.fillStyle = fill;
  g.globalAlpha = 0.25;
  const wide = run.width / (two ? 2 : 1);
  for (let k = first; k < last; k++) {
    const t = timeOf(run, line, k), w = half[two ? k >> 1 : k], x = X(t - wide / 2);
    const top = Y(line[k] + w), bottom = Y(line[k] - w);
    if (Number.isFinite(top)) g.fillRect(x, top, X(t + wide / 2) - x, bottom - top);
  }
  g.globalAlpha = 1;
}

function shade(share) {
  const at = Math.min(1, Math.max(0, share)) * (ERRORS.length - 1), k = Math.min(ERRORS.length - 2, Math.floor(at));
  return `rgb(${ERRORS[k].map((x, j) => Math.round(x + (at - k) * (ERRORS[k + 1][j] - x))).join(" ")})`;
}

/** The track that was forecast last at a time, or nothing. */
function forecastAt(run, time) {
  const before = time === null ? [] : (run.ahead || []).filter((each) => each.time <= time + run.width);
  return before.length && time - before[before.length - 1].time < AHEAD ? before[before.length - 1] : null;
}

/** The track, coloured by the size of the error within the window, one scale for both runs; and a forecast in `fill`.
 *  Returns where a moment is on the canvas. */
function track(canvas, theme, { run, window, cursor, near }, error, largest, fill) {
  const { north, east } = run.of, made = forecastAt(run, cursor), close = near && made;
  const [from, to] = close ? [made.time - 5, made.time + made.span] : window;
  let [n0, n1, e0, e1] = [Infinity, -Infinity, Infinity, -Infinity];
  const include = (n, e) => {
    n0 = Math.min(n0, n); n1 = Math.max(n1, n);
    e0 = Math.min(e0, e); e1 = Math.max(e1, e);
  };
  const [first, last] = close ? [bucket(run, from), bucket(run, to)] : [0, run.at.length];
  for (let k = first; k < last; k++) if (!Number.isNaN(north[k] + east[k])) include(north[k], east[k]);
  if (close) {
    made.north.forEach((n, k) => include(n, made.east[k]));
    for (const [, k, major] of made.ellipses) {
      for (const sign of [-1, 1]) include(made.north[k] + sign * major, made.east[k] + sign * major);
    }
  }
  if (n0 > n1) [n0, n1, e0, e1] = [0, 1, 0, 1];
  const wide = canvas.clientWidth - LEFT - RIGHT, high = canvas.clientHeight - 40;
  const metres = 1.08 * Math.max((e1 - e0) / wide, (n1 - n0) / high, 5 / wide); // of a pixel
  const middle = [(e0 + e1) / 2, (n0 + n1) / 2];
  const box = axes(canvas, theme, [middle[0] - wide * metres / 2, middle[0] + wide * metres / 2],
    [middle[1] - high * metres / 2, middle[1] + high * metres / 2], "Track: m north, m east", false);
  const { g, X, Y } = box;
  const dot = (k, colour, size) => {
    g.fillStyle = colour;
    g.fillRect(X(east[k]) - size / 2, Y(north[k]) - size / 2, size, size);
  };
  for (const inside of [false, true]) {
    for (let k = 0; k < run.at.length; k++) {
      if ((run.at[k] >= from && run.at[k] <= to) !== inside || Number.isNaN(north[k] + east[k])) continue;
      const bad = error ? Math.abs(error[k]) / largest : NaN;
      dot(k, !inside || Number.isNaN(bad) ? theme.line : shade(bad), inside ? 3.5 : 2);
    }
  }
  if (made) {
    g.strokeStyle = g.fillStyle = fill;
    g.lineWidth = 1.6;
    g.beginPath();
    made.north.forEach((n, k) => g.lineTo(X(made.east[k]), Y(n)));
    g.stroke();
    for (const [horizon, k, major, minor, bearing] of made.ellipses) {
      g.beginPath();
      g.ellipse(X(made.east[k]), Y(made.north[k]), major / metres, minor / metres, bearing - Math.PI / 2, 0, 2 * Math.PI);
      g.stroke();
      g.globalAlpha = 0.15;
      g.fill();
      g.globalAlpha = 1;
      const came = bucket(run, made.time + horizon);
      if (came < run.at.length) dot(came, theme.ink, 6);
      g.fillStyle = fill;
    }
    if (close) dot(Math.min(run.at.length - 1, bucket(run, made.time)), theme.ink, 9);
  }
  if (!close && cursor !== null && run.at.length) dot(Math.min(run.at.length - 1, bucket(run, cursor)), theme.ink, 9);
  return (k) => [X(east[k]), Y(north[k])];
}

/** Mean error, and the band of 90 % of the errors, against speed or command. */
function bins(canvas, theme, rows, fill, label, heights) {
  const x = rows.length ? [rows[0][0], rows[rows.length - 1][0]] : [0, 1], room = 0.05 * (x[1] - x[0]) + 0.02;
  const { g, X, Y, left, right } = axes(canvas, theme, [x[0] - room, x[1] + room], heights, label, false);
  g.strokeStyle = theme.ink;
  g.strokeRect(left, Y(0), right - left, 0);
  g.strokeStyle = g.fillStyle = fill;
  g.globalAlpha = 0.25;
  g.beginPath();
  rows.forEach((row) => g.lineTo(X(row[0]), Y(row[3])));
  [...rows].reverse().forEach((row) => g.lineTo(X(row[0]), Y(row[2])));
  g.fill();
  g.globalAlpha = 1;
  g.beginPath();
  rows.forEach((row) => g.lineTo(X(row[0]), Y(row[1])));
  g.lineWidth = 2;
  g.stroke();
  rows.forEach((row) => g.fillRect(X(row[0]) - 3, Y(row[1]) - 3, 6, 6));
}

/** Where the cursor is, on a time axis. */
function cursorLine({ g, X, top, bottom }, theme, time) {
  if (time === null) return;
  g.fillStyle = theme.soft;
  g.fillRect(X(time), top, 1, bottom - top);
}
