// The threshold slider: curves over all thresholds, marks, margins, and what the present threshold does to each episode.

const SWEEP = { shares: 210, returns: 96, gap: 30, left: 52, right: 20, top: 34, bottom: 46, points: 240 };
const POSITIONS = 1000;
const CURVES = [["success", "success"], ["autonomy", "autonomy"], ["false_alarms", "false alarms"]];

function makeSweep(view) {
  const axis = axisOf(view);
  const sweep = { thresholds: [], success: [], autonomy: [], false_alarms: [], return_mean: [] };
  for (let i = 0; i <= SWEEP.points; i++) {
    const threshold = fromShare(i / SWEEP.points, ...axis);
    const scores = view.scores(threshold);
    sweep.thresholds.push(threshold);
    for (const key of Object.keys(scores)) if (sweep[key]) sweep[key].push(scores[key]);
  }
  return sweep;
}

// A little beyond the signal's own range, so that "always" and "never" are on the slider.
function axisOf(view) {
  const [low, high, logarithmic] = view.axis;
  const room = logarithmic ? (high / low) ** 0.03 : 0.03 * (high - low);
  return logarithmic ? [low / room, high * room, true] : [low - room, high + room, false];
}

function marksOf(view) {
  const marks = view.about.marks[`${view.cell}/${view.protocol}`] || [];
  const place = view.learner < 0 ? null : view.task.exact.learners.indexOf(view.learner);
  return marks.map(([method, on, own, compared]) => {
    const [values, at] = [own.map(number), compared.map(number)];
    return { method, on, at, value: place === null ? median(values) : values[place], values: place === null ? values : [values[place]] };
  }).sort((a, b) => a.value - b.value);
}

// The mark of a method: its own, before the one whose threshold comes from other disturbances.
function markOf(marks, wanted) {
  const found = marks.filter((mark) => wanted(mark.method));
  return found.find((mark) => !strange(mark)) || found[0];
}

function marginsOf(view) {
  const margins = view.about.margins[`${view.cell}/${view.protocol}`];
  const place = view.learner < 0 ? 0 : 1 + view.task.exact.learners.indexOf(view.learner);
  return margins && margins[place] ? margins[place].map(number) : null;
}

function drawSweep(state) {
  const { view, sweep } = state;
  const holder = $("sweep");
  const width = Math.max(holder.clientWidth, 280);
  const height = SWEEP.top + SWEEP.shares + SWEEP.gap + SWEEP.returns + SWEEP.bottom;
  const axis = axisOf(view);
  const x = scale(SWEEP.left, width - SWEEP.right, ...axis);
  const y = scale(SWEEP.top + SWEEP.shares, SWEEP.top, 0, 1);
  const finite = sweep.return_mean.filter((value) => !Number.isNaN(value));
  const zero = state.referenceOfView;
  const [low, high] = [Math.min(...finite, zero || Infinity), Math.max(...finite, zero || -Infinity)];
  const bottom = height - SWEEP.bottom;
  const y2 = scale(bottom, bottom - SWEEP.returns, low - 0.08 * (high - low || 1), high + 0.1 * (high - low || 1));
  const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-labelledby": "sweep-caption" });
  drawMargins(root, x, view, bottom);
  axes(root, x, y, { yName: "share", xTicks: 6, xText: () => "" });
  const name = `threshold on ${view.signal}`;
  axes(root, x, y2, { xName: [`${name}${axis[2] ? " (log scale)" : ""}`, name, view.signal], yName: "return", xTicks: 6, yTicks: 3 });
  if (!Number.isNaN(zero)) root.append(svg("line", { class: "zero", x1: x.from, x2: x.to, y1: y2(zero), y2: y2(zero) }));
  for (const [key] of CURVES) root.append(line(x, y, sweep.thresholds, sweep[key], { class: `curve ${key}` }));
  root.append(line(x, y2, sweep.thresholds, sweep.return_mean, { class: "curve return" }));
  drawMarks(root, x, state, bottom);
  const cursor = svg("g", { class: "cursor" }, svg("line", { y1: SWEEP.top - 6, y2: bottom }),
    ...CURVES.map(([key]) => svg("circle", { r: 4.5, class: key })), svg("circle", { r: 4.5, class: "return" }));
  root.append(cursor);
  root.addEventListener("pointerdown", (event) => {
    const share = (event.clientX - root.getBoundingClientRect().left - x.from) / (x.to - x.from);
    setThreshold(Math.max(0, Math.min(1, share)));
  });
  holder.replaceChildren(root);
  $("sweep-legend").replaceChildren(sweepLegend(view));
  $("slider").parentElement.style.cssText = `margin-left:${SWEEP.left - 9}px;margin-right:${SWEEP.right - 9}px`;
  $("sweep-caption").textContent = `Scores of a constant threshold on ${view.signal} over ${view.size} episodes, ` +
    `${cellTitle(state.cell)}, armed at ${state.protocol}. Signs above: thresholds that methods chose` +
    `${view.learner < 0 && view.task.exact.learners.length > 1 ? ", each at the median of its learners’ own (small ticks)" : ""}.`;
  state.sweepNow = (value, scores) => {
    const px = Math.max(x.from, Math.min(x.to, x(value)));
    const [bar, ...dots] = cursor.children;
    filled(bar, { x1: px, x2: px }, []);
    [...CURVES.map(([key]) => [key, y]), ["return_mean", y2]].forEach(([key, at], i) =>
      filled(dots[i], { cx: Number.isNaN(scores[key]) ? -99 : px, cy: Number.isNaN(scores[key]) ? -99 : at(scores[key]) }, []));
  };
}

function drawMargins(root, x, view, bottom) {
  const margins = marginsOf(view);
  if (!margins) return;
  const [low, high] = margins.map((value) => Math.max(x.low, Math.min(x.high, value)));
  const top = SWEEP.top - 6;
  root.append(svg("rect", { class: "margins", x: x(low), y: top, width: Math.max(x(high) - x(low), 1), height: bottom - top }));
}

function drawMarks(root, x, state, bottom) {
  const layer = svg("g", { class: "sweep-marks" });
  for (const mark of state.marks) {
    if (!Number.isFinite(mark.value) || mark.value < x.low || mark.value > x.high) continue;
    const px = x(mark.value);
    const { css } = family(mark.method);
    layer.append(svg("line", { class: `stem ${css}`, x1: px, x2: px, y1: SWEEP.top - 6, y2: bottom }));
    const point = glyph(mark.method);
    point.setAttribute("transform", `translate(${px} ${SWEEP.top - 12})`);
    point.append(svg("title", {}, `${mark.method}${strange(mark)} ${text(mark.value)}`));
    layer.append(point);
    for (const value of mark.values)
      if (mark.values.length > 1 && value > x.low && value < x.high)
        layer.append(svg("line", { class: `own ${css}`, x1: x(value), x2: x(value), y1: bottom - 5, y2: bottom + 1 }));
  }
  root.append(layer);
}

function sweepLegend(view) {
  const curves = view.undisturbed ? CURVES : CURVES.slice(0, 2);
  const entry = (css, name) => html("li", {}, svg("svg", { viewBox: "0 0 26 10", width: 26, height: 10, "aria-hidden": "true" },
    svg("line", { class: `curve ${css}`, x1: 0, x2: 26, y1: 5, y2: 5 })), name);
  const margins = html("li", {}, html("i", { class: "swatch margins" }), "margins: worth having");
  return html("ul", { class: "legend" }, curves.map(([key, name]) => entry(key, name)), entry("return", "return"),
    entry("zero", "best of learner, expert, timer"), marginsOf(view) && margins);
}

function drawMarkButtons(state) {
  const { view } = state;
  $("marks").replaceChildren(...state.marks.map((mark) => {
    const icon = svg("svg", { viewBox: "-8 -8 16 16", width: 14, height: 14, "aria-hidden": "true" }, glyph(mark.method));
    const button = html("button", { type: "button", "data-method": mark.method, "data-on": mark.on, "aria-pressed": "false" },
      icon, mark.method.split("@")[0] + strange(mark), html("span", { class: "hidden" }, `@${view.signal} at `), html("span", { class: "at" }, text(mark.value)));
    button.addEventListener("click", () => setMark(mark));
    return button;
  }));
}

// What the present threshold does: numbers, check against the leaderboard, episodes.
function showNow(state) {
  const { view, mark } = state;
  const all = view.task.exact.learners.length > 1 && view.learner < 0;
  const scores = view.scores(mark ? mark.at : state.threshold, true);
  const value = mark ? mark.value : state.threshold;
  state.now = scores;
  state.sweepNow(value, scores);
  state.planeNow(scores);
  showNumbers(scores, view);
  for (const button of $("marks").children)
    button.setAttribute("aria-pressed", String(Boolean(mark && button.dataset.method === mark.method && button.dataset.on === mark.on)));
  const slider = $("slider");
  slider.value = Math.round(POSITIONS * Math.max(0, Math.min(1, toShare(value, ...axisOf(view)))));
  slider.setAttribute("aria-valuetext", `${text(value)}${mark ? `, ${mark.method}` : ""}`);
  showCheck(state, scores, all);
  showFails(scores, view);
  paintMosaic(scores);
  clearTimeout(state.speaking);
  state.speaking = setTimeout(() => ($("spoken").textContent = spoken(value, scores, mark)), 250);
}

function showNumbers(scores, view) {
  const { sum } = scores;
  const judged = sum.n - sum.unknown;
  const range = sum.unknown ? `${sum.unknown} episodes hand over where no outcome was computed` : `${sum.success} of ${sum.n} episodes`;
  const entries = [
    ["success", "Success", sum.unknown ? `${fixed(sum.success / sum.n, 3)}–${fixed((sum.success + sum.unknown) / sum.n, 3)}`
      : fixed(scores.success, 4), range],
    ["autonomy", "Autonomy", fixed(scores.autonomy, 4), "of all steps driven by the learner"],
    ["false_alarms", "False alarms", fixed(scores.false_alarms, 4),
      view.undisturbed ? `${sum.false} of ${sum.undisturbed} undisturbed episodes` : "no undisturbed episode here"],
    ["false_alarms_before_onset", "Too early", fixed(scores.false_alarms_before_onset, 4),
      sum.n > sum.undisturbed ? `${sum.before} of ${sum.n - sum.undisturbed} handed over before the onset` : "no disturbed episode here"],
    ["return_mean", "Return", fixed(scores.return_mean, 4), "five for success, one for autonomy once armed"],
  ];
  const box = $("numbers");
  if (!box.children.length)
    box.append(...entries.map(([key, name]) => html("div", { "data-score": key }, html("dt", {}, name), html("dd"), html("dd", { class: "of" }))));
  entries.forEach(([key, , value, of], i) => {
    const [, main, note] = box.children[i].children;
    main.textContent = value;
    note.textContent = of;
    box.children[i].dataset.value = scores[key];
  });
  box.dataset.judged = judged;
}

function spoken(value, scores, mark) {
  const parts = [`${mark ? mark.method : "Threshold"} ${text(value)}`, `success ${fixed(scores.success, 3)}`,
    `autonomy ${fixed(scores.autonomy, 3)}`];
  if (!Number.isNaN(scores.false_alarms)) parts.push(`false alarms ${fixed(scores.false_alarms, 3)}`);
  const failures = scores.results.filter(({ ok }) => ok === 0).length;
  return `${parts.join(", ")}; ${failures} episodes fail`;
}

function showCheck({ view, mark, board }, scores, all) {
  let words = all ? "One threshold for all learners. At a marked one each learner has its own, as in the leaderboard."
    : "Choose a marked threshold to compare with the leaderboard.";
  if (mark && (all || view.task.exact.learners.length === 1)) {
    const row = board.rows.find((each) => each.method === mark.method && each.on === mark.on);
    const same = ["success", "autonomy", "return_mean", "false_alarms"].every((key) => close(row[key], scores[key]));
    words = same ? `${mark.method}: the same numbers as its row of the leaderboard${all ? ", each learner at its own threshold" : ""}.`
      : `${mark.method}: these are not the numbers of its row of the leaderboard!`;
  } else if (mark) words = `${mark.method} of this learner alone; the leaderboard has all learners together.`;
  $("check").textContent = words;
}

// Equal to the six significant digits that leaderboard.csv has.
function close(written, exact) {
  if (Number.isNaN(written) || Number.isNaN(exact)) return Number.isNaN(written) && Number.isNaN(exact);
  if (exact === 0) return written === 0;
  const unit = 10 ** (Math.floor(Math.log10(Math.abs(exact))) - 5);
  return Math.abs(written - exact) <= 0.5 * unit * (1 + 1e-6);
}

function reason({ episode, step, ok }, view) {
  if (ok === UNKNOWN) return "outcome not computed";
  if (step >= view.horizon) return "never handed over";
  const alone = episode.part.alone[episode.row];
  if (alone) return "harm: alone the learner succeeds";
  if (step < episode.onset) return "handed over before the onset";
  const last = episode.part.last ? episode.part.last[episode.row] : -2;
  if (last === -1) return "nothing saves it";
  return last >= 0 && step > last ? "handed over too late" : "handed over, yet lost";
}

function episodeName({ learner, seed, onset }) {
  return `learner ${learner} · seed ${seed} · ${onset < 0 ? "undisturbed" : "disturbed"}`;
}

function showFails(scores, view) {
  const failed = [];
  scores.results.forEach((result, index) => result.ok === 0 && failed.push([index, result]));
  $("fails-title").textContent = failed.length === 1 ? "1 episode fails" : `${failed.length} episodes fail`;
  const entries = failed.map(([index, result]) => {
    const { learner, seed, onset } = result.episode;
    return new Option(`learner ${learner} · ${seed} · ${onset < 0 ? "undisturbed · " : ""}${reason(result, view)}`, index);
  });
  $("fails").replaceChildren(...entries);
  $("fails").hidden = !failed.length;
  $("fails-how").textContent = failed.length ? "Learner, seed and reason. Choose one to see it below."
    : "Every episode succeeds at this threshold.";
}

function drawMosaic(state) {
  const { view } = state;
  const box = $("mosaic");
  const groups = new Map();
  view.episodes.forEach((episode, index) => {
    const name = `learner ${episode.learner}, ${episode.onset < 0 ? "undisturbed" : "disturbed"}`;
    if (!groups.has(name)) groups.set(name, []);
    groups.get(name).push(html("i", { "data-index": index, class: "tile", title: episodeName(episode) }));
  });
  box.replaceChildren(...[...groups].map(([name, tiles]) =>
    html("div", {}, html("span", {}, name), html("div", {}, tiles))));
  state.tiles = [];
  for (const tile of box.querySelectorAll("i")) state.tiles[tile.dataset.index] = tile;
}

function paintMosaic(scores) {
  const { tiles, view } = state;
  scores.results.forEach(({ ok, step }, index) => {
    const css = `tile ${["no", "ok", "maybe"][ok]}${step < view.horizon ? " handed" : ""}`;
    if (tiles[index].className !== css) tiles[index].className = css;
  });
}
