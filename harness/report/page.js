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
  // a table that is too wide becomes denser, and then cards
  const wide = [...document.querySelectorAll(".scroll > table")];
  const fit = () => {
    for (const table of wide) table.classList.remove("dense", "cards");
    for (const kind of ["dense", "cards"]) {
      for (const table of wide.filter(candidate => candidate.scrollWidth > candidate.parentNode.clientWidth + 1)) {
        const titles = table.tHead ? [...table.tHead.rows[0].cells].map(cell => cell.textContent) : [];
        for (const row of table.tBodies[0].rows) [...row.cells].forEach((cell, k) => { cell.dataset.title = titles[k] || ""; });
        table.classList.add(kind);
      }
    }
  };
  addEventListener("resize", fit);
  // on a narrow screen, each section but the first opens with a tap on its heading
  const narrow = matchMedia("screen and (max-width: 720px)");
  const contentOf = head => {
    const content = [];
    for (let next = head.nextElementSibling; next; next = next.nextElementSibling) {
      if (next.matches("h2") || next.querySelector("h2")) break;
      content.push(next);
    }
    return content;
  };
  const setOpen = (head, isOpen) => {
    head.setAttribute("aria-expanded", isOpen);
    for (const element of contentOf(head)) element.classList.toggle("folded", !isOpen);
    if (isOpen) fit();  // which cannot measure what is folded
  };
  const foldSections = () => {
    for (const [k, head] of heads.entries()) setOpen(head, k === 0 || !narrow.matches);
    for (const head of heads) head.tabIndex = narrow.matches ? 0 : -1;
  };
  const toggle = head => narrow.matches && setOpen(head, head.getAttribute("aria-expanded") !== "true");
  for (const head of heads) {
    head.setAttribute("role", "button");
    head.addEventListener("click", () => toggle(head));
    head.addEventListener("keydown", event => event.key === "Enter" && toggle(head));
  }
  nav.addEventListener("click", event => {
    const head = heads.find(candidate => event.target.hash === "#" + candidate.id);
    if (head) setOpen(head, true);
  });
  narrow.addEventListener("change", foldSections);
  const number = text => parseFloat(text.replace("\u2212", "-").replace(/^[>\u2264\u00a0 ]+/, ""));
  // a table of more rows than `most` shows the first half of these; paper has all
  const most = narrow.matches ? 8 : 24;
  for (const table of document.querySelectorAll("main table")) {
    const body = table.tBodies[0], rows = body ? [...body.rows] : [], titles = table.tHead ? [...table.tHead.rows[0].cells] : [];
    const simple = rows.every(row => row.cells.length === titles.length && [...row.cells].every(cell => cell.rowSpan === 1));
    if (rows.length < 6 || !simple || table.tHead.rows.length > 1) continue;
    let words = [], showsAll = rows.length <= most;
    const show = () => {
      let count = 0;
      for (const row of body.rows) {
        const matches = words.every(word => row.textContent.toLowerCase().includes(word));
        row.hidden = !matches;
        row.classList.toggle("further", !showsAll && matches && count >= most / 2);
        count += matches;
      }
    };
    for (const [k, title] of titles.entries()) {
      const sort = () => {
        const up = title.getAttribute("aria-sort") !== "ascending";
        titles.forEach(other => other.removeAttribute("aria-sort"));
        title.setAttribute("aria-sort", up ? "ascending" : "descending");
        const key = row => row.cells[k].textContent.trim();
        const numeric = rows.some(row => Number.isFinite(number(key(row))));
        const last = value => Number.isFinite(value) ? value : Infinity;
        const order = (a, b) => numeric ? last(number(key(a))) - last(number(key(b))) : key(a).localeCompare(key(b));
        body.append(...[...rows].sort((a, b) => (up ? 1 : -1) * (order(a, b) || rows.indexOf(a) - rows.indexOf(b))));
        show();
      };
      title.tabIndex = 0;
      title.title = "sort";
      title.addEventListener("click", sort);
      title.addEventListener("keydown", event => event.key === "Enter" && sort());
    }
    if (rows.length <= most / 2) continue;
    const filter = document.createElement("input");
    filter.placeholder = "show rows with ...";
    filter.setAttribute("aria-label", "show rows with these words");
    filter.addEventListener("input", () => {
      words = filter.value.toLowerCase().split(/\s+/);
      show();
    });
    table.before(filter);
    if (showsAll) continue;
    const button = document.createElement("button");
    button.textContent = `show all ${rows.length} rows`;
    button.addEventListener("click", () => {
      showsAll = true;
      button.remove();
      show();
    });
    table.after(button);
    show();
  }
  foldSections();
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
      const values = panel.lines.map(([name, ...at]) => {
        let best = 0;
        for (let k = 4; k < at.length; k += 4) if (Math.abs(at[k] - x) < Math.abs(at[best] - x)) best = k;
        return { name, off: Math.abs(at[best] - x), x: at[best + 2], y: at[best + 3] };
      }).sort((a, b) => a.off - b.off);
      const nearest = values.filter(value => value.off <= values[0].off + 4);
      tip.textContent = [`${panel.x} ${short(nearest[0].x)}`, ...nearest.map(value => `${short(value.y)}  ${value.name}`)].join("\n");
      tip.style.left = `${Math.min(event.pageX + 14, document.documentElement.clientWidth - tip.offsetWidth - 8)}px`;
      tip.style.top = `${event.pageY + 14}px`;
    });
    svg.addEventListener("pointerleave", () => { tip.hidden = true; });
  }
}
