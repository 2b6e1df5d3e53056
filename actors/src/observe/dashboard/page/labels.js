// Labels beside their symbols. They do not cover each other: the more important label takes its place first, and a label without room is left out.

/// Font size in pixels, and the parts of a label above and below its baseline.
const FONT_PX = 12;
const ABOVE_PX = 12;
const BELOW_PX = 4;
/// Maximum length of a label in characters.
const MAX_LENGTH = 18;
/// Number of measured texts after which the measures are taken anew.
const MAX_MEASURED = 4000;

export class Labels {
  placed = [];
  #wishes = [];
  /// Taken areas by the line of text in which they are, so that few of them are compared.
  #lines = new Map();
  /// The place of each label of the picture before, so that labels stay where they are while they can.
  #before = new Map();
  #widths = new Map();
  #pen = document.createElement("canvas").getContext("2d");
  #family = null;

  /// Begins a picture of this size, with the font of `element`.
  begin(box, element) {
    this.#family ??= getComputedStyle(element).fontFamily;
    Object.assign(this, { box, placed: [] });
    this.#wishes = [];
    this.#lines.clear();
    if (this.#widths.size > MAX_MEASURED) this.#widths.clear();
  }

  /// Keeps an area [left, top, right, bottom] free of labels.
  reserve(area) {
    for (const line of linesOf(area)) this.#lines.set(line, [...(this.#lines.get(line) ?? []), area]);
  }

  /// Adds a label { key, rank, words, x, y, gap, style } beside the symbol at x and y. Higher ranks are placed first.
  put(label) {
    this.#wishes.push(label);
  }

  /// Places the labels of this picture.
  place() {
    const before = new Map();
    for (const { key, words, x, y, gap, style } of this.#wishes.sort((a, b) => b.rank - a.rank)) {
      const shown = words.length > MAX_LENGTH ? words.slice(0, MAX_LENGTH - 1) + "…" : words;
      const width = this.#width(shown, /vehicle|pick|cue/.test(style));
      const aside = gap * 0.75;
      const places = [
        ["start", x + gap, y + 4], ["end", x - gap, y + 4], ["middle", x, y - gap - 2], ["middle", x, y + gap + 11],
        ["start", x + aside, y - aside], ["start", x + aside, y + aside + 9], ["end", x - aside, y - aside], ["end", x - aside, y + aside + 9],
      ];
      const last = this.#before.get(key);
      const order = places.map((_, index) => index);
      for (const index of last === undefined ? order : [last, ...order]) {
        const [anchor, lx, ly] = places[index];
        const left = anchor === "start" ? lx : anchor === "end" ? lx - width : lx - width / 2;
        const area = [left - 2, ly - ABOVE_PX, left + width + 2, ly + BELOW_PX];
        if (!this.#isFree(area)) continue;
        this.reserve(area);
        before.set(key, index);
        this.placed.push({ key, text: shown, x: lx, y: ly, anchor, class: style });
        break;
      }
    }
    this.#before = before;
  }

  #isFree(area) {
    const [left, top, right, bottom] = area;
    if (left < 0 || top < 0 || right > this.box.width || bottom > this.box.height) return false;
    return linesOf(area).every((line) => !this.#lines.get(line)?.some((t) => left < t[2] && right > t[0] && top < t[3] && bottom > t[1]));
  }

  #width(words, isBold) {
    const key = isBold ? `${words}\n` : words;
    if (!this.#widths.has(key)) {
      this.#pen.font = `${isBold ? 700 : 400} ${FONT_PX}px ${this.#family}`;
      this.#widths.set(key, this.#pen.measureText(words).width);
    }
    return this.#widths.get(key);
  }
}

/// Numbers of the lines of text that an area touches.
function linesOf([, top, , bottom]) {
  const first = Math.floor(top / (ABOVE_PX + BELOW_PX));
  return Array.from({ length: Math.floor(bottom / (ABOVE_PX + BELOW_PX)) - first + 1 }, (_, index) => first + index);
}
