/** Elements of the page: native form controls, so that the keyboard and screen readers find what they know. */

type Attributes = Record<string, string | number | boolean>;

const SVG = ["svg", "path", "line", "circle", "polyline", "rect", "title"];

/** An element with attributes and children; text becomes text, never markup. `true` is an attribute without a value. */
// biome-ignore lint/suspicious/noExplicitAny: the caller knows which element it makes
export function make(name: string, attributes: Attributes = {}, ...children: (Node | string)[]): any {
  const svg = SVG.includes(name);
  const element = svg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value !== false) element.setAttribute(key, value === true ? "" : String(value));
  }
  element.append(...children);
  return element;
}

export function button(text: string, act: () => void, attributes: Attributes = {}): HTMLButtonElement {
  const made: HTMLButtonElement = make("button", { type: "button", ...attributes }, text);
  made.addEventListener("click", act);
  return made;
}

export interface Slider {
  row: HTMLElement;
  input: HTMLInputElement;
  value: number;
}

/** A labelled slider; `say` puts its value in words, for the eye and for a screen reader. */
export function slider(
  text: string,
  [least, most, step]: readonly [number, number, number],
  start: number,
  say: (value: number) => string,
  changed: (value: number) => void,
): Slider {
  const input: HTMLInputElement = make("input", { type: "range", min: least, max: most, step, value: start });
  const words = make("span", { class: "slider-value", "aria-hidden": "true" });
  const row = make("div", { class: "slider-row" }, make("label", {}, make("span", {}, text), input), words);
  const tell = () => {
    words.textContent = say(Number(input.value));
    input.setAttribute("aria-valuetext", words.textContent ?? "");
  };
  input.addEventListener("input", () => {
    tell();
    changed(Number(input.value));
  });
  tell();
  return {
    row,
    input,
    get value() {
      return Number(input.value);
    },
    set value(value: number) {
      input.value = String(value);
      tell();
    },
  };
}

export interface Choice {
  row: HTMLElement;
  value: string;
}

/** A labelled list to choose from: pairs of value and words. */
export function choice(text: string, options: [string, string][], changed: (value: string) => void): Choice {
  const select: HTMLSelectElement = make(
    "select",
    {},
    ...options.map(([value, words]) => make("option", { value }, words)),
  );
  select.addEventListener("change", () => changed(select.value));
  return {
    row: make("div", { class: "lab-choice" }, make("label", {}, make("span", {}, text), select)),
    get value() {
      return select.value;
    },
    set value(value: string) {
      select.value = value;
    },
  };
}

/** Offer a file for download. */
export function save(name: string, content: Blob): void {
  const address = URL.createObjectURL(content);
  const link = make("a", { href: address, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 10_000);
}

export const quiet = () => window.matchMedia("(prefers-reduced-motion: reduce)").matches;
