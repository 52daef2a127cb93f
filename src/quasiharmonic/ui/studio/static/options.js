// The options of Unwrap, as the library declares them: a field for each, with a picture and an explanation of what it does.

const $ = (id) => document.getElementById(id);

// Pictures of 56 × 40 units; class "seam" is a seam, "soft" what stays, "fill" and "other" are two parts.
const PICTURES = {
  max_stretch: '<path class="soft" d="M4 10h18v20H4z"/><path d="M30 6h22v28H30z"/><path class="seam" d="M4 20h18M30 20h22"/>',
  max_charts: '<circle class="fill" cx="14" cy="20" r="10"/><path class="other" d="M32 10h20v20H32z"/>',
  symmetry: '<path class="fill" d="M26 8C8 2 2 18 8 30c6 6 14 2 18-4z"/><path class="other" d="M30 8c18-6 24 10 18 22-6 6-14 2-18-4z"/><path class="seam" d="M28 3v34"/>',
  hard_edges: '<path class="soft" d="M12 12h22v22H12zM12 12l10-8h22v22l-10 8M34 12l10-8"/><path class="seam" d="M12 12h22v22M34 12l10-8"/>',
  labels: '<path class="fill" d="M6 8h20v24H6z"/><path class="other" d="M26 8h24v24H26z"/><path class="seam" d="M26 4v32"/>',
  straighten: '<path class="soft" d="M4 30C8 10 20 8 24 12l-5 6c-4-2-8 4-9 14z"/><path class="fill" d="M34 6h16v28H34z"/><path d="M34 13h16M34 20h16M34 27h16"/>',
  up: '<path class="fill" d="M18 8h20v24H18z"/><path class="seam" d="M18 32h20"/><path d="M48 30V8m-4 5l4-5 4 5"/>',
  divide_for_packing: '<path class="soft" d="M4 16h22v8H4z"/><path class="fill" d="M34 10h18v8H34z"/><path class="other" d="M34 22h18v8H34z"/>',
  texels_per_unit: '<path class="soft" d="M6 6h18v28H6zM12 6v28M18 6v28M6 15h18M6 25h18"/><path d="M32 14h18v12H32zM38 14v12M44 14v12M32 20h18"/>',
};

/** Build the fields of the options, and the list of energies. */
export function showOptions(header) {
  $("polish-energy").replaceChildren(...Object.entries(header.energies).map(([name, words]) => new Option(words, name)));
  $("unwrap-options").replaceChildren(...header.options.map(field));
}

function field({ name, help, default: standard, choices }) {
  const row = document.createElement("div");
  row.className = "option";
  const title = name.replaceAll("_", " ");
  const id = `unwrap-${name}`;
  row.innerHTML = `<svg viewBox="0 0 56 40" aria-hidden="true">${PICTURES[name] ?? ""}</svg><label for="${id}"></label><p class="small"></p>`;
  row.querySelector("label").textContent = title[0].toUpperCase() + title.slice(1);
  row.querySelector("p").textContent = help;
  const input = document.createElement(choices.length ? "select" : "input");
  Object.assign(input, { id, name });
  if (choices.length) {
    if (standard === null && !choices.includes("none")) input.append(new Option("none", ""));
    for (const choice of choices) input.append(new Option(choice, choice));
    input.value = standard ?? "";
  } else if (standard === false) input.type = "checkbox";
  else {
    Object.assign(input, { type: "number", min: 0, step: "any" });
    input.setAttribute("value", standard ?? "");
  }
  row.querySelector("label").after(input);
  return row;
}

/** Return the options that differ from the library's defaults. */
export function chosenOptions() {
  const chosen = {};
  for (const input of $("unwrap-options").querySelectorAll("input, select")) {
    if (input.type === "checkbox") {
      if (input.checked) chosen[input.name] = true;
    } else if (input.value !== "" && input.value !== initial(input)) {
      chosen[input.name] = input.type === "number" ? Number(input.value) : input.value;
    }
  }
  return chosen;
}

const initial = (input) => (input.name === "symmetry" ? "auto" : input.defaultValue);
