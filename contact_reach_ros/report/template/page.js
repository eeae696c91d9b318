"use strict";
(() => {
  const charts = JSON.parse(document.getElementById("charts").textContent);
  const root = document.documentElement;
  const button = document.getElementById("theme");
  const system = window.matchMedia("(prefers-color-scheme: dark)");
  // What is dark on white is light on black.
  const DARK = { "#000000": "#E9ECEF", "#0072B2": "#4DA9E2", "#009E73": "#2FC79B", "#D55E00": "#FF8540",
    "#CC79A7": "#DE95BC", "#555555": "#A3ACB5" };
  const BUTTONS = ["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "autoScale2d", "resetScale2d"];
  let chosen = null;
  try { chosen = localStorage.getItem("contact-reach-theme"); } catch { /* a file may have no storage */ }
  const drawn = new Set();
  // What all time axes show; null for everything.
  let range = charts.length ? [Math.min(...charts.map((chart) => chart.from)), Math.max(...charts.map((chart) => chart.to))] : null;
  let busy = false;

  const dark = () => (chosen ? chosen === "dark" : system.matches);
  const style = (name) => getComputedStyle(root).getPropertyValue(name).trim();

  function recoloured(value) {
    if (!dark()) return value;
    if (typeof value === "string") return DARK[value] || value;
    if (Array.isArray(value)) return value.map(recoloured);
    if (value && typeof value === "object") {
      return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, key === "bdata" ? item : recoloured(item)]));
    }
    return value;
  }

  // Rows that a horizontal legend takes: in one row, or in columns as wide as the longest name.
  function legendRows(chart, width) {
    const letter = width < 480 ? 5.8 : 6.6;
    const widths = chart.data.filter((trace) => trace.showlegend !== false).map((trace) => 50 + letter * (trace.name || "").length);
    if (!widths.length) return 0;
    if (widths.reduce((sum, item) => sum + item, 0) < width - 72) return 1;
    return Math.ceil(widths.length / Math.max(1, Math.floor((width - 72) / Math.max(...widths))));
  }

  function layoutOf(chart, element) {
    const ink = style("--ink"), soft = style("--soft"), line = style("--line");
    const axis = { gridcolor: line, zerolinecolor: line, linecolor: line, tickcolor: line, automargin: true,
      title: { font: { size: 13, color: soft }, standoff: 8 } };
    const layout = recoloured(chart.layout);
    const merged = (own) => ({ ...axis, ...own, title: { ...axis.title, ...(own || {}).title } });
    const narrow = element.clientWidth < 480;
    const base = { ...layout, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", autosize: true,
      font: { color: ink, size: narrow ? 11 : 12, family: getComputedStyle(document.body).fontFamily },
      hoverlabel: { bgcolor: style("--card"), bordercolor: line, font: { color: ink } },
      margin: { l: narrow ? 48 : 60, r: 12, t: 34, b: 52 + 19 * legendRows(chart, element.clientWidth) }, hovermode: "closest", dragmode: "zoom",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: soft, activecolor: ink },
      showlegend: true, uirevision: "kept",
      legend: { orientation: "h", x: 0, yref: "container", y: 0.01, yanchor: "bottom", font: { size: narrow ? 10 : 11.5 } } };
    base.xaxis = merged(layout.xaxis);
    base.yaxis = merged(layout.yaxis);
    if (range) base.xaxis = { ...base.xaxis, range: [...range], autorange: false };
    return base;
  }

  function draw(element) {
    const chart = charts[element.dataset.chart];
    const first = !drawn.has(element);
    drawn.add(element);
    // Long legends do not take the room of the curves.
    element.style.height = `${300 + 19 * Math.max(1, legendRows(chart, element.clientWidth))}px`;
    Plotly.react(element, chart.data.map(recoloured), layoutOf(chart, element), { responsive: true, displaylogo: false,
      modeBarButtons: [BUTTONS] });
    if (first) element.on("plotly_relayout", (change) => follow(element, change));
  }

  // All time axes show the same stretch.
  function follow(source, change) {
    if (busy) return;
    if (change["xaxis.autorange"]) range = null;
    else if ("xaxis.range[0]" in change) range = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
    else return;
    busy = true;
    const update = range ? { "xaxis.range": [...range], "xaxis.autorange": false } : { "xaxis.autorange": true };
    const others = [...drawn].filter((element) => element !== source);
    Promise.all(others.map((element) => Plotly.relayout(element, update))).finally(() => { busy = false; });
  }

  function applyTheme() {
    root.dataset.theme = dark() ? "dark" : "light";
    button.textContent = dark() ? "☀ light" : "☾ dark";
    for (const element of drawn) draw(element);
  }

  button.addEventListener("click", () => {
    chosen = dark() ? "light" : "dark";
    try { localStorage.setItem("contact-reach-theme", chosen); } catch { /* not kept, then */ }
    applyTheme();
  });
  system.addEventListener("change", applyTheme);
  applyTheme();

  const places = [...document.querySelectorAll(".plot")];
  // Only what is about to be seen is drawn.
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (entry.isIntersecting) { watch.unobserve(entry.target); draw(entry.target); }
    }
  }, { rootMargin: "500px" });
  places.forEach((place) => watch.observe(place));
  window.addEventListener("beforeprint", () => places.forEach((place) => drawn.has(place) || draw(place)));
})();
