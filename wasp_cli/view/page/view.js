"use strict";
// The table of cells, the scrubber of an episode, and what follows a live run. Without it pages still show what they say. Tables: sort.js.
(function () {
  const all = (selector, within) => Array.from((within || document).querySelectorAll(selector));
  const one = (selector, within) => (within || document).querySelector(selector);

  // -- tables ---------------------------------------------------------------------------------------------------------------------

  // Of thousands of rows only the first are laid out; more come as one scrolls to the end of them.
  function filtered(table, form) {
    const columns = ["task", "method", "operator", "severity", "seed"];
    const body = table.tBodies[0], first = Number(table.dataset.first), more = one("#more");
    const words = new Map(Array.from(body.rows, (row) => {
      const texts = Array.from(row.cells).slice(0, 5).map((cell) => cell.textContent);
      return [row, { texts, all: (texts.join(" ") + " " + row.dataset.k).toLowerCase() }];
    }));
    let limit = first;
    function apply() {
      const choices = columns.map((name) => form.elements[name].value);
      const typed = form.elements.text.value.toLowerCase().split(/\s+/).filter(Boolean);
      let count = 0;
      for (const row of body.rows) {
        const { texts, all: text } = words.get(row);
        const state = row.lastElementChild.textContent.toLowerCase();
        const matches = choices.every((value, place) => !value || texts[place] === value)
          && typed.every((word) => text.includes(word) || state.includes(word));
        count += matches;
        const hidden = !matches || count > limit;
        if (row.hidden !== hidden) row.hidden = hidden;
      }
      one("#counted").textContent = count === body.rows.length ? count + " cells" : count + " of " + body.rows.length + " cells";
      more.hidden = count <= limit;
    }
    function changed() {
      limit = first;
      apply();
      const query = new URLSearchParams();
      for (const name of ["text", ...columns]) if (form.elements[name].value) query.set(name, form.elements[name].value);
      address(query.toString());
    }
    function further() { limit += first; apply(); }
    const given = new URLSearchParams(location.search);
    for (const name of ["text", ...columns]) if (given.has(name)) form.elements[name].value = given.get(name);
    form.addEventListener("input", changed);
    form.addEventListener("submit", (event) => event.preventDefault());
    table.addEventListener("sorted", () => { limit = first; apply(); });
    one("button", more).addEventListener("click", further);
    new IntersectionObserver((seen) => { if (seen.some((entry) => entry.isIntersecting)) further(); }).observe(more);
    if (given.size) apply();
    else more.hidden = body.rows.length <= limit;
  }

  function numbered(table) {
    if (!table.dataset.numbers || !Number(table.dataset.left)) return;
    const rows = new Map(Array.from(table.tBodies[0].rows).map((row) => [row.dataset.k, row]));
    async function more() {
      const answer = await fetch(table.dataset.numbers);
      if (!answer.ok) return;
      const { left, numbers } = await answer.json();
      for (const [key, texts] of Object.entries(numbers)) {
        const row = rows.get(key);
        if (row) texts.forEach((text, place) => { row.cells[5 + place].textContent = text; });
      }
      table.dataset.left = left;
      if (left) setTimeout(more, 400);
    }
    setTimeout(more, 200);
  }

  // An address that can be sent; a file of a bundle may not change its own.
  function address(query) {
    try { history.replaceState(null, "", query ? "?" + query : location.pathname); } catch (error) { /* a file: it keeps its name */ }
  }

  // -- episodes -------------------------------------------------------------------------------------------------------------------

  function film(figure) {
    const image = one("img", figure), told = one(".told", figure), legend = one("ul.legend", figure);
    let base = figure.dataset.film, state = null, decision = 0, frame = -1, timer = null, still = false;

    function name(index) {
      if (figure.dataset.done) return base + "/" + String(index).padStart(5, "0") + ".webp";
      const [path, query] = base.split("?");
      return path + "/frame/" + index + (query ? "?" + query : "");
    }
    function show(t) {
      decision = t;
      if (!state || !state.ready) return;
      const place = still ? 0 : Math.min(Math.floor(decision / state.every), state.frames - 1);
      const index = Math.min(place, state.ready - 1);
      if (index === frame) return;
      frame = index;
      image.src = name(index);
      image.hidden = false;
    }
    function tell() {
      if (state.state === "failed") told.textContent = "no film: " + state.problem;
      else if (state.state === "done") told.textContent = "";
      else if (state.share !== undefined) told.textContent = state.text + " (" + Math.round(100 * state.share) + " %)";
      else if (state.state === "waiting") told.textContent = "waiting for other films";
      else told.textContent = state.frames ? "drawing: " + state.ready + " of " + state.frames + " frames" : "drawing begins";
    }
    function explainColours() {
      if (!state.legend || legend.childElementCount) return;
      for (const [thing, colour, meaning] of state.legend) {
        const item = document.createElement("li"), sample = document.createElement("i");
        sample.style.backgroundColor = colour;
        item.append(sample, " " + thing + (meaning ? ": " + meaning : ""));
        legend.append(item);
      }
    }
    async function follow(method) {
      const place = base;
      let answer;
      try { answer = await fetch(place, { method }); } catch (error) { told.textContent = "the server is gone"; return; }
      if (place !== base) return;
      if (!answer.ok) { told.textContent = "no film: " + (await answer.text()).slice(0, 200); return; }
      state = await answer.json();
      tell();
      explainColours();
      show(decision);
      // One that waits, or that another server gave up, is asked for again.
      if (["drawing", "waiting", "absent"].includes(state.state)) timer = setTimeout(() => follow(state.state === "drawing" ? "GET" : "POST"), 150);
    }
    function choose(next) {
      clearTimeout(timer);
      base = next; state = null; frame = -1; still = next.includes("/branches");
      legend.textContent = "";
      follow("POST");
    }
    if (figure.dataset.done) {
      state = JSON.parse(figure.dataset.done);
      if (state.ready) { told.textContent = ""; explainColours(); } else state = null;
    } else choose(base);
    for (const button of all(".films-of button", figure)) {
      button.addEventListener("click", () => {
        for (const other of all(".films-of button", figure)) other.setAttribute("aria-pressed", String(other === button));
        choose(button.dataset.kind);
      });
    }
    return { show, choose, get still() { return still; }, back: () => choose(figure.dataset.film) };
  }

  function episode(section) {
    const decisions = Number(section.dataset.decisions);
    const part = one(".step", section), figure = one(".film-of", section);
    const pictures = figure ? film(figure) : { show() {}, choose() {}, still: false, back() {} }; // a task of others has none
    const kept = new Map();
    let current = null;

    function fill(content) {
      part.replaceChildren(content);
      for (const button of all(".branch-film", part)) button.addEventListener("click", () => pictures.choose(button.dataset.kind));
    }
    async function explain(t) {
      current = t;
      const own = one('template[data-step="' + t + '"]', section);
      if (own) { fill(own.content.cloneNode(true)); part.dataset.shown = t; return; }
      if (!section.dataset.explain) return;
      let html = kept.get(t);
      if (html === undefined) {
        const answer = await fetch(section.dataset.explain + "?step=" + t);
        html = await answer.text();
        if (!answer.ok) return;
        kept.set(t, html);
      }
      if (current !== t) return;
      // From our own server, where every text is escaped.
      const holder = document.createElement("template");
      holder.innerHTML = html;
      fill(holder.content);
      part.dataset.shown = t;
    }
    function at(t) {
      const here = Math.min(t, decisions - 1);
      if (pictures.still) pictures.back();
      pictures.show(t);
      for (const cursor of all(".cursor", section)) {
        cursor.setAttribute("x1", here + 0.5);
        cursor.setAttribute("x2", here + 0.5);
      }
      explain(here);
    }
    return { at, decisions, stops: JSON.parse(section.dataset.stops), first: Number(section.dataset.step), section };
  }

  function scrubbed(bar) {
    const episodes = all("section.episode").map(episode);
    const slider = one("input", bar), output = one("output", bar), play = one("#play", bar);
    const last = Math.max(...episodes.map((part) => part.decisions)) - 1;
    const seconds = Number(episodes[0].section.dataset.seconds);
    const stops = Array.from(new Set(episodes.flatMap((part) => part.stops))).sort((a, b) => a - b);
    const given = new URLSearchParams(location.search);
    let timer = null;
    slider.max = last;

    function go(t) {
      const step = Math.max(0, Math.min(last, t));
      slider.value = step;
      output.textContent = "decision " + step + " of 0 to " + last + (seconds ? ", " + (step * seconds).toFixed(1) + " s" : "");
      for (const { at } of episodes) at(step);
      given.set("step", step);
      address(given.toString());
    }
    const now = () => Number(slider.value);
    const next = () => go(stops.find((stop) => stop > now()) ?? now());
    const previous = () => go(stops.findLast((stop) => stop < now()) ?? now());
    function stop() { if (timer !== null) clearInterval(timer); timer = null; play.textContent = "Play"; }
    function run() {
      if (now() >= last) go(0);
      play.textContent = "Pause";
      timer = setInterval(() => { if (now() >= last) stop(); else go(now() + 1); }, 100);
    }
    slider.addEventListener("input", () => { stop(); go(now()); });
    play.addEventListener("click", () => (timer === null ? run() : stop()));
    for (const [id, act] of [["before", () => go(now() - 1)], ["after", () => go(now() + 1)], ["stop-before", previous], ["stop-after", next]]) {
      one("#" + id, bar).addEventListener("click", () => { stop(); act(); });
    }
    for (const { section, decisions } of episodes) {
      for (const lane of all(".lane svg", section)) {
        lane.addEventListener("click", (event) => {
          const box = lane.getBoundingClientRect();
          stop();
          go(Math.floor(((event.clientX - box.left) / box.width) * decisions));
        });
      }
    }
    keys.ArrowLeft = () => { stop(); go(now() - 1); };
    keys.ArrowRight = () => { stop(); go(now() + 1); };
    keys.n = () => { stop(); next(); };
    keys.p = () => { stop(); previous(); };
    const step = given.get("step") ?? "";
    go(/^\d+$/.test(step) ? Number(step) : episodes[0].first);
  }

  // -- keys, and a live run -------------------------------------------------------------------------------------------------------

  const keys = { Escape: () => { const up = one("[data-up]"); if (up) location.href = up.href; } };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const place = event.target;
    if (place instanceof HTMLElement && place.matches("input:not([type=range]), select") && event.key !== "Escape") return;
    const act = keys[event.key];
    if (act) { event.preventDefault(); act(); }
  });

  function following(place) {
    const later = () => { if (!one("[data-over]", place)) setTimeout(again, 1000); };
    async function again() {
      try {
        const answer = await fetch(place.dataset.follow);
        if (answer.ok) {
          const holder = document.createElement("template");
          holder.innerHTML = await answer.text();
          place.replaceChildren(holder.content);
        }
      } catch (error) { return; }
      later();
    }
    later();
  }

  all("table.sortable, #cells").forEach(sortable);
  const cells = one("#cells");
  if (cells) { filtered(cells, one("#filters")); numbered(cells); }
  const bar = one("#scrubber");
  if (bar && one("section.episode")) scrubbed(bar);
  all("[data-follow]").forEach(following);
})();
