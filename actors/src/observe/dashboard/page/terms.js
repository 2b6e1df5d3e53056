// Explanations of terms, shown at what is marked with `data-term` when it is pointed at or has the focus.

const TERMS = {
  leader: "The node that joins the reports of all vehicles into one map, and sends it to all nodes.",
  standby: "The node that takes over at once when the leader fails.",
  epoch: "Number of a leadership, also called epoch. It grows with each change of leader, so that messages of an earlier one are refused.",
  round: "The leader makes one map after another. This is the number of the newest one, its round.",
  latency: "Time from the oldest picture that went into a map until that map arrived here.",
  place: "A known location of the cell, such as a parking spot, that vehicles observe.",
  verdict: "The label of a place on which the vehicles agree, after their votes were weighted.",
  margin: "Lead of the label over the next best one, in weighted votes. Below a quarter of the label's votes it is close.",
  reputation: "How much a vehicle's reports count, from 0 to 1. It rises where others agree, and falls where they contradict.",
  confidence: "Probability that the object is there, and within 1.5 m of its position. For a place: how sure its label is.",
  existence: "Probability that the object exists and is still there, wherever exactly it stands.",
  witnesses: "The vehicles whose detections of the last seconds went into the object or place.",
  spread: "Half length and half width of the ellipse that holds the true position with a probability of 95 %.",
  gap: "Time from the previous leader's last map to this leader's first.",
  trouble: "Something that is wrong at present. It disappears from the list when its cause is removed.",
};

/// Shows the meaning of terms, also to screen readers.
export function explainTerms() {
  const tip = Object.assign(document.createElement("div"), { id: "tip", hidden: true });
  tip.setAttribute("aria-hidden", "true");
  const told = document.createElement("div");
  told.hidden = true;
  for (const [term, words] of Object.entries(TERMS)) told.append(Object.assign(document.createElement("p"), { id: `about-${term}`, textContent: words }));
  document.body.append(told, tip);
  for (const element of document.querySelectorAll("[data-term]")) markTerm(element, element.dataset.term);
  const show = ({ target }) => {
    const marked = target.closest?.("[data-term]");
    if (target === tip || (!marked && tip.contains(target))) return;
    tip.hidden = !marked;
    if (!marked) return;
    tip.textContent = TERMS[marked.dataset.term];
    const [around, { width, height }] = [marked.getBoundingClientRect(), tip.getBoundingClientRect()];
    const below = around.bottom + height + 6 < innerHeight;
    tip.style.left = `${Math.max(8, Math.min(around.left, innerWidth - width - 8))}px`;
    tip.style.top = `${below ? around.bottom + 4 : around.top - height - 4}px`;
  };
  document.addEventListener("pointerover", show);
  document.addEventListener("focusin", show);
  document.addEventListener("focusout", () => (tip.hidden = true));
  document.addEventListener("scroll", () => (tip.hidden = true), true);
  document.addEventListener("keydown", ({ key }) => key === "Escape" && (tip.hidden = true));
}

/// Marks an element as a term.
export function markTerm(element, term) {
  element.classList.add("term");
  element.tabIndex = 0;
  element.dataset.term = term;
  element.setAttribute("aria-describedby", `about-${term}`);
}
