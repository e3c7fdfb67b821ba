"use strict";
// Pages, and tables (sort.js). Without scripts everything is shown, one page below the other.
(function () {
  document.documentElement.classList.add("js");
  const pages = Array.from(document.querySelectorAll(".page"));
  const links = Array.from(document.querySelectorAll("nav.pages a"));

  function show() {
    const wanted = decodeURIComponent(location.hash.slice(1));
    const target = wanted ? document.getElementById(wanted) : null;
    const page = (target && target.closest(".page")) || pages[0];
    for (const other of pages) other.classList.toggle("current", other === page);
    for (const link of links) {
      if (link.hash === "#" + page.id) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    for (let part = target && target.closest("details"); part; part = part.parentElement.closest("details")) part.open = true;
    if (target === page || !target) window.scrollTo(0, 0);
    else target.scrollIntoView();
  }

  document.querySelectorAll("figure.table table").forEach(sortable);
  window.addEventListener("hashchange", show);
  show();
})();
