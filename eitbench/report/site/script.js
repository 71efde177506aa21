"use strict";
// Sorting, filtering and the theme. Without this file the pages say the same: all rows, best first.

const root = document.documentElement;
const darkByDefault = matchMedia("(prefers-color-scheme: dark)");

function remembered(theme) {             // a browser may forbid a page from a file to remember anything
  try {
    if (theme) localStorage.setItem("theme", theme);
    return localStorage.getItem("theme");
  } catch {
    return theme;
  }
}

const chosen = remembered();
if (chosen === "dark" || chosen === "light") root.dataset.theme = chosen;   // before anything is drawn

function themeButton(button) {
  const isDark = () => (root.dataset.theme || (darkByDefault.matches ? "dark" : "light")) === "dark";
  const show = () => button.setAttribute("aria-pressed", isDark());
  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    remembered(root.dataset.theme);
    show();
  });
  darkByDefault.addEventListener("change", show);
  button.hidden = false;
  show();
}

function sortable(table) {
  const headers = [...table.tHead.rows[0].cells];
  const body = table.tBodies[0];
  headers.forEach((header, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...header.childNodes);
    header.append(button);
    button.addEventListener("click", () => {
      const descending = header.getAttribute("aria-sort") === "ascending";
      headers.forEach((other) => other.removeAttribute("aria-sort"));
      header.setAttribute("aria-sort", descending ? "descending" : "ascending");
      body.append(...sorted([...body.rows], column, descending));
    });
  });
}

function sorted(rows, column, descending) {
  const value = (row) => row.cells[column].dataset.value;
  const known = rows.filter((row) => value(row) !== undefined);
  const isNumber = known.every((row) => Number.isFinite(Number(value(row))));
  const order = (a, b) => isNumber ? value(a) - value(b) : value(a).localeCompare(value(b), "en");
  known.sort((a, b) => descending ? order(b, a) : order(a, b));
  return [...known, ...rows.filter((row) => value(row) === undefined)];       // who has no score comes last
}

function filtering(form) {
  const blocks = [...document.querySelectorAll(".block")];
  const said = form.querySelector("output");
  const apply = () => {
    const words = form.elements.words.value.toLocaleLowerCase("en").split(/\s+/).filter(Boolean);
    const left_out = [...form.querySelectorAll("input[type=checkbox]")].filter((box) => !box.checked).map((box) => box.name);
    let shown = 0, all = 0;
    for (const block of blocks) {
      let any = false;
      for (const row of block.querySelectorAll("tbody tr")) {
        const text = `${block.dataset.words} ${row.querySelector("td:nth-child(2)").textContent}`.toLocaleLowerCase("en");
        const flags = (row.dataset.flags || "").split(" ");
        row.hidden = left_out.some((name) => flags.includes(name)) || !words.every((word) => text.includes(word));
        any ||= !row.hidden;
        shown += !row.hidden;
        all += 1;
      }
      block.hidden = !any;
    }
    for (const section of document.querySelectorAll("section")) {
      const own = [...section.querySelectorAll(".block")];
      section.hidden = own.length > 0 && own.every((block) => block.hidden);
    }
    said.textContent = `${shown} of ${all} rows`;
  };
  for (const box of form.querySelectorAll("input[type=checkbox]")) {          // no choice where there is nothing to hide
    box.parentElement.hidden = !document.querySelector(`[data-flags~="${box.name}"]`);
  }
  form.addEventListener("input", apply);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.hidden = false;
  apply();
}

document.addEventListener("DOMContentLoaded", () => {
  document.querySelectorAll(".theme").forEach(themeButton);
  document.querySelectorAll("table.board").forEach(sortable);
  document.querySelectorAll("form.controls").forEach(filtering);
});
