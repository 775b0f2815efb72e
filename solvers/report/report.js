const content = id => document.getElementById(id).textContent;
const dark = matchMedia("(prefers-color-scheme: dark)");
const narrow = matchMedia("(max-width: 600px)");
let figures, settings;

// The figures in the colours of the page, which follow the reader's system; view and legend are kept.
function draw() {
  const style = getComputedStyle(document.documentElement);
  const [ink, line] = ["--ink", "--line"].map(name => style.getPropertyValue(name).trim());
  const visible = colour => dark.matches && colour === "#000000" ? "#ffffff" : colour;
  for (const [id, figure] of Object.entries(figures)) {
    const layout = structuredClone(figure.layout);
    const flat = Object.keys(layout).filter(name => /^[xy]axis/.test(name)).map(name => layout[name]);
    const scene = layout.scene ? [layout.scene.xaxis, layout.scene.yaxis, layout.scene.zaxis] : [];
    for (const axis of [...flat, ...scene]) Object.assign(axis, {gridcolor: line, linecolor: line, zerolinecolor: line});
    Object.assign(layout, {paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", uirevision: "kept"});
    layout.modebar = {bgcolor: "rgba(0,0,0,0)", color: line, activecolor: ink};
    layout.font = {...layout.font, color: ink, size: narrow.matches ? 10 : 12};
    if (narrow.matches && layout.legend?.y < 0) layout.legend.y *= 1.8;
    layout.margin = {...layout.margin, t: 34, ...(narrow.matches ? {l: 48, r: 4} : {})};
    const data = figure.data.map(trace => ({
      ...trace,
      line: {...trace.line, color: visible(trace.line?.color)},
      marker: {...trace.marker, color: visible(trace.marker?.color)},
    }));
    Plotly.react(id, data, layout, settings);
  }
}

function parseLibrary() {
  performance.mark("library");
  const library = document.createElement("script");
  library.textContent = content("library");
  document.head.append(library);
  [figures, settings] = ["figures", "settings"].map(id => JSON.parse(content(id)));
  draw();
  for (const query of [dark, narrow]) query.addEventListener("change", draw);
}

// The page is painted before the library, most of the file, is parsed.
requestAnimationFrame(() => {
  performance.mark("frame");
  setTimeout(parseLibrary);
});

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => {
    const up = head.getAttribute("aria-sort") === "descending";
    heads.forEach(other => other.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", up ? "ascending" : "descending");
    const key = row => row.cells[column].dataset.value;
    const numeric = [...table.tBodies[0].rows].every(row => key(row) !== "" && isFinite(key(row)));
    const compare = numeric ? (a, b) => key(a) - key(b) : (a, b) => key(a).localeCompare(key(b), "en", {numeric: true});
    const rows = [...table.tBodies[0].rows].sort((a, b) => up ? compare(a, b) : compare(b, a));
    table.tBodies[0].append(...rows);
  }));
}
