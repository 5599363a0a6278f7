"use strict";
// A list of contents from the headings, and tables whose rows can be sorted and filtered. Without it nothing is lost.
{
  const heads = [...document.querySelectorAll("main h2")];
  const nav = document.getElementById("contents");
  if (heads.length > 2) for (const [k, head] of heads.entries()) {
    head.id = head.id || `part-${k + 1}`;
    const link = document.createElement("a");
    link.href = "#" + head.id;
    link.textContent = head.textContent;
    nav.append(link);
  }
  const number = text => parseFloat(text.replace("\u2212", "-").replace(/^[>\u2264\u00a0 ]+/, ""));
  for (const table of document.querySelectorAll("main table")) {
    const body = table.tBodies[0], rows = body ? [...body.rows] : [], titles = table.tHead ? [...table.tHead.rows[0].cells] : [];
    const simple = rows.every(row => row.cells.length === titles.length && [...row.cells].every(cell => cell.rowSpan === 1));
    if (rows.length < 6 || !simple || table.tHead.rows.length > 1) continue;
    for (const [k, title] of titles.entries()) {
      const sort = () => {
        const up = title.getAttribute("aria-sort") !== "ascending";
        titles.forEach(each => each.removeAttribute("aria-sort"));
        title.setAttribute("aria-sort", up ? "ascending" : "descending");
        const key = row => row.cells[k].textContent.trim();
        const numeric = rows.some(row => Number.isFinite(number(key(row))));
        const last = value => Number.isFinite(value) ? value : Infinity;
        const order = (a, b) => numeric ? last(number(key(a))) - last(number(key(b))) : key(a).localeCompare(key(b));
        body.append(...[...rows].sort((a, b) => (up ? 1 : -1) * (order(a, b) || rows.indexOf(a) - rows.indexOf(b))));
      };
      title.tabIndex = 0;
      title.title = "sort";
      title.addEventListener("click", sort);
      title.addEventListener("keydown", event => event.key === "Enter" && sort());
    }
    if (rows.length < 12) continue;
    const filter = document.createElement("input");
    filter.placeholder = "show rows with ...";
    filter.setAttribute("aria-label", "show rows with these words");
    filter.addEventListener("input", () => {
      const words = filter.value.toLowerCase().split(/\s+/);
      for (const row of rows) row.hidden = !words.every(word => row.textContent.toLowerCase().includes(word));
    });
    table.before(filter);
  }
}
