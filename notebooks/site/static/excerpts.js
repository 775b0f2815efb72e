// Under each result of a search, a piece of its page around the first of the words that is on it.
// TEXTS, by page, is written by build.py.
document.addEventListener("DOMContentLoaded", () => {
  const results = document.getElementById("search-results");
  const query = new URLSearchParams(location.search).get("q") || "";
  const words = query.toLowerCase().split(/\s+/).filter((word) => word);
  const excerpt = (text) => {
    const places = words.map((word) => text.toLowerCase().indexOf(word)).filter((place) => place >= 0);
    const start = places.length ? Math.max(0, text.lastIndexOf(" ", Math.min(...places) - 90) + 1) : 0;
    const end = text.indexOf(" ", start + 220);
    const dots = (is_cut) => (is_cut ? " .. " : "");
    return dots(start > 0) + text.slice(start, end < 0 ? undefined : end) + dots(end >= 0);
  };
  const root = new URL(document.documentElement.dataset.content_root || "./", location.href).href;
  const fill = () => {
    for (const item of results.querySelectorAll("li:not([data-has-excerpt])")) {
      const name = item.querySelector("a").href.slice(root.length).split(/[?#]/)[0];
      item.dataset.hasExcerpt = name in TEXTS ? "yes" : "no";
      if (name in TEXTS) {
        const paragraph = document.createElement("p");
        paragraph.className = "excerpt";
        paragraph.textContent = excerpt(TEXTS[name]);
        item.append(paragraph);
      }
    }
  };
  new MutationObserver(fill).observe(results, { childList: true, subtree: true });
});
