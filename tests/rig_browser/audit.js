// What a reader would stumble over in a laid-out page, as a list of sentences; empty where there is nothing.
// Evaluated in the page by tests/handover/browser.py; nothing of the page's own making is asked.
(print) => {
  const found = [];
  const SLACK = 1.5; // px: coordinates are rounded
  const SMALLEST = 9; // px of a letter's height in a figure
  const seen = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const style = getComputedStyle(e);
      if (style.display === "none" || style.visibility === "hidden") return false;
      const fold = e.parentElement?.tagName === "DETAILS" ? e.parentElement : null;
      if (fold && !fold.open && e.tagName !== "SUMMARY" && !print) return false;
    }
    return true;
  };
  const named = (e) => {
    const by = e.getAttribute("aria-labelledby");
    return e.getAttribute("aria-label") || (by && document.getElementById(by)?.textContent);
  };
  const say = (e) => `<${e.tagName.toLowerCase()}> "${(e.textContent || "").trim().replace(/\s+/g, " ").slice(0, 40)}"`;
  const width = document.documentElement.clientWidth;

  if (document.documentElement.scrollWidth > width + 1)
    found.push(`the page is ${document.documentElement.scrollWidth} px wide on ${width} px`);

  // Boxes narrower than what they hold.
  for (const e of document.body.querySelectorAll("*")) {
    if (e.closest("svg") || !seen(e) || getComputedStyle(e).display === "inline") continue;
    const over = e.scrollWidth > e.clientWidth + SLACK;
    if (!over) continue;
    const how = getComputedStyle(e).overflowX;
    if (print) found.push(`${say(e)} is ${e.scrollWidth} px wide on ${e.clientWidth} px of paper`);
    else if (how === "hidden" || how === "clip") found.push(`${say(e)} is clipped`);
    else if (how === "visible") found.push(`${say(e)} runs out of its box`);
    else if (e.tabIndex < 0 || !named(e)) found.push(`${say(e)} scrolls without focus or name`);
  }

  // Lines of text: the boxes of text nodes, and of the texts of figures.
  const lines = [];
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement;
    if (!node.data.trim() || ["SCRIPT", "STYLE", "TITLE", "DESC"].includes(parent.tagName.toUpperCase())) continue;
    if (!seen(parent)) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    const box = parent.closest(".wide")?.getBoundingClientRect();
    for (const r of range.getClientRects()) {
      // What has scrolled out of its own region lies on top of nothing.
      if (box && (r.left >= box.right || r.right <= box.left)) continue;
      if (r.width > 0.5 && r.height > 0.5) lines.push({ r, node, text: node.data.trim().slice(0, 40) });
      if (r.left < -SLACK || (r.right > width + SLACK && !box)) found.push(`"${node.data.trim().slice(0, 40)}" leaves the page`);
    }
    const drawing = parent.closest("svg");
    if (drawing) {
      const r = range.getBoundingClientRect(), edge = drawing.getBoundingClientRect();
      if (r.left < edge.left - 0.5 || r.right > edge.right + 0.5 || r.top < edge.top - 0.5 || r.bottom > edge.bottom + 0.5)
        found.push(`"${node.data.trim()}" is cut at the edge of its figure`);
      const scale = Math.abs(drawing.getScreenCTM().a) * parseFloat(getComputedStyle(parent).fontSize);
      if (scale < SMALLEST) found.push(`"${node.data.trim()}" is ${scale.toFixed(1)} px high`);
    }
  }
  lines.sort((a, b) => a.r.top - b.r.top);
  for (let i = 0; i < lines.length; i++) {
    const a = lines[i].r;
    for (let j = i + 1; j < lines.length && lines[j].r.top < a.bottom - 3; j++) {
      const b = lines[j].r;
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      // Boxes of a font are higher than its letters: neighbouring lines may share a little.
      if (across > SLACK && down > 0.25 * Math.min(a.height, b.height))
        found.push(`"${lines[i].text}" and "${lines[j].text}" overlap by ${across.toFixed(0)} × ${down.toFixed(0)} px`);
    }
  }
  return found;
}
