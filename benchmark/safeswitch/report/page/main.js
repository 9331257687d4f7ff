// The page's state, and what happens when something is chosen.

const state = { method: null, signal: "total", learner: -1, sort: { key: "return_mean", down: true } };
const tasks = {};

function cellTitle(cell) {
  if (cell.severity) return `${cell.disturbance}, severity ${cell.severity}`;
  return cell.disturbance === "none" ? "no disturbance" : cell.disturbance;
}

async function chooseTask(name) {
  tasks[name] = tasks[name] || (await loadTask(name));
  Object.assign(state, { task: tasks[name], method: null });
  const { made } = state.task;
  $("made").textContent = made.commit ? `${name}: made by the ${made.profile} profile at commit ${made.commit.slice(0, 12)}, ${made.made}.` : "";
  const tags = { paper: "the paper’s", benign: "benign", "held-out": "held out" };
  options($("cell"), state.task.cells.map((cell) => [cell.name, cellTitle(cell) + (tags[cell.tag] ? ` (${tags[cell.tag]})` : "")]));
  const exact = state.task.exact;
  if (exact) {
    options($("learner"), [...(exact.learners.length > 1 ? [[-1, `all ${exact.learners.length}`]] : []),
      ...exact.learners.map((seed) => [seed, `seed ${seed}`])]);
    state.learner = Number($("learner").value);
    options($("signal"), exact.signals.map((signal) => [signal.name, signal.name]));
    const named = exact.signals.some((signal) => signal.name === state.signal);
    state.signal = named ? state.signal : exact.signals[0].name;
    $("signal").value = state.signal;
  }
  chooseCell(state.task.cells[0].name);
  document.documentElement.dataset.task = name;
}

function chooseCell(name) {
  state.cell = state.task.cells.find((cell) => cell.name === name);
  $("cell").value = name;
  const protocols = Object.keys(state.cell.boards);
  if (!protocols.includes(state.protocol)) state.protocol = protocols[protocols.length - 1];
  for (const input of $("protocol").querySelectorAll("input")) {
    input.disabled = !protocols.includes(input.value);
    input.checked = input.value === state.protocol;
  }
  const arming = { onset: "The rule is asked from the onset of the disturbance on, as in the paper: every episode is disturbed.",
    start: state.cell.severity ? "The rule is asked from the first step on, as deployed: half of the episodes are undisturbed, so false alarms cost."
      : "The rule is asked from the first step on, and nothing ever happens: every handover is a false alarm." };
  $("about").textContent = [state.cell.about && `${capital(state.cell.about)}.`.replace("..", "."), arming[state.protocol]].filter(Boolean).join(" ");
  state.board = state.cell.boards[state.protocol];
  if (!state.board.rows.some((row) => row.method === state.method)) startWith(bestCEM(state.board));
  chooseView();
}

// The page opens on the paper's rule, on the signal that suits it best here.
function bestCEM(board) {
  const rows = board.rows.filter((row) => row.method.startsWith("cem@"));
  return rows.reduce((a, b) => (b.return_mean > a.return_mean ? b : a), rows[0] || board.rows[0]).method;
}

function startWith(method) {
  state.method = method;
  const signal = method.split("@")[1];
  if (state.task.exact && state.task.exact.signals.some((each) => each.name === signal)) state.signal = $("signal").value = signal;
}

function capital(words) {
  return words.charAt(0).toUpperCase() + words.slice(1);
}

// The exact tables of what is chosen, if they were published.
function chooseView() {
  const exact = state.task.exact;
  const there = Boolean(exact && exact.views.some(([cell, protocol]) => cell === state.cell.name && protocol === state.protocol));
  $("exact").hidden = !there;
  $("no-exact").hidden = there;
  for (const place of document.querySelectorAll(".signal-name")) place.textContent = state.signal;
  if (!there) {
    const places = exact ? [...new Set(exact.views.map(([cell]) => cell))].join(", ") : "";
    $("no-exact").textContent = exact ? `Handover tables are published for these cells: ${places}.`
      : "This folder has no handover tables: run the benchmark again to write them.";
    Object.assign(state, { view: null, sweep: null, mark: null, marks: [], planeNow: () => {} });
    drawEpisodes(state);
    drawEverything();
    return;
  }
  state.view = new View(state.task, state.cell.name, state.protocol, state.signal, state.learner);
  state.sweep = makeSweep(state.view);
  state.marks = marksOf(state.view);
  state.referenceOfView = state.learner < 0 || exact.learners.length === 1 ? reference(state.board) : NaN;
  state.mark = markOf(state.marks, (method) => method === state.method)
    || markOf(state.marks, (method) => method.startsWith("cem@")) || state.marks[0] || null;
  state.threshold = state.mark ? state.mark.value : fromShare(0.5, ...axisOf(state.view));
  drawMosaic(state);
  drawMarkButtons(state);
  drawEverything();
}

function drawEverything() {
  drawBoard(state);
  drawPlane(state);
  if (state.view) {
    drawSweep(state);
    showNow(state);
    drawEpisodes(state);
    fitEpisode();
  }
  if (!$("player").hidden) drawPlayer(state);
}

// At first, and when the episode is of another view: the film, else an episode that the rule saves.
function fitEpisode() {
  const key = `${state.view.cell}/${state.view.protocol}/${state.view.learner}`;
  if (state.shownView === key) return;
  state.shownView = key;
  const filmed = state.task.film && state.task.film.runs ? state.task.film.runs.findIndex((run) => run.driver.startsWith("cem")) : -1;
  if (filmed >= 0) {
    if (!$("episode").value.startsWith("film-") || !state.episode) $("episode").value = `film-${filmed}`;
    return;
  }
  const saved = state.now.results.findIndex(({ episode, ok }) => ok === 1 && !episode.part.alone[episode.row]);
  $("episode").value = String(Math.max(saved, 0));
}

function setThreshold(share) {
  state.mark = null;
  state.threshold = fromShare(share, ...axisOf(state.view));
  moved();
}

function setMark(mark) {
  state.mark = mark;
  state.threshold = mark.value;
  if (state.method !== mark.method) {
    state.method = mark.method;
    drawBoard(state);
    drawPlane(state);
  }
  moved();
}

function moved() {
  const started = performance.now();
  showNow(state);
  if (!$("episode").value.startsWith("film-")) drawPlayer(state);
  state.milliseconds = performance.now() - started;
}

function chooseMethod(method) {
  state.method = method;
  const signal = method.split("@")[1];
  const known = state.view && state.task.exact.signals.some((each) => each.name === signal);
  if (known && signal !== state.signal) {
    state.signal = $("signal").value = signal;
    chooseView();
  } else if (known && state.marks.some((mark) => mark.method === method)) {
    state.mark = markOf(state.marks, (each) => each === method);
    state.threshold = state.mark.value;
    drawEverything();
  } else {
    drawBoard(state);
    drawPlane(state);
    if (state.view) showNow(state);
  }
  const again = [...document.querySelectorAll("#table .method")].find((button) => button.textContent === method);
  if (again && document.activeElement === document.body) again.focus({ preventScroll: true });
}

function openEpisode(index, scroll) {
  $("episode").value = String(index);
  drawPlayer(state);
  if (scroll) $("player").scrollIntoView({ behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth" });
}

function setTheme(dark, remember) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  $("theme").setAttribute("aria-pressed", String(dark));
  if (remember)
    try {
      localStorage.setItem("safeswitch-theme", dark ? "dark" : "light");
    } catch {} // a page from a file may have no storage
}

function listen() {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let own = null;
  try {
    own = localStorage.getItem("safeswitch-theme");
  } catch {}
  setTheme(own ? own === "dark" : dark.matches);
  dark.addEventListener("change", () => own || setTheme(dark.matches));
  $("theme").addEventListener("click", () => setTheme(document.documentElement.dataset.theme !== "dark", (own = true)));
  $("task").addEventListener("change", () => chooseTask($("task").value));
  $("cell").addEventListener("change", () => chooseCell($("cell").value));
  $("protocol").addEventListener("change", (event) => {
    state.protocol = event.target.value;
    chooseCell(state.cell.name);
  });
  $("signal").addEventListener("change", () => {
    state.signal = $("signal").value;
    const same = state.marks.find((mark) => mark.method === state.method);
    if (same) state.method = `${same.method.split("@")[0]}@${state.signal}`;
    chooseView();
  });
  $("learner").addEventListener("change", () => {
    state.learner = Number($("learner").value);
    chooseView();
  });
  $("slider").addEventListener("input", () => setThreshold($("slider").value / POSITIONS));
  for (const id of ["show", "find"]) $(id).addEventListener("input", () => drawBoard(state));
  $("fails").addEventListener("change", () => openEpisode($("fails").value, false));
  $("fails").addEventListener("dblclick", () => $("fails").value && openEpisode($("fails").value, true));
  $("fails").addEventListener("keydown", (event) => event.key === "Enter" && $("fails").value && openEpisode($("fails").value, true));
  $("mosaic").addEventListener("click", (event) => event.target.dataset.index && openEpisode(event.target.dataset.index, true));
  $("episode").addEventListener("change", () => drawPlayer(state));
  $("play").addEventListener("click", () => play(state));
  $("time").addEventListener("input", () => {
    stop(state);
    setTime(state, Number($("time").value));
  });
  let width = innerWidth;
  addEventListener("resize", () => {
    if (width === innerWidth) return;
    width = innerWidth;
    drawEverything();
  });
  addEventListener("keydown", (event) => event.key === "Escape" && hideTip());
  addEventListener("submit", (event) => event.preventDefault());
}

async function main() {
  const names = [...document.querySelectorAll('script[data-part="json"]')].map((part) => part.dataset.task);
  options($("task"), names.map((name) => [name, name]));
  listen();
  await chooseTask(names[0]);
  document.documentElement.dataset.ready = Math.round(performance.now());
}

main();
