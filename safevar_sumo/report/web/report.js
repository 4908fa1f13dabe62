"use strict";
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.querySelectorAll("thead tr:last-child th")], body = table.tBodies[0];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    const value = (row) => {
      const cell = row.cells[column], text = cell.textContent.trim(), number = parseFloat(text.replace("<", ""));
      return Number.isNaN(number) ? text : number;
    };
    button.addEventListener("click", () => {
      const ascending = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
      const compare = (a, b) => (typeof a === typeof b ? (a < b ? -1 : a > b ? 1 : 0) : typeof a === "number" ? -1 : 1);
      [...body.rows].sort((a, b) => (ascending ? 1 : -1) * compare(value(a), value(b))).forEach((row) => body.append(row));
    });
  });
}
function openTarget() {
  const target = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let element = target; element; element = element.parentElement) if (element.tagName === "DETAILS") element.open = true;
  target.scrollIntoView();
}
addEventListener("hashchange", openTarget);
document.addEventListener("click", (event) => {
  const row = event.target.closest("tr[data-opens]"), link = event.target.closest("a[href^='#']");
  if (link && link.getAttribute("href") === location.hash) openTarget();
  if (!row || event.target.closest("a")) return;
  if (location.hash === `#${row.dataset.opens}`) openTarget(); else location.hash = row.dataset.opens;
});
let closedDetails = [];
addEventListener("beforeprint", () => {
  closedDetails = [...document.querySelectorAll("details:not([open])")];
  closedDetails.forEach((details) => { details.open = true; });
});
addEventListener("afterprint", () => closedDetails.forEach((details) => { details.open = false; }));
openTarget();
