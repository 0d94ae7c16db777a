/* The script of an interactive page: draws its plots with plotly.js, links their time axes, lets
   tables be sorted and filtered. What stands in the page is data: it is only ever set as text,
   and as numbers and names of colours in the specifications that reporting/chart_plot.py wrote. */
"use strict";
(() => {
  const LIGHT = {
    blue: "#0072b2", vermilion: "#d55e00", green: "#009e73", purple: "#cc79a7", orange: "#c98a00",
    sky: "#56b4e9", yellow: "#d9c91f", ink: "#222222", grey: "#777777", pale: "#dddddd",
    measured: "#aaaaaa", alarm: "#c1272d", ground: "#ffffff", grid: "#e4e4e4",
  };
  const DARK = {
    blue: "#5aa9e6", vermilion: "#ff8a4c", green: "#3cc99b", purple: "#e39cc4", orange: "#f0b429",
    sky: "#9ad4f5", yellow: "#f0e442", ink: "#e6e6e6", grey: "#9a9a9a", pale: "#4a4d52",
    measured: "#7d8187", alarm: "#ff6b6b", ground: "#17191c", grid: "#33363b",
  };
  const PAPER_WIDTH = 680; // pixels of an A4 sheet between its margins
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const coarse = window.matchMedia("(pointer: coarse)");
  const CONFIG = {
    responsive: true,
    displaylogo: false,
    // plotly.js would offer to send the plot to its maker's server: a page sends nothing anywhere
    showSendToCloud: false,
    plotlyServerURL: "",
    doubleClick: "reset",
    showTips: false, // the page says it in its own words
    displayModeBar: coarse.matches ? false : "hover", // under a finger it would hide the names
    modeBarButtonsToRemove: ["sendChartToCloud", "select2d", "lasso2d", "autoScale2d"],
    toImageButtonOptions: { format: "svg", filename: "plot" },
  };
  const plots = [];
  let printing = false;

  // --- plots ------------------------------------------------------------------------------------

  const theme = () => (dark.matches && !printing ? DARK : LIGHT);

  function coloured(value, colours, key) {
    if (typeof value === "string") {
      const named = /colou?r$/i.test(key) && value[0] === "@" ? colours[value.slice(1)] : undefined;
      return named === undefined ? value : named;
    }
    if (Array.isArray(value)) return value.map((item) => coloured(item, colours, key));
    if (value !== null && typeof value === "object") {
      const made = {};
      for (const [name, item] of Object.entries(value)) made[name] = coloured(item, colours, name);
      return made;
    }
    return value;
  }

  function merged(base, over) {
    const made = { ...base };
    for (const [key, value] of Object.entries(over)) {
      const both = value !== null && typeof value === "object" && !Array.isArray(value) &&
        typeof made[key] === "object";
      made[key] = both ? merged(made[key], value) : value;
    }
    return made;
  }

  function layoutOf(plot) {
    const colours = theme();
    const axis = {
      gridcolor: colours.grid, zerolinecolor: colours.grid, linecolor: colours.grey,
      tickcolor: colours.grey, automargin: true, title: { standoff: 6 },
    };
    const base = {
      height: plot.spec.height,
      // linked axes stand in one line: the numbers beside them take no room of their own
      margin: { l: plot.spec.group ? 66 : 52, r: 14, t: 8, b: 34 },
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { family: "system-ui, sans-serif", size: 12, color: colours.ink },
      hovermode: plot.spec.group ? "x unified" : "closest",
      hoverlabel: { bgcolor: colours.ground, font: { color: colours.ink } },
      dragmode: coarse.matches ? false : "zoom",
      legend: { orientation: "h", x: 0, y: 1, xanchor: "left", yanchor: "bottom" },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colours.grey, activecolor: colours.blue },
      xaxis: axis,
      yaxis: plot.spec.group ? { ...axis, automargin: false } : axis,
      yaxis2: axis,
    };
    const layout = merged(base, coloured(plot.spec.layout, colours, ""));
    if (!plot.spec.layout.yaxis2) delete layout.yaxis2;
    if (printing) layout.width = PAPER_WIDTH;
    else layout.autosize = true;
    const variant = plot.spec.variants && plot.spec.variants[plot.variant];
    for (const [name, text] of Object.entries(variant ? variant.titles : {})) {
      layout[name] = merged(layout[name], { title: { text } });
    }
    return layout;
  }

  function tracesOf(plot) {
    const traces = coloured(plot.spec.traces, theme(), "");
    const variant = plot.spec.variants && plot.spec.variants[plot.variant];
    if (variant) {
      variant.traces.forEach((changed, i) => {
        traces[i] = merged(traces[i], coloured(changed, theme(), ""));
      });
    }
    return traces;
  }

  /** Draw it, anew where it stands already: of another width the names find no room otherwise. */
  function draw(plot) {
    const layout = layoutOf(plot);
    if (plot.drawn && plot.spec.group) layout.xaxis.range = rangeOf(plot);
    Plotly.newPlot(plot.place, tracesOf(plot), layout, CONFIG);
    plot.drawn = true;
    plot.place.on("plotly_relayout", () => follow(plot));
    plot.place.on("plotly_relayouting", (change) => {
      if ("xaxis.range[0]" in change) follow(plot);
    });
    if (plot.spec.fans) showFan(plot, plot.fan);
  }

  const rangeOf = (plot) => plot.place.layout.xaxis.range.map(Number);
  const alike = (a, b) => a[0] === b[0] && a[1] === b[1];

  /** The others of a group show what this one shows. */
  function follow(plot) {
    if (plot.spec.group) show(plot.spec.group, rangeOf(plot));
  }

  function show(group, range) {
    for (const other of plots) {
      if (other.drawn && other.spec.group === group && !alike(rangeOf(other), range)) {
        Plotly.relayout(other.place, { "xaxis.range": range.slice() });
      }
    }
  }

  // --- what a reader can turn -------------------------------------------------------------------

  function element(tag, properties, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  }

  function timeTools(tools, group) {
    const of = () => plots.filter((plot) => plot.drawn && plot.spec.group === group);
    const moved = (change) => () => {
      const [first] = of();
      if (!first) return;
      const whole = first.spec.layout.xaxis.range;
      const [low, high] = rangeOf(first);
      const [from, to] = change(low, high, high - low);
      show(group, [Math.max(from, whole[0]), Math.min(to, whole[1])]);
    };
    const steps = [
      ["◀", "earlier", (a, b, w) => [a - w / 2, b - w / 2]],
      ["▶", "later", (a, b, w) => [a + w / 2, b + w / 2]],
      ["+", "less time, larger", (a, b, w) => [a + w / 4, b - w / 4]],
      ["−", "more time", (a, b, w) => [a - w / 2, b + w / 2]],
      ["all", "the whole time", () => [-Infinity, Infinity]],
    ];
    const buttons = steps.map(([text, title, change]) => {
      const button = element("button", { type: "button", textContent: text, title });
      button.setAttribute("aria-label", title);
      button.addEventListener("click", moved(change));
      return button;
    });
    tools.append(element("span", { className: "buttons" }, "time ", ...buttons));
  }

  function showFan(plot, number) {
    plot.fan = number;
    const { starts, pairs } = plot.spec.fans;
    const full = plot.place._fullData;
    const x = [], y = [], which = [];
    for (const [all, chosen] of pairs) {
      x.push(Array.from(full[all].x.slice(starts[number], starts[number + 1])));
      y.push(Array.from(full[all].y.slice(starts[number], starts[number + 1])));
      which.push(chosen);
    }
    Plotly.restyle(plot.place, { x, y }, which);
  }

  function fanTools(tools, members) {
    const times = members[0].spec.fans.times;
    const slider = element("input", {
      type: "range", min: 0, max: times.length - 1, value: members[0].fan, className: "fan",
    });
    const told = element("output", {});
    const say = () => { told.textContent = `made at ${times[slider.value]} s`; };
    slider.setAttribute("aria-label", "which prediction");
    slider.addEventListener("input", () => {
      say();
      for (const plot of members) if (plot.drawn) showFan(plot, Number(slider.value));
    });
    say();
    tools.append(element("label", {}, "prediction ", slider, " ", told));
  }

  function variantTools(tools, members) {
    const options = members[0].spec.variants.map((variant, i) =>
      element("option", { value: i, textContent: variant.label }));
    const select = element("select", {}, ...options);
    select.addEventListener("change", () => {
      for (const plot of members) {
        plot.variant = Number(select.value);
        if (plot.drawn) draw(plot);
      }
    });
    tools.append(element("label", {}, "show ", select));
  }

  function furnish(tools) {
    const within = plots.filter((plot) => tools.parentElement.contains(plot.place));
    const groups = new Set(within.map((plot) => plot.spec.group).filter(Boolean));
    for (const group of groups) timeTools(tools, group);
    const fans = within.filter((plot) => plot.spec.fans && plot.spec.fans.times.length);
    if (fans.length) fanTools(tools, fans);
    const several = within.filter((plot) => plot.spec.variants);
    if (several.length) variantTools(tools, several);
    tools.hidden = !tools.childElementCount;
  }

  // --- tables -----------------------------------------------------------------------------------

  const CONDITION = /^([^<>=!]+)(<=|>=|!=|<|>|=)(.+)$/;
  const HOLDS = {
    "<": (a, b) => a < b, ">": (a, b) => a > b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b,
    "=": (a, b) => a === b, "!=": (a, b) => a !== b,
  };

  function valueOf(cell) {
    if (cell.dataset.v !== undefined) return Number(cell.dataset.v);
    return cell.classList.contains("number") ? NaN : cell.textContent.trim().toLowerCase();
  }

  function tableOf(table) {
    const body = table.tBodies[0];
    const heads = Array.from(table.tHead.rows[0].cells);
    const keys = heads.map((head) => (head.dataset.key || head.textContent).trim().toLowerCase());
    const rows = Array.from(body.rows, (row) => ({
      row,
      values: Array.from(row.cells, valueOf),
      text: row.textContent.toLowerCase(),
    }));
    let sorted = null, falling = false;

    function sort(column) {
      falling = sorted === column ? !falling : false;
      sorted = column;
      const empty = (value) => value === "" || value === "–" || Number.isNaN(value);
      const order = (a, b) => {
        const [p, q] = [a.values[column], b.values[column]];
        if (empty(p) || empty(q)) return empty(p) - empty(q); // what is missing stays last
        if (typeof p === "number" && typeof q === "number") return falling ? q - p : p - q;
        return (falling ? -1 : 1) * String(p).localeCompare(String(q), "en", { numeric: true });
      };
      rows.sort(order);
      body.append(...rows.map((each) => each.row));
      heads.forEach((head, i) => {
        if (i === column) head.setAttribute("aria-sort", falling ? "descending" : "ascending");
        else head.removeAttribute("aria-sort");
      });
    }

    function condition(word) {
      const parts = CONDITION.exec(word);
      const column = parts ? keys.indexOf(parts[1]) : -1;
      if (column < 0) return (each) => each.text.includes(word);
      const wanted = Number(parts[3]);
      return (each) => {
        const value = each.values[column];
        if (typeof value === "number") {
          return !Number.isNaN(value) && HOLDS[parts[2]](value, wanted);
        }
        return HOLDS[parts[2]](value, parts[3]);
      };
    }

    function filter(text) {
      const conditions = text.toLowerCase().split(/\s+/).filter(Boolean).map(condition);
      let left = 0;
      for (const each of rows) {
        const kept = conditions.every((holds) => holds(each));
        each.row.hidden = !kept;
        left += kept;
      }
      return left;
    }

    heads.forEach((head, i) => {
      const button = element("button", { type: "button", title: "sort" });
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => sort(i));
    });
    const tools = table.closest(".sortable").querySelector(".tools");
    const input = element("input", {
      type: "search", placeholder: "words, or a column: " + (table.dataset.example || ""),
    });
    input.setAttribute("aria-label", "filter the rows");
    const count = element("output", { textContent: `${rows.length} rows` });
    input.addEventListener("input", () => {
      const left = filter(input.value);
      count.textContent = left === rows.length ? `${left} rows` : `${left} of ${rows.length} rows`;
    });
    tools.append(element("label", {}, "filter ", input), " ", count);
    tools.hidden = false;
  }

  // --- the page ---------------------------------------------------------------------------------

  /** Unpack plotly.js, which the page carries compressed, and run it; a server has it as a file. */
  async function loadPlotly() {
    const carrier = document.getElementById("plotly");
    if (carrier.dataset.address) {
      await new Promise((done, failed) => {
        const script = element("script", { src: carrier.dataset.address });
        script.addEventListener("load", done);
        script.addEventListener("error", () => failed(new Error("the server does not send it")));
        document.body.append(script);
      });
      return;
    }
    const packed = atob(carrier.textContent);
    const bytes = new Uint8Array(packed.length);
    for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
    const unpacked = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const text = await new Response(unpacked).text();
    document.body.append(element("script", { textContent: text }));
    if (!window.Plotly) throw new Error("the browser does not let it run");
  }

  function drawNext(number) {
    if (number >= plots.length) {
      document.documentElement.dataset.plots = "drawn";
      return;
    }
    if (!plots[number].drawn) draw(plots[number]);
    window.setTimeout(drawNext, 0, number + 1); // the reader may scroll meanwhile
  }

  function drawAll() {
    document.querySelectorAll(".section-tools").forEach(furnish);
    drawNext(0);
    const again = () => { for (const plot of plots) draw(plot); };
    dark.addEventListener("change", again);
    // What was drawn while its section was folded had no width; paper has all sections.
    const folds = [...document.querySelectorAll("details.section")];
    for (const fold of folds) {
      fold.addEventListener("toggle", () => {
        if (!fold.open) return;
        for (const plot of plots) if (fold.contains(plot.place)) draw(plot);
      });
    }
    window.addEventListener("beforeprint", () => {
      printing = true;
      for (const fold of folds) fold.open = true;
      again();
    });
    window.addEventListener("afterprint", () => { printing = false; again(); });
  }

  function sayWhyNot(error) {
    const note = document.querySelector(".no-plots");
    const reason = typeof DecompressionStream === "undefined"
      ? "this browser cannot unpack (it has no DecompressionStream; browsers since 2023 have it)"
      : `could not be unpacked here (${error.message})`;
    note.textContent = `This page draws its plots with a script that ${reason}: ` +
      "sentences and tables stand without it, plots do not.";
    note.hidden = false;
    for (const plot of plots) plot.place.style.minHeight = "";
    document.documentElement.dataset.plots = "missing";
  }

  // --- a page of a server: fetched anew while something goes on -----------------------------------

  const specOf = (place) =>
    JSON.parse(place.parentElement.querySelector("script.plot-data").textContent);

  /** Take what a fresh copy of the page has for a part of this one. */
  function takeOver(selector, fresh) {
    const own = document.querySelector(selector), other = fresh.querySelector(selector);
    if (!own || !other || own.innerHTML === other.innerHTML) return;
    const chosen = new Set(Array.from(own.querySelectorAll("input:checked"), (box) => box.value));
    const focused = own.contains(document.activeElement) ? document.activeElement : null;
    const scrolled = own.querySelector(".scroll") ? own.querySelector(".scroll").scrollLeft : 0;
    own.replaceChildren(...Array.from(other.childNodes)); // a copy: the list shrinks as it is taken
    for (const box of own.querySelectorAll("input[type=checkbox]")) {
      box.checked = chosen.has(box.value);
    }
    if (scrolled) own.querySelector(".scroll").scrollLeft = scrolled;
    if (focused) {
      const again = Array.from(own.querySelectorAll("a, input, button"))
        .find((each) => each.value === focused.value && each.href === focused.href);
      if (again) again.focus({ preventScroll: true });
    }
    furnishRuns();
  }

  async function renew(seconds) {
    const lost = document.getElementById("lost");
    let fresh = null;
    try {
      const answer = await fetch(location.href, { cache: "no-store" });
      if (!answer.ok) throw new Error(`it answers ${answer.status}`);
      fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
      lost.hidden = true;
    } catch (error) {
      lost.textContent = "The server does not answer: what stands here is not renewed any more.";
      lost.hidden = false;
    }
    if (fresh !== null) {
      const next = Array.from(fresh.querySelectorAll("div.plot"), specOf);
      if (!fresh.documentElement.dataset.refresh || next.length !== plots.length) {
        location.reload(); // it has ended, and is another page now
        return;
      }
      takeOver("#answer", fresh);
      takeOver("#runs", fresh);
      next.forEach((spec, i) => renewPlot(plots[i], spec));
    }
    window.setTimeout(renew, 1000 * seconds, seconds);
  }

  /** Draw other samples; a part of the time that a reader has enlarged stays. */
  function renewPlot(plot, spec) {
    const before = plot.spec;
    plot.spec = spec;
    if (!plot.drawn) return;
    const layout = layoutOf(plot);
    if (before.group && !alike(rangeOf(plot), before.layout.xaxis.range)) {
      layout.xaxis.range = rangeOf(plot);
      plot.spec = { ...spec, layout: { ...spec.layout, xaxis: before.layout.xaxis } };
    }
    Plotly.react(plot.place, tracesOf(plot), layout, CONFIG);
  }

  /** The list of runs of a server: how many are chosen, and a choice that shows at once. */
  function furnishRuns() {
    const form = document.querySelector("form.runs");
    if (!form) return;
    const boxes = Array.from(form.querySelectorAll("input[type=checkbox]"));
    const told = () => {
      const count = boxes.filter((box) => box.checked).length;
      form.querySelector("output.chosen").textContent = count ? `${count} chosen` : "";
      form.querySelector("button.compare").disabled = count < 2;
    };
    boxes.forEach((box) => box.addEventListener("change", told));
    told();
  }

  // --- the keyboard -----------------------------------------------------------------------------

  const parts = () => Array.from(document.querySelectorAll("main section[id]"))
    .filter((section) => section.getBoundingClientRect().height > 0);

  function toPart(step) {
    const all = parts();
    const passed = all.filter((section) => section.getBoundingClientRect().top < 8).length;
    const here = all[passed - 1];
    const exact = here && Math.abs(here.getBoundingClientRect().top) < 8;
    const number = step > 0 ? passed : passed - (exact ? 2 : 1);
    if (number < 0) window.scrollTo({ top: 0 });
    else if (all[number]) all[number].scrollIntoView({ block: "start" });
  }

  const KEYS = {
    j: () => toPart(1),
    k: () => toPart(-1),
    o: () => {
      const folds = Array.from(document.querySelectorAll("main details"));
      const open = folds.some((fold) => !fold.open);
      for (const fold of folds) fold.open = open;
    },
    "/": () => {
      const input = document.querySelector("main input[type=search]");
      if (input) { input.focus(); input.select(); }
    },
  };

  document.addEventListener("keydown", (event) => {
    const typing = event.target.closest && event.target.closest("input, select, textarea");
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (typing) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    const act = KEYS[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });

  for (const place of document.querySelectorAll("div.plot")) {
    const spec = specOf(place);
    plots.push({ place, spec, drawn: false, variant: 0, fan: 0 });
    place.style.minHeight = `${spec.height}px`; // the page does not jump when it is drawn
  }
  document.querySelectorAll(".sortable table").forEach(tableOf);
  furnishRuns();
  for (const select of document.querySelectorAll("form.filters select")) {
    select.addEventListener("change", () => select.form.requestSubmit());
  }
  if (plots.length) loadPlotly().then(drawAll, sayWhyNot);
  else document.documentElement.dataset.plots = "drawn";
  const seconds = Number(document.documentElement.dataset.refresh);
  if (seconds) window.setTimeout(renew, 1000 * seconds, seconds);
})();
