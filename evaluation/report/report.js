"use strict";
(() => {
  const all = (selector, root = document) => [...root.querySelectorAll(selector)];
  const rules = document.head.appendChild(document.createElement("style"));
  const filter = document.getElementById("filter");
  const target = document.getElementById("target");
  const chips = all(".chip");

  // What is off is hidden by rules, so that every part of the page follows at once.
  function show() {
    const wanted = filter.value.trim().toLowerCase();
    const hidden = [];
    for (const chip of chips) {
      const matches = chip.dataset.name.toLowerCase().includes(wanted);
      chip.hidden = !matches;
      if (!matches || chip.getAttribute("aria-pressed") === "false") hidden.push(`[data-m="${chip.dataset.chip}"]`);
    }
    if (target.value !== "") hidden.push(`[data-t]:not([data-t="${target.value}"])`);
    rules.textContent = hidden.length ? `${hidden.join(",")}{display:none!important}` : "";
  }
  for (const chip of chips) {
    chip.addEventListener("click", () => {
      chip.setAttribute("aria-pressed", String(chip.getAttribute("aria-pressed") === "false"));
      show();
    });
    // A double click leaves this method alone, or brings all back.
    chip.addEventListener("dblclick", () => {
      const alone = chips.every((c) => c === chip || c.getAttribute("aria-pressed") === "false");
      for (const c of chips) c.setAttribute("aria-pressed", String(alone || c === chip));
      show();
    });
  }
  filter.addEventListener("input", show);
  target.addEventListener("change", show);

  function sort(table, column, header) {
    const descending = header.getAttribute("aria-sort") !== "descending" && !header.classList.contains("name")
      || header.getAttribute("aria-sort") === "ascending";
    for (const other of all("th", table.tHead)) other.removeAttribute("aria-sort");
    header.setAttribute("aria-sort", descending ? "descending" : "ascending");
    const body = table.tBodies[0];
    const value = (row) => row.cells[column].dataset.v;
    const rows = [...body.rows].sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
      const difference = Number.isNaN(Number(x)) || Number.isNaN(Number(y)) ? x.localeCompare(y) : Number(x) - Number(y);
      return descending ? -difference : difference;
    });
    body.append(...rows);
  }
  for (const table of all("table.sortable")) {
    all("th", table.tHead).forEach((header, column) => {
      const button = header.querySelector("button");
      if (button) button.addEventListener("click", () => sort(table, column, header));
    });
  }

  for (const picker of all(".picker select")) {
    const article = picker.closest("article");
    const pick = () => {
      for (const part of all("[data-pick]", article)) part.style.display = part.dataset.pick === picker.value ? "" : "none";
    };
    picker.addEventListener("change", pick);
    pick();
  }
  show();
})();
