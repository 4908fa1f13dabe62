"use strict";
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.querySelectorAll("thead tr:last-child th")], body = table.tBodies[0];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    const value = (row) => {
      const cell = row.cells[column], text = cell.dataset.value ?? cell.textContent.trim(), number = parseFloat(text.replace("<", ""));
      return Number.isNaN(number) ? text : number;
    };
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach((one) => one.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const compare = (a, b) => (typeof a === typeof b ? (a < b ? -1 : a > b ? 1 : 0) : typeof a === "number" ? -1 : 1);
      [...body.rows].sort((one, other) => (up ? 1 : -1) * compare(value(one), value(other))).forEach((row) => body.append(row));
    });
  });
}
function open() {
  const target = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let one = target; one; one = one.parentElement) if (one.tagName === "DETAILS") one.open = true;
  target.scrollIntoView();
}
addEventListener("hashchange", open);
document.addEventListener("click", (event) => {
  const row = event.target.closest("tr[data-opens]"), link = event.target.closest("a[href^='#']");
  if (link && link.getAttribute("href") === location.hash) open();
  if (row && !event.target.closest("a")) { if (location.hash === `#${row.dataset.opens}`) open(); else location.hash = row.dataset.opens; }
});
let closed = [];
addEventListener("beforeprint", () => { closed = [...document.querySelectorAll("details:not([open])")]; closed.forEach((one) => { one.open = true; }); });
addEventListener("afterprint", () => closed.forEach((one) => { one.open = false; }));
open();
