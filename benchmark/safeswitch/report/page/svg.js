// Small parts of pictures and text: elements, scales, ticks, families of methods.

const $ = (id) => document.getElementById(id);

function svg(name, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function html(name, attributes = {}, ...children) {
  return filled(document.createElement(name), attributes, children);
}

function filled(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) if (value != null) element.setAttribute(key, value);
  element.append(...children.flat().filter((child) => child != null));
  return element;
}

function options(select, entries, chosen) {
  select.replaceChildren(
    ...entries.map(([value, text]) => filled(new Option(text, value, false, String(value) === String(chosen)), {}, []))
  );
}

function scale(from, to, low, high, logarithmic = false) {
  const at = (value) => from + (to - from) * toShare(value, low, high, logarithmic);
  at.back = (place) => fromShare((place - from) / (to - from), low, high, logarithmic);
  Object.assign(at, { low, high, logarithmic, from, to });
  return at;
}

function ticks(at, wanted = 5) {
  const { low, high, logarithmic } = at;
  if (logarithmic && high / low >= 3) {
    const found = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
      for (const digit of high / low < 2000 ? [1, 2, 5] : [1]) {
        const value = digit * 10 ** power;
        if (value >= low && value <= high) found.push(value);
      }
    return found;
  }
  const raw = (high - low) / wanted;
  const unit = 10 ** Math.floor(Math.log10(raw));
  const step = unit * ([1, 2, 5].find((digit) => digit * unit >= raw) || 10);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return found;
}

function text(value, digits = 3) {
  if (Number.isNaN(value)) return "–";
  if (!Number.isFinite(value)) return value > 0 ? "∞" : "−∞";
  const short = Number(value.toPrecision(digits));
  const tiny = short !== 0 && Math.abs(short) < 1e-4; // as 2e−6, which is not wider than the room beside an axis
  const plain = Math.abs(value) >= 1e4 ? value.toFixed(0) : tiny ? short.toExponential() : short.toString();
  return plain.replace("-", "−");
}

function fixed(value, digits) {
  return Number.isNaN(value) ? "–" : value.toFixed(digits).replace("-", "−");
}

// Width of words in a chart [px]; fonts differ between machines.
const PEN = document.createElement("canvas").getContext("2d");
function widthOf(words, style = "12px") {
  PEN.font = `${style} ${getComputedStyle(document.body).fontFamily}`;
  return PEN.measureText(words).width;
}

// The first of some names, longest first, that fits in a width [px]; the last if none does.
function fitting(names, width) {
  return names.find((name) => widthOf(name, "italic 12px") <= width) ?? names.at(-1);
}

// Axes of a chart: grid, tick labels, names; of a list of names for x, the longest for which there is room.
function axes(root, x, y, { xName, yName, xText = text, yText = text, xTicks = 6, yTicks = 5 }) {
  const grid = svg("g", { class: "grid" });
  let written = -Infinity; // where the last number ends: one that has no room is left out, its line is drawn
  for (const value of ticks(x, xTicks)) {
    grid.append(svg("line", { x1: x(value), x2: x(value), y1: y.from, y2: y.to }));
    const half = widthOf(xText(value)) / 2;
    if (x(value) - half < written + 3) continue;
    written = x(value) + half;
    grid.append(svg("text", { x: x(value), y: y.from + 16, "text-anchor": "middle" }, xText(value)));
  }
  for (const value of ticks(y, yTicks)) {
    grid.append(svg("line", { x1: x.from, x2: x.to, y1: y(value), y2: y(value) }));
    grid.append(svg("text", { x: x.from - 8, y: y(value) + 4, "text-anchor": "end" }, yText(value)));
  }
  if (xName) grid.append(svg("text", { x: x.to, y: y.from + 33, "text-anchor": "end", class: "axis" },
    fitting([xName].flat(), x.to)));
  if (yName) grid.append(svg("text", { x: x.from - 8, y: y.to - 10, "text-anchor": "start", class: "axis", dx: -30 }, yName));
  root.append(grid);
}

function line(x, y, xs, ys, attributes) {
  let path = "";
  let pen = false;
  xs.forEach((value, i) => {
    if (Number.isNaN(ys[i])) pen = false;
    else {
      path += `${pen ? "L" : "M"}${x(value).toFixed(1)} ${y(ys[i]).toFixed(1)}`;
      pen = true;
    }
  });
  return svg("path", { d: path, fill: "none", ...attributes });
}

// Families of methods: colour and shape say the same.
const FAMILIES = [
  { name: "CEM (the paper)", css: "cem", shape: "diamond", has: (rule) => rule.startsWith("cem") },
  { name: "set by hand", css: "hand", shape: "square", has: (rule) => rule.startsWith("fixed") },
  { name: "search at the same budget", css: "search", shape: "triangle", has: (rule) => /^(grid|random-search)$/.test(rule) },
  { name: "bound, privileged", css: "bound", shape: "star", has: (rule) => /^(best|oracle-)/.test(rule) },
  { name: "learner alone", css: "learner", shape: "circle", has: (rule) => rule === "learner" },
  { name: "expert alone", css: "expert", shape: "circle", has: (rule) => rule === "expert" },
  { name: "control without information", css: "control", shape: "cross", has: (rule) => /^(timer|random|periodic|shuffled)$/.test(rule) },
  { name: "other rule", css: "other", shape: "wedge", has: () => true },
];

function family(method) {
  const rule = method.split("@")[0];
  return FAMILIES.find((each) => each.has(rule));
}

const SHAPES = {
  circle: "M-4.5 0a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0 -9 0Z",
  square: "M-4 -4H4V4H-4Z",
  diamond: "M0 -6L5.5 0L0 6L-5.5 0Z",
  triangle: "M0 -5.5L5.2 4H-5.2Z",
  wedge: "M0 5.5L5.2 -4H-5.2Z",
  star: "M0 -6.5L1.7 -2L6.3 -2L2.6 .9L4 5.4L0 2.7L-4 5.4L-2.6 .9L-6.3 -2L-1.7 -2Z",
  cross: "M-4.5 -2.5L-2.5 -4.5L0 -2L2.5 -4.5L4.5 -2.5L2 0L4.5 2.5L2.5 4.5L0 2L-2.5 4.5L-4.5 2.5L-2 0Z",
};

function glyph(method) {
  const { css, shape } = family(method);
  return svg("path", { d: SHAPES[shape], class: `glyph ${css}` });
}

function showTip(content, x, y) {
  const tip = $("tip");
  tip.replaceChildren(...content);
  tip.hidden = false;
  const box = tip.getBoundingClientRect();
  tip.style.left = `${Math.max(8, Math.min(x + 14, document.documentElement.clientWidth - box.width - 8))}px`;
  tip.style.top = `${y + 18 + box.height > innerHeight ? y - box.height - 12 : y + 18}px`;
}

function hideTip() {
  $("tip").hidden = true;
}
