"use strict";
// Sorting, filtering, paging, what headings mean, the theme. Without this file the pages say the same,
// best first; of a board of thousands the first hundred.

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

const boards = new Map();                // table -> its lines, wherever they are
const PAGE = 100;

class Board {                            // a table; of a long one a page at a time is in the document
  constructor(table) {
    this.table = table;
    this.rows = [...table.tBodies];      // each a line with its parts, which are a method and its trainings
    this.file = table.dataset.rows;      // with all lines; undefined where all are in the document
    this.all = Number(table.dataset.all) || this.rows.length;
    this.page = 0;
    if (this.file) this.pager(table.closest(".card").nextElementSibling);
  }

  async whole() {                        // a script, since a page that is a file may read no other
    if (this.file && !this.given) {
      this.given = new Promise((resolve, reject) => {
        waiting.set(this.file, resolve);
        const script = document.createElement("script");
        script.src = this.file;
        script.onerror = reject;
        document.head.append(script);
      }).then((lines) => {
        const made = document.createElement("template");
        made.innerHTML = lines.join("");
        this.rows = [...made.content.children];
        applyAll();
      });
    }
    await this.given;
  }

  get shown() { return this.rows.filter((row) => !row.hidden); }

  draw(page = 0) {
    if (!this.given) return;
    const shown = this.shown;
    const last = Math.max(0, Math.ceil(shown.length / PAGE) - 1);
    this.page = Math.min(Math.max(page, 0), last);
    const begin = this.page * PAGE;
    const rows = shown.slice(begin, begin + PAGE);
    [...this.table.tBodies].forEach((body) => body.remove());
    this.table.append(...rows);
    this.words.textContent = `${rows.length ? begin + 1 : 0} to ${begin + rows.length} of ${shown.length}.`;
    this.buttons[0].disabled = this.page === 0;
    this.buttons[1].disabled = this.page === last;
  }

  pager(line) {
    this.words = line.querySelector("span");
    this.buttons = ["Previous", "Next"].map((text, i) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = text;
      button.addEventListener("click", async () => {
        await this.whole();
        this.draw(this.page + (i ? 1 : -1));
      });
      return button;
    });
    this.buttons[0].disabled = true;
    line.prepend(...this.buttons);
  }
}

const waiting = new Map();
function giveRows(file, lines) {         // what a file of lines calls
  waiting.get(file)(lines);
}

let applyAll = () => {};                 // what is looked for and left out, once there is a form

function sortable(table) {
  const headers = [...table.tHead.rows[0].cells];
  const board = new Board(table);
  boards.set(table, board);
  headers.forEach((header, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...header.childNodes);
    header.append(button);
    button.addEventListener("click", async () => {
      const descending = header.getAttribute("aria-sort") === "ascending";
      headers.forEach((other) => other.removeAttribute("aria-sort"));
      header.setAttribute("aria-sort", descending ? "descending" : "ascending");
      await board.whole();
      board.rows = sorted(board.rows, column, descending);
      if (board.file) board.draw();
      else table.append(...board.rows);
    });
  });
}

function sorted(rows, column, descending) {
  const value = (row) => row.rows[0].cells[column].dataset.value;
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
      const board = boards.get(block.querySelector("table.board"));
      let any = 0;
      for (const row of board.rows) {
        const names = [...row.querySelectorAll("td:nth-child(2)")].map((cell) => cell.textContent);
        const text = `${block.dataset.words} ${names.join(" ")}`.toLocaleLowerCase("en");
        const flags = (row.rows[0].dataset.flags || "").split(" ");
        row.hidden = left_out.some((name) => flags.includes(name)) || !words.every((word) => text.includes(word));
        any += !row.hidden;
      }
      any += board.all - board.rows.length;           // not looked at yet
      block.hidden = !any;
      shown += any;
      all += board.all;
      board.draw();
    }
    for (const section of document.querySelectorAll("section")) {
      const own = [...section.querySelectorAll(".block")];
      section.hidden = own.length > 0 && own.every((block) => block.hidden);
    }
    said.textContent = `${shown} of ${all} lines`;
  };
  for (const box of form.querySelectorAll("input[type=checkbox]")) {          // no choice where there is nothing to hide
    box.parentElement.hidden = !document.querySelector(`[data-flags~="${box.name}"], [data-rows]`);
  }
  applyAll = apply;
  form.addEventListener("input", async () => {
    await Promise.all([...boards.values()].map((board) => board.whole()));
    apply();
  });
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
  tip.ariaHidden = "true";                              // the button says it too
  document.body.append(tip);
  headers.forEach((header) => explaining(tip, header));
}

function pausing(button) {               // puts the still picture in the place of the moving one, and back
  const picture = button.parentElement.querySelector("picture");
  const image = picture.querySelector("img");
  const moving = image.getAttribute("src");
  let moves = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  const show = () => { button.textContent = moves ? "Stop the picture" : "Play the picture"; };
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
