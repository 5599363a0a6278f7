"use strict";
// Adds a table of contents, tables that can be sorted and filtered and that fit narrow screens, and values under the
// pointer on charts. All content is also readable without this script.
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
  const wide = [...document.querySelectorAll(".scroll > table")];
  const fit = () => {
    for (const table of wide) table.classList.remove("dense", "cards");
    for (const kind of ["dense", "cards"]) for (const table of wide.filter(each => each.scrollWidth > each.parentNode.clientWidth + 1)) {
      const titles = table.tHead ? [...table.tHead.rows[0].cells].map(cell => cell.textContent) : [];
      for (const row of table.tBodies[0].rows) [...row.cells].forEach((cell, k) => { cell.dataset.title = titles[k] || ""; });
      table.classList.add(kind);
    }
  };
  addEventListener("resize", fit);
  fit();
  const tip = document.createElement("div");
  tip.id = "tip";
  tip.hidden = true;
  document.body.append(tip);
  const short = value => String(Number(value.toPrecision(3)));
  for (const svg of document.querySelectorAll("svg[data-values]")) {
    const panels = JSON.parse(svg.dataset.values);
    svg.addEventListener("pointermove", event => {
      const place = svg.getBoundingClientRect(), scale = svg.viewBox.baseVal.width / place.width;
      const x = (event.clientX - place.left) * scale, y = (event.clientY - place.top) * scale;
      const panel = panels.find(({ box }) => x >= box[0] && y >= box[1] && x <= box[2] && y <= box[3]);
      tip.hidden = !panel;
      if (!panel) return;
      const near = panel.lines.map(([name, ...at]) => {
        let best = 0;
        for (let k = 4; k < at.length; k += 4) if (Math.abs(at[k] - x) < Math.abs(at[best] - x)) best = k;
        return { name, off: Math.abs(at[best] - x), x: at[best + 2], y: at[best + 3] };
      }).sort((a, b) => a.off - b.off);
      const here = near.filter(each => each.off <= near[0].off + 4);
      tip.textContent = [`${panel.x} ${short(here[0].x)}`, ...here.map(each => `${short(each.y)}  ${each.name}`)].join("\n");
      tip.style.left = `${Math.min(event.pageX + 14, document.documentElement.clientWidth - tip.offsetWidth - 8)}px`;
      tip.style.top = `${event.pageY + 14}px`;
    });
    svg.addEventListener("pointerleave", () => { tip.hidden = true; });
  }
}
