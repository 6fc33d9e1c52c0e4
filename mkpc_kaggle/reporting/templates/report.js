// Tables that sort and filter, and pictures that enlarge.
"use strict";
document.addEventListener("DOMContentLoaded", () => {
  document.querySelectorAll("table.sortable").forEach((table) => {
    const body = table.tBodies[0], filter = table.closest("section").querySelector("input[type=search]");
    const text = (row, column) => row.cells[column].textContent;
    const compare = (a, b) => {
      const difference = Number(a) - Number(b);
      return Number.isNaN(difference) ? a.localeCompare(b, undefined, { numeric: true }) : difference;
    };
    table.querySelectorAll("th button").forEach((button, column) => {
      button.onclick = () => {
        const head = button.parentElement, falls = head.ariaSort === "ascending";
        table.querySelectorAll("th").forEach((each) => each.removeAttribute("aria-sort"));
        head.ariaSort = falls ? "descending" : "ascending";
        const rows = [...body.rows].sort((a, b) => compare(text(a, column), text(b, column)));
        body.append(...(falls ? rows.reverse() : rows));
      };
    });
    filter.oninput = () => {
      const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
      [...body.rows].forEach((row) => {
        const content = row.textContent.toLowerCase();
        row.hidden = !words.every((word) => content.includes(word));
      });
    };
  });

  const dialog = document.body.appendChild(document.createElement("dialog"));
  dialog.className = "large";
  dialog.onclick = () => dialog.close();
  document.querySelectorAll("figure img").forEach((image) => {
    const open = () => {
      dialog.replaceChildren(image.cloneNode());
      dialog.showModal();
    };
    Object.assign(image, { tabIndex: 0, role: "button", onclick: open });
    image.onkeydown = (event) => {
      if (event.key === "Enter") open();
    };
  });
});
