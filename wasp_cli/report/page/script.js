"use strict";
// Pages, tables (sort.js) and films. Without scripts everything is shown, one page below the other.
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
    for (const stop of stops) stop();
  }

  const stops = [];
  function player(section) {
    const films = Array.from(section.querySelectorAll(".film"));
    const slider = section.querySelector(".player input");
    const button = section.querySelector(".player button");
    const told = section.querySelector(".player output");
    const seconds = Number(section.dataset.seconds);
    let timer = null;

    function draw() {
      const decision = Number(slider.value);
      for (const film of films) {
        const { every, count, columns, rows, decisions } = film.dataset;
        const last = Number(count) - 1;
        const frame = decision >= Number(decisions) ? last : Math.min(Math.floor(decision / Number(every)), last);
        const place = film.querySelector(".frame");
        const [x, y] = [frame % Number(columns), Math.floor(frame / Number(columns))];
        const share = (at, all) => (Number(all) > 1 ? (100 * at) / (Number(all) - 1) : 0) + "%";
        if (place) place.style.backgroundPosition = share(x, columns) + " " + share(y, rows);
        const at = Math.min(decision, Number(decisions) - 1) + 0.5;
        for (const cursor of film.querySelectorAll(".cursor")) {
          cursor.setAttribute("x1", at);
          cursor.setAttribute("x2", at);
        }
      }
      told.textContent = "decision " + decision + (seconds ? ", " + (decision * seconds).toFixed(1) + " s" : "");
    }
    function stop() {
      if (timer !== null) clearInterval(timer);
      timer = null;
      button.textContent = "Play";
    }
    function play() {
      if (Number(slider.value) >= Number(slider.max)) slider.value = 0;
      button.textContent = "Pause";
      const step = Number(slider.step) || 1;
      timer = setInterval(() => {
        slider.value = Number(slider.value) + step;
        draw();
        if (Number(slider.value) >= Number(slider.max)) stop();
      }, 80);
    }
    button.addEventListener("click", () => (timer === null ? play() : stop()));
    slider.addEventListener("input", () => { stop(); draw(); });
    stops.push(stop);
    draw();
  }

  document.querySelectorAll("figure.table table").forEach(sortable);
  document.querySelectorAll("[data-player]").forEach(player);
  window.addEventListener("hashchange", show);
  show();
})();
