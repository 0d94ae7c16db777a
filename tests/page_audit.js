// What a reader would stumble over in a page as it stands in the browser; each list is empty where
// all is well. `wide`: the page scrolls sideways. `cut`: what is wider than its place and scrolls
// nowhere. `overlap`: blocks that lie over each other. `faint`: letters below the contrast of WCAG 2
// AA. `clipped`: letters of a plot that its edge cuts off. `pictures`: those that did not load, or say nothing to who cannot see them.
() => {
  // what is asked of an element again and again, as by each letter inside of it, is reckoned once
  const once = f => { const kept = new Map(); return e => { if (!kept.has(e)) kept.set(e, f(e)); return kept.get(e); }; };
  const styled = once(e => getComputedStyle(e));
  const seen = once(e => { const s = styled(e); const r = e.getBoundingClientRect();
    return s.visibility !== "hidden" && r.width > 0 && r.height > 0 && e.checkVisibility(); });
  const words = e => `${e.tagName}.${e.className} ${e.textContent.trim().slice(0, 40)}`;
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  // what is wider than the article and scrolls nowhere
  const article = document.querySelector("article") || document.querySelector("main") || document.body;
  const cut = [];
  if (article) {
    const edge = article.getBoundingClientRect().right + 1;
    for (const e of article.querySelectorAll("table, pre, img, p, h1, h2, h3, li, .math")) {
      if (!seen(e)) continue;
      let inside = e.parentElement, scrolls = false;
      for (; inside && inside !== article; inside = inside.parentElement) {
        const o = getComputedStyle(inside).overflowX;
        if (o === "auto" || o === "scroll") { scrolls = true; break; }
      }
      const room = /^H\d$/.test(e.tagName) ? 10 : 0;
      if (!scrolls && e.getBoundingClientRect().right > edge + room) cut.push(words(e));
      if (/^H\d$/.test(e.tagName)) continue;
      const o = getComputedStyle(e).overflowX;
      if (e.scrollWidth > e.clientWidth + 1 && !scrolls && !["auto", "scroll", "visible"].includes(o)) cut.push("hidden " + words(e));
      if (o === "visible" && e.tagName !== "TABLE" && e.tagName !== "IMG" && e.clientWidth && e.scrollWidth > e.clientWidth + 1 && !scrolls) cut.push("over " + words(e));
    }
  }
  // blocks of the article that lie over each other
  const overlap = [];
  if (article) {
    const blocks = [...article.querySelectorAll("p, pre, table, h1, h2, h3, img, li")].filter(seen)
      .filter(e => !e.querySelector("p, pre, table, h1, h2, h3, img, li"))
      .filter(e => !e.closest("p, pre, table, li") || e.matches("p, pre, li, img"));
    const boxes = blocks.map(e => [e, e.getBoundingClientRect()]);
    for (let i = 0; i + 1 < boxes.length; i++) for (let j = i + 1; j < Math.min(i + 4, boxes.length); j++) {
      const [a, r] = boxes[i], [b, q] = boxes[j];
      if (a.contains(b) || b.contains(a)) continue;
      const x = Math.min(r.right, q.right) - Math.max(r.left, q.left), y = Math.min(r.bottom, q.bottom) - Math.max(r.top, q.top);
      if (x > 2 && y > 2) overlap.push([words(a), words(b), x, y]);
    }
  }
  // contrast of text against what is behind it
  const parse = c => { const m = c.match(/[\d.]+/g).map(Number); return [m[0], m[1], m[2], m.length > 3 ? m[3] : 1]; };
  const over = (top, below) => [0, 1, 2].map(i => top[i] * top[3] + below[i] * (1 - top[3])).concat(1);
  const light = c => { const [r, g, b] = c.slice(0, 3).map(v => { v /= 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; }); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const behind = once(e => { if (!e) return [255, 255, 255, 1]; const c = parse(styled(e).backgroundColor);
    return c[3] === 1 ? c : over(c, behind(e.parentElement)); });
  const opacity = once(e => e ? Number(styled(e).opacity) * opacity(e.parentElement) : 1);
  const faint = {};
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let n = walk.nextNode(); n; n = walk.nextNode()) {
    const e = n.parentElement;
    if (!n.textContent.trim() || !seen(e) || e.closest("script, style, svg, .visually-hidden, [aria-hidden=true]")) continue;
    const s = styled(e);
    if (opacity(e) < 0.05) continue;
    const ground = behind(e), ink = parse(s.color); ink[3] *= opacity(e);
    const a = light(over(ink, ground)), b = light(ground);
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const size = parseFloat(s.fontSize), large = size >= 24 || (size >= 18.66 && Number(s.fontWeight) >= 700);
    if (ratio < (large ? 3 : 4.5)) { const k = `${e.tagName}.${e.className} ${s.color} on ${ground.slice(0,3).map(Math.round)} ${ratio.toFixed(2)}`; faint[k] = (faint[k] || n.textContent.trim().slice(0, 30)); }
  }
  const clipped = [];
  for (const plot of document.querySelectorAll("div.plot")) {
    const room = plot.getBoundingClientRect();
    for (const e of plot.querySelectorAll("svg text")) {
      const r = e.getBoundingClientRect();
      if (!r.width || !e.textContent.trim()) continue;
      if (r.left < room.left - 1 || r.right > room.right + 1 || r.bottom > room.bottom + 1) clipped.push(e.textContent.trim().slice(0, 40));
    }
  }
  const pictures = [...document.images].filter(i => !i.complete || !i.naturalWidth || !(i.alt || "").trim() && !i.closest(".cell_output")).map(i => i.src);
  return { wide: wide > 0 ? [wide] : [], cut: cut.slice(0, 5), overlap: overlap.slice(0, 3), faint: Object.entries(faint).slice(0, 8), clipped: clipped.slice(0, 5), pictures };
}
