// The list of islands, and which are selected.

const $ = (id) => document.getElementById(id);

export class Islands {
  constructor(send) {
    this.send = send;
    this.key = "";
    this.selected = [];
    $("islands").addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button) this.#choose(Number(button.dataset.island), event.shiftKey || event.ctrlKey || event.metaKey);
    });
  }

  #choose(island, more) {
    const chosen = new Set(more ? this.selected : []);
    if (more && chosen.has(island)) chosen.delete(island);
    else chosen.add(island);
    this.send({ do: "select", islands: [...chosen].sort((a, b) => a - b) });
  }

  /** Show the islands of a map at rest. */
  show(header) {
    const several = header.count > 1;
    $("islands-section").hidden = !header.mapped;
    $("islands").hidden = $("select-all").hidden = !several;
    $("islands-count").textContent = several ? `${header.selected.length} of ${header.count} selected` : "";
    const key = JSON.stringify(header.islands);
    if (key === this.key) return;
    this.key = key;
    const items = header.islands.map((island, k) => {
      const item = document.createElement("li");
      const button = document.createElement("button");
      const sign = island.good ? "✓" : "✗";
      button.dataset.island = k;
      button.textContent = `${sign} ${k}: ${island.triangles.toLocaleString("en")}`;
      button.title = `Island ${k}, ${island.triangles.toLocaleString("en")} triangles${island.good ? "" : ", not certified bijective"}. Shift+click selects several.`;
      item.append(button);
      return item;
    });
    if (header.count > header.islands.length) {
      const item = document.createElement("li");
      item.textContent = `… ${header.count - header.islands.length} more; click them in the views`;
      items.push(item);
    }
    $("islands").replaceChildren(...items);
    this.select(header.selected);
  }

  select(selected) {
    this.selected = selected;
    const chosen = new Set(selected);
    for (const button of $("islands").querySelectorAll("button")) {
      button.setAttribute("aria-pressed", chosen.has(Number(button.dataset.island)));
    }
  }
}
