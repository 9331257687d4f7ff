// Success against autonomy: every method a point, and the line that constant thresholds on the chosen signal trace.

const PLANE = { height: 420, left: 52, right: 16, top: 30, bottom: 44 };
const NAMED = /^(learner|expert|timer|oracle-hindsight)$/;

function drawPlane(state) {
  const holder = $("plane-chart");
  const width = Math.max(holder.clientWidth, 280);
  const height = width < 560 ? 340 : PLANE.height;
  const rows = state.board.rows;
  const [x, y] = planeScales(rows, state, width, height);
  const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "group", "aria-labelledby": "plane-caption" });
  axes(root, x, y, { xName: ["autonomy: share of steps that the learner drives", "autonomy"], yName: "success", xTicks: width < 560 ? 4 : 8 });
  let ring = null;
  if (state.sweep) {
    root.append(line(x, y, state.sweep.autonomy, state.sweep.success, { class: "reach" }));
    const now = svg("circle", { class: "now", r: 8, id: "plane-now" });
    ring = now;
    state.planeNow = (scores) => {
      const shown = !Number.isNaN(scores.success);
      filled(now, { cx: shown ? x(scores.autonomy) : -99, cy: shown ? y(scores.success) : -99 }, []);
    };
  } else state.planeNow = () => {};
  const points = [...rows].sort((a, b) => a.autonomy - b.autonomy || a.success - b.success);
  const layer = svg("g", { class: "points" });
  points.forEach((row, i) => layer.append(planePoint(row, state, x, y, i, points.length)));
  roving(layer);
  root.append(layer, planeLabels(points, state, x, y, width));
  if (ring) root.append(ring);
  holder.replaceChildren(root, planeLegend(points));
  $("plane-caption").textContent = `${state.task.name}, ${cellTitle(state.cell)}, armed at ${state.protocol}. ` +
    "Tab to the points and use the arrow keys to go through them; the leaderboard has the same numbers.";
}

function planeScales(rows, state, width, height) {
  const low = Math.min(...rows.map((row) => row.success), 0.9);
  const xs = [...rows.map((row) => row.autonomy), ...(state.sweep ? state.sweep.autonomy : [])];
  const [left, right] = [Math.min(...xs), Math.max(...xs)];
  const room = 0.04 * Math.max(right - left, 0.1);
  return [
    scale(PLANE.left, width - PLANE.right, Math.max(left - room, -0.02), Math.min(right + room, 1.02)),
    scale(height - PLANE.bottom, PLANE.top, Math.max(low - 0.05 * (1 - low), 0), 1 + 0.04 * (1 - low)),
  ];
}

// A method stands twice where it was calibrated on other disturbances too; that one carries the leaderboard's sign.
const signed = (row) => row.method + (strange(row) && ` ${strange(row)}`);

function planePoint(row, state, x, y, index, count) {
  const chosen = row.method === state.method;
  const point = glyph(row.method);
  const label = `${row.method}: success ${fixed(row.success, 3)}, autonomy ${fixed(row.autonomy, 3)}, ` +
    `return ${fixed(row.return_mean, 2)}${row.on ? `, ${origin(row)}` : ""}`;
  filled(point, {
    transform: `translate(${x(row.autonomy).toFixed(1)} ${y(row.success).toFixed(1)})${chosen ? " scale(1.5)" : ""}`,
    role: "button", tabindex: index === 0 ? 0 : -1, "aria-label": `${label}, point ${index + 1} of ${count}`,
    "aria-pressed": String(chosen),
  }, []);
  if (chosen) point.classList.add("chosen");
  const show = () => {
    const box = point.getBoundingClientRect();
    showTip(tipOf(row), box.right, box.top);
  };
  for (const event of ["pointerenter", "focus"]) point.addEventListener(event, show);
  for (const event of ["pointerleave", "blur"]) point.addEventListener(event, hideTip);
  point.addEventListener("click", () => chooseMethod(row.method));
  point.addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      chooseMethod(row.method);
    }
  });
  return point;
}

function tipOf(row) {
  return [
    html("b", {}, row.method), html("br"),
    ...(row.on ? [origin(row), html("br")] : []),
    `success ${fixed(row.success, 3)} [${fixed(row.success_lo, 2)}, ${fixed(row.success_hi, 2)}]`, html("br"),
    `autonomy ${fixed(row.autonomy, 3)}`, html("br"), `return ${fixed(row.return_mean, 2)}`,
    ...(Number.isNaN(row.threshold) ? [] : [html("br"), `threshold ${text(row.threshold)}`]),
  ];
}

// One stop of the tab key for all points; arrows go from one to the next, Home and End to the ends.
function roving(layer) {
  layer.addEventListener("keydown", (event) => {
    const points = [...layer.children];
    const here = points.indexOf(document.activeElement);
    const steps = { ArrowRight: here + 1, ArrowUp: here + 1, ArrowLeft: here - 1, ArrowDown: here - 1, Home: 0,
      End: points.length - 1 };
    const next = points[steps[event.key]];
    if (!next) return;
    event.preventDefault();
    points[here].setAttribute("tabindex", -1);
    next.setAttribute("tabindex", 0);
    next.focus();
  });
}

// Who gets a name beside its point first: the smaller, the sooner; from `UNNAMED` on nobody does.
const UNNAMED = 9;
function rankOf(row, state) {
  const chosen = row.method === state.method;
  if (strange(row)) return chosen ? 1 : UNNAMED;
  if (chosen) return 0;
  if (NAMED.test(row.method)) return 1;
  const wanted = [`cem@${state.signal}`, `best@${state.signal}`].indexOf(row.method);
  if (wanted >= 0) return 2 + wanted;
  return row.method.endsWith(`@${state.signal}`) ? 4 : UNNAMED;
}

// Where a name may stand: beside its point, above, below; the first that is free.
const PLACES = [[9, 4, "start"], [-9, 4, "end"], [0, -10, "middle"], [0, 18, "middle"], [9, 16, "start"], [-9, 16, "end"],
  [9, -9, "start"], [-9, -9, "end"], [0, 31, "middle"], [10, 29, "start"], [-10, 29, "end"]];
const BEFORE = { start: 0, middle: 0.5, end: 1 };

function planeLabels(points, state, x, y, width) {
  const layer = svg("g", { class: "labels", "aria-hidden": "true" });
  const taken = points.map((row) => [x(row.autonomy) - 6, y(row.success) - 6, x(row.autonomy) + 6, y(row.success) + 6]);
  const named = points.map((row) => ({ row, rank: rankOf(row, state) })).filter(({ rank }) => rank < UNNAMED);
  for (const { row, rank } of named.sort((a, b) => a.rank - b.rank)) {
    const chosen = row.method === state.method;
    const [px, py, size] = [x(row.autonomy), y(row.success), widthOf(signed(row), `${chosen ? "bold " : ""}11.5px`)];
    const places = PLACES.map(([dx, dy, anchor]) => {
      const left = px + dx - BEFORE[anchor] * size;
      return { at: { x: px + dx, y: py + dy, "text-anchor": anchor }, box: [left, py + dy - 11, left + size, py + dy + 3] };
    }).filter(({ box }) => box[0] >= PLANE.left && box[2] <= width - 2 && box[1] >= 8 && box[3] <= y.from);
    // The chosen method is named even if the name must cover other points: else its dagger's name would stand for it.
    const place = places.find(({ box }) => !taken.some((other) => overlap(box, other))) || (rank === 0 && places[0]);
    if (!place) continue;
    taken.push(place.box);
    layer.append(svg("text", { ...place.at, class: chosen ? "chosen" : null }, signed(row)));
  }
  return layer;
}

function overlap(a, b) {
  return a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
}

function planeLegend(points) {
  const shown = FAMILIES.filter((each) => points.some((row) => family(row.method) === each));
  return html("ul", { class: "legend" }, shown.map(({ name, css, shape }) =>
    html("li", {}, svg("svg", { viewBox: "-8 -8 16 16", width: 16, height: 16, "aria-hidden": "true" },
      svg("path", { d: SHAPES[shape], class: `glyph ${css}` })), name)));
}
