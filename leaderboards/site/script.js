"use strict";
// Sorting, filtering, explanations of headings, colour scheme. Without scripts the pages show the same, best first.

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
  const show = () => { button.textContent = isDark() ? "Use light colours" : "Use dark colours"; };
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
  headers.forEach((header, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...header.childNodes);
    header.append(button);
    button.addEventListener("click", () => {
      const descending = header.getAttribute("aria-sort") === "ascending";
      headers.forEach((other) => other.removeAttribute("aria-sort"));
      header.setAttribute("aria-sort", descending ? "descending" : "ascending");
      table.append(...sorted([...table.tBodies], column, descending));
    });
  });
}

function sorted(bodies, column, descending) {      // rows without a value come last
  const value = (body) => body.rows[0].cells[column].dataset.value;
  const known = bodies.filter((body) => value(body) !== undefined);
  const isNumber = known.every((body) => Number.isFinite(Number(value(body))));
  const order = (a, b) => isNumber ? value(a) - value(b) : value(a).localeCompare(value(b), "en");
  known.sort((a, b) => descending ? order(b, a) : order(a, b));
  return [...known, ...bodies.filter((body) => value(body) === undefined)];
}

function filtering(form) {
  const blocks = [...document.querySelectorAll(".block")];
  const apply = () => {
    const words = form.elements.words.value.toLocaleLowerCase("en").split(/\s+/).filter(Boolean);
    const left_out = [...form.querySelectorAll("input[type=checkbox]")].filter((box) => !box.checked).map((box) => box.name);
    let shown = 0, all = 0;
    for (const block of blocks) {
      const bodies = [...block.querySelector("table.board").tBodies];
      for (const body of bodies) {
        const names = [...body.querySelectorAll("td:nth-child(2)")].map((cell) => cell.textContent);
        const text = `${block.dataset.words} ${names.join(" ")}`.toLocaleLowerCase("en");
        const flags = (body.rows[0].dataset.flags || "").split(" ");
        body.hidden = left_out.some((name) => flags.includes(name)) || !words.every((word) => text.includes(word));
      }
      block.hidden = bodies.every((body) => body.hidden);
      shown += bodies.filter((body) => !body.hidden).length;
      all += bodies.length;
    }
    for (const section of document.querySelectorAll("section")) {
      const own = [...section.querySelectorAll(".block")];
      section.hidden = own.length > 0 && own.every((block) => block.hidden);
    }
    form.querySelector("output").textContent = `${shown} of ${all} rows`;
  };
  for (const box of form.querySelectorAll("input[type=checkbox]")) {      // no choice where there is nothing to hide
    box.parentElement.hidden = !document.querySelector(`[data-flags~="${box.name}"]`);
  }
  form.addEventListener("input", apply);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.hidden = false;
  apply();
}

function explaining(tip, header) {       // what a heading means, while it is pointed at or has the focus
  const text = header.title;
  const button = header.querySelector("button");
  header.removeAttribute("title");
  const place = () => {
    const box = button.getBoundingClientRect();
    tip.style.left = `${Math.max(8, Math.min(box.left, innerWidth - tip.offsetWidth - 8))}px`;
    tip.style.top = `${box.bottom + tip.offsetHeight > innerHeight ? box.top - tip.offsetHeight : box.bottom}px`;
  };
  const show = () => {
    tip.textContent = text;
    tip.showPopover();
    place();
    addEventListener("scroll", place, {passive: true});
  };
  const hide = () => {
    tip.hidePopover();
    removeEventListener("scroll", place);
  };
  button.setAttribute("aria-description", text);
  header.addEventListener("mouseenter", show);
  button.addEventListener("focus", () => { if (button.matches(":focus-visible")) show(); });
  header.addEventListener("mouseleave", hide);
  button.addEventListener("blur", hide);
  button.addEventListener("keydown", (event) => { if (event.key === "Escape") hide(); });
}

function explanations() {
  const headers = document.querySelectorAll("table.board th[title]");
  const tip = document.createElement("div");
  if (!headers.length || !tip.showPopover) return;      // an older browser shows the title
  tip.className = "tip";
  tip.popover = "manual";
  tip.ariaHidden = "true";                              // the button has the same description
  document.body.append(tip);
  headers.forEach((header) => explaining(tip, header));
}

function pausing(button) {               // puts the still picture in the place of the moving one, and back
  const picture = button.parentElement.querySelector("picture");
  const image = picture.querySelector("img");
  const moving = image.getAttribute("src");
  let moves = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  const show = () => { button.textContent = moves ? "Pause" : "Play"; };
  button.addEventListener("click", () => {
    picture.querySelector("source")?.remove();
    moves = !moves;
    image.src = moves ? moving : image.dataset.still;
    show();
  });
  button.hidden = false;
  show();
}

document.addEventListener("DOMContentLoaded", () => {
  document.querySelectorAll(".pause").forEach(pausing);
  document.querySelectorAll(".theme").forEach(themeButton);
  document.querySelectorAll("table.board").forEach(sortable);
  explanations();
  document.querySelectorAll("form.controls").forEach(filtering);
});
