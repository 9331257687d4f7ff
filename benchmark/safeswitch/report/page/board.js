// The leaderboard: sortable, with intervals drawn in the cells.

const LEADING = 18;
const ALWAYS = /^(learner|expert|timer|oracle-hindsight|oracle-onset|cem@total|best@total)$/;
const COLUMNS = [
  { key: "return_mean", name: "Return", lo: "return_lo", hi: "return_hi", digits: 2, better: -1, zero: true },
  { key: "skill", name: "Skill", lo: "skill_lo", hi: "skill_hi", digits: 2, better: -1, range: [-0.5, 1.5] },
  { key: "success", name: "Success", lo: "success_lo", hi: "success_hi", digits: 3, better: -1, range: [0, 1] },
  { key: "autonomy", name: "Autonomy", digits: 2, better: -1, fill: true },
  { key: "recovery", name: "Recovery", digits: 2, better: -1, title: "success where the learner alone fails" },
  { key: "harm", name: "Harm", digits: 3, better: 1, title: "failure where the learner alone succeeds" },
  { key: "timely", name: "Timely", digits: 2, better: -1, title: "handed over between onset and the last chance, and saved" },
  { key: "false_alarms", name: "False alarms", digits: 2, better: 1, title: "per undisturbed episode" },
  { key: "margin_s", name: "Margin [s]", digits: 2, better: -1, title: "from the handover to the end of the safe window" },
  { key: "threshold", name: "Threshold", digits: 0, better: -1, title: "median over learners" },
  { key: "tuning_episodes", name: "Tuning", title: "episodes used to choose the threshold", digits: 0, better: 1 },
];
const OTHERS = "other disturbances";
const BAR = { width: 68, height: 20, edge: 3 };

function reference(board) {
  const rows = board.rows.filter((row) => /^(learner|expert|timer)$/.test(row.method));
  return rows.length ? Math.max(...rows.map((row) => row.return_mean)) : NaN;
}

function drawBoard(state) {
  const { task, board, sort } = state;
  const every = [...board.rows].sort((a, b) => b.return_mean - a.return_mean);
  const wanted = $("find").value.trim().toLowerCase();
  let rows = every.filter((row) => row.method.toLowerCase().includes(wanted));
  if ($("show").value === "lead" && !wanted)
    rows = rows.filter((row, i) => i < LEADING || ALWAYS.test(row.method) || row.method === state.method);
  rows.sort((a, b) => compare(a, b, sort));
  const number = `${rows.length} of ${every.length} rows`;
  if ($("shown").textContent !== number) $("shown").textContent = number;
  $("board-caption").textContent = `${task.name}, ${cellTitle(state.cell)}, armed at ${state.protocol}: ` +
    `${board.learners} learner${board.learners > 1 ? "s" : ""}, ${board.episodes} test episodes`;
  drawHead(state);
  const zero = reference(board);
  const scales = Object.fromEntries(COLUMNS.filter((c) => c.lo || c.fill).map((c) => [c.key, barScale(c, rows, zero)]));
  $("table").tBodies[0].replaceChildren(...rows.map((row) => boardRow(row, state, scales, zero)));
}

function compare(a, b, { key, down }) {
  if (key === "method") return (down ? -1 : 1) * a.method.localeCompare(b.method);
  const [x, y] = [a[key], b[key]];
  if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
  return (down ? y - x : x - y) || b.return_mean - a.return_mean;
}

function drawHead(state) {
  const head = $("table").tHead;
  if (!head.rows.length) {
    const cells = [{ key: "method", name: "Method" }, ...COLUMNS].map((column) => {
      const button = html("button", { type: "button", title: column.title }, column.name);
      button.addEventListener("click", () => {
        const same = state.sort.key === column.key;
        state.sort = { key: column.key, down: same ? !state.sort.down : column.better !== 1 && column.key !== "method" };
        drawBoard(state);
      });
      return html("th", { scope: "col", "data-key": column.key, class: column.lo || column.fill ? "wide" : null }, button);
    });
    head.append(html("tr", {}, cells));
  }
  for (const cell of head.rows[0].cells) {
    if (cell.dataset.key === state.sort.key) cell.setAttribute("aria-sort", state.sort.down ? "descending" : "ascending");
    else cell.removeAttribute("aria-sort");
  }
}

// Of the rows that are shown, the bounds of the column's range apart: a few very bad methods must not hide the rest.
function barScale(column, rows, zero) {
  const [floor, ceiling] = column.range || [-Infinity, Infinity];
  if (column.fill) return scale(BAR.edge, BAR.width - BAR.edge, 0, 1);
  const values = rows.flatMap((row) => [row[column.lo], row[column.hi], row[column.key]]);
  if (column.zero) values.push(zero);
  const there = values.filter((value) => !Number.isNaN(value)).map((value) => Math.max(floor, Math.min(ceiling, value)));
  const [low, high] = there.length ? [Math.min(...there), Math.max(...there)] : [0, 1];
  return scale(BAR.edge, BAR.width - BAR.edge, low, high > low ? high : low + 1);
}

function boardRow(row, state, scales, zero) {
  const mark = [row.traits.includes("privileged") ? "*" : row.traits.includes("returns") ? "↺" : "", strange(row)].join("");
  const icon = svg("svg", { viewBox: "-8 -8 16 16", width: 16, height: 16, "aria-hidden": "true" }, glyph(row.method));
  const chosen = row.method === state.method;
  const button = html("button", { type: "button", class: "method", "aria-pressed": String(chosen),
    title: origin(row) }, row.method);
  button.addEventListener("click", () => chooseMethod(row.method));
  const head = html("th", { scope: "row" }, icon, button, mark && html("span", { class: "sign" }, mark));
  const cells = COLUMNS.map((column) => boardCell(row, column, scales[column.key], zero));
  return html("tr", { class: chosen ? "chosen" : null, "data-method": row.method, "data-on": row.on }, head, cells);
}

// The sign of thresholds that come from other disturbances than the one that is shown.
const strange = ({ on }) => (on === OTHERS ? "†" : "");
const origin = ({ on }) => (on ? `calibrated on ${on}` : null);

function boardCell(row, column, at, zero) {
  const value = row[column.key];
  const shown = column.key === "threshold" ? text(value) : fixed(value, column.digits);
  if (!at) return html("td", {}, shown);
  if (column.key === "skill" && Number.isNaN(value)) // a method without a signal has no best threshold to compare with
    return html("td", { class: "wide none" }, row.method.includes("@") ? "no contest" : "–");
  const range = column.lo ? `${fixed(row[column.lo], 2)} to ${fixed(row[column.hi], 2)}` : null;
  return html("td", { class: "wide", title: range && `95 % interval ${range}` },
    html("span", { class: "value" }, shown), interval(row, column, at, zero),
    range && html("span", { class: "hidden" }, `, interval ${range}`));
}

function interval(row, column, at, zero) {
  const y = BAR.height / 2;
  const place = (value) => Math.max(0.5, Math.min(BAR.width - 0.5, at(value)));
  const picture = svg("svg", { class: "interval", width: BAR.width, height: BAR.height, "aria-hidden": "true",
    viewBox: `0 0 ${BAR.width} ${BAR.height}` });
  if (column.fill) {
    picture.append(svg("rect", { class: "track", x: at(0), y: y - 3, width: at(1) - at(0), height: 6, rx: 1 }));
    picture.append(svg("rect", { class: "level", x: at(0), y: y - 3, width: at(row[column.key]) - at(0), height: 6, rx: 1 }));
    return picture;
  }
  picture.append(svg("line", { class: "base", x1: 0, x2: BAR.width, y1: y, y2: y }));
  if (column.zero && !Number.isNaN(zero))
    picture.append(svg("line", { class: "zero", x1: place(zero), x2: place(zero), y1: 0, y2: BAR.height }));
  if (column.key === "skill") picture.append(svg("line", { class: "zero", x1: place(0), x2: place(0), y1: 0, y2: BAR.height }));
  const { css } = family(row.method);
  picture.append(svg("line", { class: `span ${css}`, x1: place(row[column.lo]), x2: place(row[column.hi]), y1: y, y2: y }));
  picture.append(svg("circle", { class: `mean ${css}`, cx: place(row[column.key]), cy: y, r: 3.4 }));
  return picture;
}
