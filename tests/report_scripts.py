"""What the tests of the report ask the page in the browser."""

MARKS = """
const found = [];
for (const mark of state.marks) {
  setMark(mark);
  const boxes = [...$("numbers").children];
  const numbers = Object.fromEntries(boxes.map((box) => [box.dataset.score, Number(box.dataset.value)]));
  found.push({ method: mark.method, on: mark.on, numbers, check: $("check").textContent,
    shown: $("numbers").querySelector("[data-score=success] dd").textContent });
}
return [state.cell.name, state.protocol, found];
"""
"""What the page shows at each marked threshold: name of the cell, protocol, numbers."""

NAMELESS = """
const named = (each) => each.labels?.length || each.textContent.trim() || each.getAttribute("aria-label")
  || each.getAttribute("aria-labelledby");
const controls = [...document.querySelectorAll("button, input, select")];
return controls.filter((each) => !named(each)).map((each) => each.outerHTML);
"""
"""Controls that a screen reader could not name."""

SPOILT_LABELS = """
const found = [];
for (const chart of document.querySelectorAll(".chart svg")) {
  const frame = chart.getBoundingClientRect();
  const labels = [...chart.querySelectorAll("text")].filter((each) => each.textContent);
  const boxes = labels.map((each) => each.getBoundingClientRect());
  boxes.forEach((box, i) => {
    const whole = box.left > frame.left - 1 && box.right < frame.right + 1 && box.top > frame.top - 1;
    if (!whole) found.push(labels[i].textContent);
    boxes.slice(0, i).forEach((other, j) => {
      const across = Math.min(box.right, other.right) - Math.max(box.left, other.left);
      const down = Math.min(box.bottom, other.bottom) - Math.max(box.top, other.top);
      if (across > 2 && down > 4) found.push(`${labels[j].textContent} | ${labels[i].textContent}`);
    });
  });
}
return found;
"""
"""Labels of charts that are cut off, and pairs that cover each other."""
