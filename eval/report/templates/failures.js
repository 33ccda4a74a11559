"use strict";
(() => {
  const rows = JSON.parse(document.getElementById("rows").textContent);
  const [KIND, CUE, CAUSE, CONDITION, DISTANCE_M, SEVERITY, RUN, AT, PICTURE, DISTANCE] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9];
  const columns = { kind: KIND, cue: CUE, cause: CAUSE, condition: CONDITION, distance: DISTANCE };
  const form = document.querySelector("form"), list = document.querySelector("ul.cards");
  const nav = document.querySelector("nav"), count = document.getElementById("count");
  const perPage = 60;
  const far = (row) => row[DISTANCE_M] === null ? Infinity : row[DISTANCE_M];
  const orders = {
    severity: (a, b) => a - b,
    distance: (a, b) => far(rows[a]) - far(rows[b]) || a - b,
    time: (a, b) => (rows[a][RUN] < rows[b][RUN] ? -1 : rows[a][RUN] > rows[b][RUN] ? 1 : rows[a][AT] - rows[b][AT]) || a - b,
  };
  const element = (name, text, parent) => {
    const made = document.createElement(name);
    if (text !== undefined) made.textContent = text;
    if (parent) parent.append(made);
    return made;
  };
  const card = (i) => {
    const row = rows[i], link = element("a", undefined, element("li"));
    link.href = "f/" + String(i + 1).padStart(5, "0") + ".html";
    if (row[PICTURE]) {
      const image = element("img", undefined, link);
      image.loading = "lazy"; image.alt = ""; image.src = "t/" + row[PICTURE];
    } else element("span", "no picture", link).className = "none";
    const text = element("span", undefined, link);
    text.className = "text";
    element("b", row[KIND] + ": " + row[CUE].replaceAll("_", " "), text);
    text.append(row[CAUSE]);
    const away = row[DISTANCE_M] === null ? "" : ", " + row[DISTANCE_M].toFixed(0) + "\u00a0m\u00a0away";
    element("span", row[RUN] + " at " + row[AT].toFixed(1) + "\u00a0s" + away, text);
    const conditions = row[CONDITION].filter((tag) => tag !== "none");
    element("span", ["severity " + row[SEVERITY].toFixed(1), ...conditions].join(", "), text);
    return link.parentNode;
  };
  const show = (page, moved) => {
    const wanted = Object.entries(columns).map(([name, column]) => [column, form.elements[name].value]).filter(([, value]) => value);
    const found = [];
    for (let i = 0; i < rows.length; i++)
      if (wanted.every(([column, value]) => column === CONDITION ? rows[i][column].includes(value) : rows[i][column] === value)) found.push(i);
    found.sort(orders[form.elements.sort.value]);
    const pages = Math.max(Math.ceil(found.length / perPage), 1);
    page = Math.min(Math.max(page, 1), pages);
    list.replaceChildren(...found.slice(perPage * (page - 1), perPage * page).map(card));
    count.textContent = found.length.toLocaleString("en") + " of " + rows.length.toLocaleString("en") + " failures";
    nav.replaceChildren();
    const turn = (text, to) => { const button = element("button", text, nav); button.type = "button"; button.onclick = () => show(to, true); };
    if (page > 1) turn("Previous page", page - 1);
    element("span", "page " + page + " of " + pages, nav).className = "soft";
    if (page < pages) turn("Next page", page + 1);
    const state = new URLSearchParams([...new FormData(form)].filter(([name, value]) => value && value !== "severity"));
    if (page > 1) state.set("page", page);
    history.replaceState(null, "", "#" + state);
    if (moved) { scrollTo(0, 0); list.querySelector("a")?.focus({ preventScroll: true }); }
  };
  const state = new URLSearchParams(location.hash.slice(1));
  for (const [name, value] of state) if (name in form.elements) form.elements[name].value = value;
  form.hidden = false;
  document.querySelector(".lists").hidden = true;
  form.addEventListener("change", () => show(1));
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(() => show(1)));
  show(Number(state.get("page")) || 1);
})();
