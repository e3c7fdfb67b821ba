"use strict";
// Tables that a press on a heading sorts, in reports and in `wasp view`: numbers from the greatest, texts from A; the next press turns it.
function sortable(table) {
  const NUMBER = /^<?([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)(?: [(±[].*)?$/i;
  const collator = new Intl.Collator(undefined, { numeric: true });
  const headings = Array.from(table.tHead.rows[0].cells);

  function entries(body, column) {
    return Array.from(body.rows, (row, place) => {
      const cell = row.cells[column], text = cell.dataset.value ?? cell.textContent.trim(), number = NUMBER.exec(text);
      return { row, place, text, empty: text === "" || text === "n/a", number: number ? Number(number[1]) : NaN };
    });
  }
  function sort(heading, column) {
    const parts = Array.from(table.tBodies, (body) => ({ body, rows: entries(body, column) }));
    const numeric = parts.every((part) => part.rows.every((entry) => entry.empty || !Number.isNaN(entry.number)));
    const before = heading.getAttribute("aria-sort");
    const rising = before ? before === "descending" : !numeric;
    for (const other of headings) other.removeAttribute("aria-sort");
    heading.setAttribute("aria-sort", rising ? "ascending" : "descending");
    // A task of a report stays together: rows are compared within their part of the table.
    for (const { body, rows } of parts) {
      const difference = (a, b) => (rising ? 1 : -1) * (numeric ? a.number - b.number : collator.compare(a.text, b.text));
      rows.sort((a, b) => a.empty - b.empty || difference(a, b) || a.place - b.place);
      body.append(...rows.map((entry) => entry.row));
    }
    table.classList.add("sorted");
    table.dispatchEvent(new Event("sorted"));
  }
  headings.forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => sort(heading, column));
  });
}
