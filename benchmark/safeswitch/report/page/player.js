// One episode: the signal's trace with t0, handover, t* and the driver's colour, and the film where there is one.

const TRACE = { height: 269, left: 52, right: 16, top: 63, bottom: 66 };

// Entries of the select: filmed drivers first, then the episodes of the slider's view.
function drawEpisodes(state) {
  const groups = [];
  const film = state.task.film;
  if (film && film.runs)
    groups.push(html("optgroup", { label: `Filmed: seed ${film.seed}, learner ${film.learner}` },
      film.runs.map((run, i) => new Option(`${run.driver}: ${run.success ? "success" : "failure"}`, `film-${i}`))));
  if (state.view)
    groups.push(html("optgroup", { label: `${cellTitle(state.cell)}, at the slider’s threshold` },
      state.view.episodes.map((episode, i) => new Option(episodeName(episode), String(i)))));
  const select = $("episode");
  const before = select.value;
  select.replaceChildren(...groups);
  select.value = before;
  if (select.selectedIndex < 0 && select.options.length) select.selectedIndex = 0;
  drawDrivers(state);
  $("player").hidden = !select.options.length && !(film && film.all);
  const all = $("film");
  all.hidden = !(film && film.all);
  if (film && film.all) {
    $("film-video").src = `${film.base}/${film.all}#t=0.1`;
    all.querySelector("figcaption").textContent = `${state.task.name}: one test episode under each driver, each with its signal.`;
  }
}

// One button a filmed driver, for quick comparison.
function drawDrivers(state) {
  const { runs = [], seed } = state.task.film || {};
  const buttons = runs.map((run, i) => {
    const icon = svg("svg", { viewBox: "-8 -8 16 16", width: 14, height: 14, "aria-hidden": "true" }, glyph(run.driver));
    const button = html("button", { type: "button", "data-film": `film-${i}`, "aria-pressed": "false" }, icon, run.driver,
      html("span", { class: "at" }, run.success ? "succeeds" : "fails"));
    button.addEventListener("click", () => openEpisode(`film-${i}`, false));
    return button;
  });
  if (runs.length) buttons.unshift(html("span", { class: "key" }, `Film of seed ${seed}:`));
  $("drivers").replaceChildren(...buttons);
  $("drivers").hidden = !runs.length;
}

// What is drawn, whichever source it comes from: steps, not seconds.
function chosenEpisode(state) {
  const value = $("episode").value;
  if (value.startsWith("film-")) return filmedEpisode(state.task.film, Number(value.slice(5)), state.task);
  if (!state.view || value === "") return null;
  const { view } = state;
  const { episode, step, ok } = state.now.results[Number(value)];
  const { part, row } = episode;
  const horizon = view.horizon;
  return {
    horizon, signal: view.signal, trace: view.trace(episode), length: part.length[row], onset: episode.onset,
    handover: step, success: ok, alone: part.alone[row], axis: view.axis,
    threshold: state.mark ? state.mark.at[episode.place] : state.threshold,
    first: part.first ? part.first[row] : -1, last: part.last ? part.last[row] : -1,
    outcomes: Array.from({ length: horizon + 1 }, (_, s) => view.outcome(episode, s)),
    counterfactual: true, name: episodeName(episode), arm: view.protocol === "onset" ? episode.onset : 0,
  };
}

function filmedEpisode(film, index, task) {
  const run = film.runs[index];
  const values = film.runs.flatMap((each) => [...each.trace.filter((value) => value !== null), each.threshold ?? NaN])
    .filter((value) => !Number.isNaN(value));
  const [low, high] = [Math.min(...values), Math.max(...values)];
  return {
    horizon: film.horizon, signal: film.signal, trace: run.trace.map(number), length: run.length, onset: run.onset,
    handover: run.handover, success: run.success ? 1 : 0, axis: [low, high, low > 0], threshold: run.threshold ?? NaN,
    first: run.driver === "expert" ? -1 : film.t_first ?? -1, last: run.driver === "expert" ? -1 : film.t_last ?? -1,
    outcomes: null, counterfactual: false, name: `${run.driver} · learner ${film.learner} · seed ${film.seed}`,
    video: `${film.base}/${run.file}`, fps: film.fps, alone: null, dt: task.dt, arm: run.onset,
  };
}

function drawPlayer(state) {
  const episode = chosenEpisode(state);
  state.episode = episode;
  stop(state);
  for (const button of $("drivers").querySelectorAll("button"))
    button.setAttribute("aria-pressed", String(button.dataset.film === $("episode").value));
  $("trace").parentElement.hidden = !episode;
  $("screen").hidden = !(episode && episode.video);
  if (!episode) return;
  const video = $("video");
  if (episode.video && video.getAttribute("src") !== `${episode.video}#t=0.05`) {
    video.src = `${episode.video}#t=0.05`; // a time, so that the first picture is shown at once
    video.setAttribute("aria-label", `Film of the episode: ${episode.name}`);
  }
  if (!episode.video) video.removeAttribute("src");
  drawTrace(state, episode);
  const slider = $("time");
  slider.max = episode.length;
  setTime(state, 0);
  $("story").textContent = storyOf(episode, state.task.dt);
  $("player-how").textContent = episode.counterfactual
    ? "The trace is the learner’s alone. Blue: it drives; orange: the expert would drive instead. The strip below says, for each step, whether handing over there would succeed."
    : "Filmed, with the signal as it was under this driver. Blue: the learner drives; orange: the expert.";
}

function drawTrace(state, episode) {
  const holder = $("trace");
  const width = Math.max(holder.clientWidth, 280);
  const dt = state.task.dt;
  const [low, high, logarithmic] = episode.axis;
  const finite = Number.isFinite(episode.threshold) && (!logarithmic || episode.threshold > 0) ? [episode.threshold] : [];
  const x = scale(TRACE.left, width - TRACE.right, 0, episode.horizon * dt);
  const y = scale(TRACE.height - TRACE.bottom, TRACE.top, Math.min(low, ...finite), Math.max(high, ...finite), logarithmic);
  const root = svg("svg", { viewBox: `0 0 ${width} ${TRACE.height}`, width, height: TRACE.height, role: "img", "aria-labelledby": "story" });
  axes(root, x, y, { yName: episode.signal, yTicks: 4 });
  root.append(svg("text", { class: "axis", x: x.to, y: TRACE.height - 4, "text-anchor": "end" }, "time [s]"));
  const xs = episode.trace.map((_, i) => i * dt);
  const part = (from, to) => episode.trace.map((value, i) => (i >= from && i <= to ? value : NaN));
  const handover = Math.min(episode.handover, episode.length);
  root.append(line(x, y, xs, part(0, handover), { class: "drive learner" }));
  root.append(line(x, y, xs, part(handover, episode.length), { class: `drive expert${episode.counterfactual ? " ghost" : ""}` }));
  if (finite.length) root.append(svg("line", { class: "threshold", x1: x.from, x2: x.to, y1: y(finite[0]), y2: y(finite[0]) }));
  drawStrips(root, episode, x, dt);
  drawEvents(root, episode, x, dt);
  const cursor = svg("line", { class: "time", y1: TRACE.top - 4, y2: TRACE.height - TRACE.bottom + 44 });
  root.append(cursor);
  root.addEventListener("pointerdown", (event) => {
    const share = (event.clientX - root.getBoundingClientRect().left - x.from) / (x.to - x.from);
    stop(state);
    setTime(state, Math.round(share * episode.horizon));
  });
  holder.replaceChildren(root);
  state.cursor = (step) => filled(cursor, { x1: x(step * dt), x2: x(step * dt) }, []);
}

// Who drives, and below it where a handover succeeds.
function drawStrips(root, episode, x, dt) {
  const top = TRACE.height - TRACE.bottom + 22;
  const bar = (from, to, y, height, css, title) => to > from && root.append(svg("rect", { class: css, x: x(from * dt), y,
    width: x(to * dt) - x(from * dt), height }, title && svg("title", {}, title)));
  const name = (words, y) => root.append(svg("text", { x: x.from - 6, y: y + 8, "text-anchor": "end" }, words));
  const handover = Math.min(episode.handover, episode.length);
  name("driver", top);
  bar(0, handover, top, 9, "driver learner", "the learner drives");
  bar(handover, episode.counterfactual ? episode.horizon : episode.length, top, 9, "driver expert", "the expert drives");
  if (!episode.outcomes) return;
  name("saved?", top + 13);
  let from = Math.max(episode.arm, 0);
  for (let s = from + 1; s <= episode.length; s++)
    if (s === episode.length || episode.outcomes[s] !== episode.outcomes[from]) {
      bar(from, s, top + 13, 9, `handing ${["no", "ok", "maybe"][episode.outcomes[from]]}`,
        `handing over here ${["fails", "succeeds", "was not computed"][episode.outcomes[from]]}`);
      from = s;
    }
}

function drawEvents(root, episode, x, dt) {
  const events = [
    ["t₀", episode.onset, "onset"],
    ["handover", episode.handover, "handover"],
    ["t* first", episode.first, "star"],
    ["t* last", episode.last === episode.first ? -1 : episode.last, "star"],
  ].filter(([, step]) => step >= 0 && step < episode.horizon).sort((a, b) => a[1] - b[1]);
  const taken = [[0, x.from - 38 + widthOf(episode.signal, "italic 12px"), 0]]; // the name of the axis
  for (const [name, step, css] of events) {
    const px = x(step * dt);
    const half = widthOf(name, "600 12px") / 2;
    const at = Math.min(px, x.to + TRACE.right - half - 1); // beside its line rather than cut off
    const level = [0, 1, 2, 3].find((row) => !taken.some(([from, to, its]) => its === row && at - half < to + 4 && at + half > from - 4)) ?? 3;
    taken.push([at - half, at + half, level]);
    root.append(svg("line", { class: `event ${css}`, x1: px, x2: px, y1: TRACE.top - 4, y2: TRACE.height - TRACE.bottom }));
    root.append(svg("text", { class: `event ${css}`, x: at, y: TRACE.top - 8 - 13 * level, "text-anchor": "middle" }, name));
  }
}

function storyOf(episode, dt) {
  const at = (step) => `${(step * dt).toFixed(2)} s`;
  const parts = [`${episode.name[0].toUpperCase()}${episode.name.slice(1)}.`];
  parts.push(episode.onset < 0 ? "Nothing disturbs it." : `Disturbed at ${at(episode.onset)}.`);
  if (episode.handover < episode.horizon) parts.push(`The expert takes over at ${at(episode.handover)}.`);
  else parts.push("The learner is never relieved.");
  parts.push(["It fails.", "It succeeds.", "That outcome was not computed."][episode.success]);
  if (episode.alone === 0 && episode.handover < episode.horizon) parts.push(`Alone the learner fails at ${at(episode.length)}.`);
  if (episode.alone === 1 && episode.handover < episode.horizon) parts.push("Alone the learner succeeds.");
  if (episode.alone !== 1 && episode.first >= 0 && episode.first < episode.horizon)
    parts.push(`Up to ${at(episode.first)} every handover would save it.`);
  return parts.join(" ");
}

function setTime(state, step, seek = true) {
  const { episode } = state;
  const now = Math.max(0, Math.min(episode.length, step));
  state.step = now;
  state.cursor(now);
  $("time").value = now;
  const driver = now < episode.handover ? "learner drives" : "expert drives";
  const words = `${(now * state.task.dt).toFixed(2)} s, ${now >= episode.length && episode.handover >= episode.length ? "end" : driver}`;
  $("clock").textContent = words;
  $("time").setAttribute("aria-valuetext", words);
  const video = $("video");
  if (seek && episode.video && video.readyState) video.currentTime = (now + 0.5) / episode.fps;
}

function play(state) {
  if (state.playing) return stop(state);
  const { episode, task } = state;
  const from = state.step >= episode.length ? 0 : state.step;
  setTime(state, from);
  $("play").textContent = "Pause";
  const video = $("video");
  if (episode.video) video.play().catch(() => {});
  const started = performance.now() - from * task.dt * 1000;
  const tick = () => {
    const filmed = episode.video && video.readyState > 1;
    const step = Math.floor(filmed ? video.currentTime * episode.fps : (performance.now() - started) / 1000 / task.dt);
    setTime(state, step, false);
    if (step >= episode.length) stop(state);
    else state.playing = requestAnimationFrame(tick);
  };
  state.playing = requestAnimationFrame(tick);
}

function stop(state) {
  cancelAnimationFrame(state.playing);
  state.playing = 0;
  $("play").textContent = "Play";
  $("video").pause();
}
