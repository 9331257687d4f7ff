// Unpacks a task's two blocks, and scores any threshold on its handover tables as handover/panel.py does.

const KINDS = { uint8: Uint8Array, int16: Int16Array, int32: Int32Array, float32: Float32Array };
const PHI = 5;
const UNKNOWN = 2;

async function unpack(task, part) {
  const text = atob(document.querySelector(`script[data-task="${task}"][data-part="${part}"]`).textContent);
  const packed = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) packed[i] = text.charCodeAt(i);
  return new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

async function loadTask(name) {
  const [json, arrays] = await Promise.all([unpack(name, "json"), unpack(name, "arrays")]);
  const task = JSON.parse(new TextDecoder().decode(json));
  for (const cell of task.cells)
    for (const board of Object.values(cell.boards))
      board.rows = board.rows.map(([method, on, ...numbers]) => {
        const row = { method, on, traits: task.methods[method] || [] };
        task.columns.forEach((column, i) => (row[column] = number(numbers[i])));
        return row;
      });
  task.array = (key) => {
    const [kind, offset, size] = task.arrays[key];
    return new KINDS[kind](arrays, offset, size);
  };
  task.has = (key) => Boolean(task.arrays && task.arrays[key]);
  return task;
}

// JSON has no infinities: they are written as words, and what is missing as null.
function number(value) {
  if (value === null) return NaN;
  return value === "inf" ? Infinity : value === "-inf" ? -Infinity : value;
}

// The episodes of a cell under an arming, of all learners or one, with the records of one signal.
class View {
  constructor(task, cell, protocol, signal, learner) {
    const exact = task.exact;
    Object.assign(this, { task, cell, protocol, signal, learner, horizon: exact.horizon, episodes: [] });
    const cells = protocol === "start" && cell !== exact.none ? [cell, exact.none] : [cell];
    this.parts = cells.map((name) => this.part(name));
    exact.learners.forEach((seed, place) => {
      if (learner >= 0 && seed !== learner) return;
      this.parts.forEach((part, index) => {
        const count = exact.cells[part.name];
        for (let row = place * count; row < (place + 1) * count; row++)
          this.episodes.push({ part, index, row, place, learner: seed, seed: part.seed[row], onset: part.onset[row] });
      });
    });
    this.size = this.episodes.length;
    this.undisturbed = this.episodes.filter((episode) => episode.onset < 0).length;
  }

  part(name) {
    const key = (what) => this.task.array(`${name}/${what}`);
    const records = (what) => key(`${this.protocol}/${this.signal}/${what}`);
    const [count, step, value] = [records("count"), records("step"), records("value")];
    const from = new Int32Array(count.length + 1);
    count.forEach((n, i) => (from[i + 1] = from[i] + n));
    const table = { name, from, step, value, trace: key(`${this.signal}/trace`) };
    for (const what of ["seed", "onset", "length", "alone", "outcome"]) table[what] = key(what);
    for (const what of ["first", "last"]) table[what] = this.task.has(`${name}/${what}`) ? key(what) : null;
    return table;
  }

  // First step of the expert; T where the threshold is never passed, or only as the episode ends.
  handover({ part, row }, threshold) {
    let low = part.from[row];
    let high = part.from[row + 1];
    const end = high;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (part.value[middle] > threshold) high = middle;
      else low = middle + 1;
    }
    const step = low < end ? part.step[low] + 1 : this.horizon;
    return step >= part.length[row] ? this.horizon : step;
  }

  // 1 success, 0 failure, 2 not computed.
  outcome({ part, row }, step) {
    return step >= part.length[row] ? part.alone[row] : part.outcome[row * (this.horizon + 1) + step];
  }

  // Scores at one threshold for each learner (an array by place), or at a common one (a number); `each`: what becomes
  // of every episode beside them.
  scores(thresholds, each = false) {
    const common = typeof thresholds === "number";
    const sum = { n: this.size, undisturbed: this.undisturbed, success: 0, unknown: 0, steps: 0, armed: 0, handed: 0,
      false: 0, before: 0 };
    const results = each ? [] : null;
    for (const episode of this.episodes) {
      const { part, row, onset } = episode;
      const step = this.handover(episode, common ? thresholds : thresholds[episode.place]);
      const ok = this.outcome(episode, step);
      const driven = Math.min(step, part.length[row]);
      const handed = step < this.horizon;
      if (ok === UNKNOWN) sum.unknown++;
      else sum.success += ok;
      sum.steps += driven;
      sum.armed += Math.max(driven - (this.protocol === "onset" ? onset : 0), 0);
      if (handed) {
        sum.handed++;
        if (onset < 0) sum.false++;
        else if (step < onset) sum.before++;
      }
      if (results) results.push({ episode, step, ok });
    }
    return { ...this.shares(sum), sum, results };
  }

  shares(sum) {
    const disturbed = sum.n - sum.undisturbed;
    return {
      success: sum.unknown ? NaN : sum.success / sum.n,
      autonomy: sum.steps / sum.n / this.horizon,
      return_mean: sum.unknown ? NaN : sum.armed / sum.n / this.horizon + (PHI * sum.success) / sum.n,
      false_alarms: sum.undisturbed ? sum.false / sum.undisturbed : NaN,
      false_alarms_before_onset: disturbed ? sum.before / disturbed : NaN,
      handovers: sum.handed / sum.n,
    };
  }

  // Signal of an episode from its levels: exact to a 254th of the axis, for drawing only.
  trace({ part, row }) {
    const [low, high, logarithmic] = this.axis;
    return Array.from({ length: this.horizon }, (_, step) => {
      const level = part.trace[row * this.horizon + step];
      return level === 255 ? NaN : fromShare(level / 254, low, high, logarithmic);
    });
  }

  get about() {
    return this.task.exact.signals.find((signal) => signal.name === this.signal);
  }

  get axis() {
    return this.about.axis;
  }
}

function fromShare(share, low, high, logarithmic) {
  return logarithmic ? low * Math.pow(high / low, share) : low + share * (high - low);
}

function toShare(value, low, high, logarithmic) {
  return logarithmic ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const middle = sorted.length >> 1;
  return sorted.length % 2 ? sorted[middle] : (sorted[middle - 1] + sorted[middle]) / 2;
}
