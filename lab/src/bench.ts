/** The bench: a drawing, what it inflates to, and everything that can be changed about it. */

import type { Descriptors, Targets } from "./descriptors.ts";
import { button, choice, make, quiet, save, slider } from "./dom.ts";
import { Drawing } from "./drawing.ts";
import { ELEMENTS, type Element } from "./equilibrium.ts";
import type { InflateOptions } from "./inflation.ts";
import { EDGES, type Edge, FRAME, type Image, type LabelOptions } from "./labels.ts";
import type { Remote } from "./remote.ts";
import {
  DEFAULTS,
  fromFragment,
  fromJson,
  fromPicture,
  type NumberName,
  RANGES,
  type Settings,
  type State,
  toFragment,
  toJson,
  toPng,
  toSvg,
  unpacked,
} from "./share.ts";
import { type Simulation, sentence } from "./simulate.ts";
import starts from "./starts.json";
import { draw, frameOf, legend, QUANTITIES, type Quantity } from "./view.ts";
import { Refusal } from "./words.ts";

const STEP_TIME = 180; // milliseconds that a load step is shown
const FIRST = starts.findIndex(({ name }) => name === "a drawn structure (1)"); // which is shown at first
const PICTURE = 560; // canvas pixels of a picture's side
const ELEMENT_WORDS: Record<Element, string> = { "mean-dilatation": "mean dilatation", q1: "plain Q1, which locks" };

export class Bench {
  readonly element: HTMLElement;
  readonly drawing: Drawing;
  settings: Settings = { ...DEFAULTS };
  simulation: Simulation | null = null;
  /** What the structure is asked for, which is saved with it. */
  asked: { get: () => Targets; set: (targets: Targets) => void } = { get: () => ({}), set: () => {} };

  private readonly views: HTMLCanvasElement[];
  private readonly legend = legend();
  private readonly status: HTMLElement = make("p", { class: "lab-status", role: "status", "aria-live": "polite" });
  private readonly numbers: HTMLElement = make("div", { class: "lab-numbers" });
  private readonly load;
  private readonly play: HTMLButtonElement;
  private readonly quantity;
  private readonly controls: ((settings: Settings) => void)[] = [];
  private timer = 0;
  private step = Number.POSITIVE_INFINITY; // the last one, whichever that is
  private running = false;
  private again = false;
  private notice = ""; // what was wrong with the address, until something is drawn

  constructor(
    private readonly solver: Remote,
    private readonly small: boolean,
  ) {
    this.drawing = new Drawing(() => {
      this.notice = "";
      this.simulate();
    });
    const view = () => make("canvas", { width: PICTURE, height: PICTURE, class: "lab-view", role: "img" });
    this.views = [view(), view()];
    this.load = slider(
      "Load step",
      [0, 10, 1],
      10,
      (value) => this.stepWords(value),
      (value) => this.go(value),
    );
    this.play = button("Inflate", () => (this.timer ? this.stop() : this.start()));
    const quantities = Object.entries(QUANTITIES).map(([name, { words }]) => [name, words] as [string, string]);
    this.quantity = choice("Colour", quantities, () => this.show());
    const figure = (canvas: HTMLElement, words: string) => make("figure", {}, canvas, make("figcaption", {}, words));
    const result = make(
      "div",
      { class: "lab-result" },
      make("div", { class: "lab-views" }, figure(this.views[0], "at rest"), figure(this.views[1], "inflated")),
      this.legend.element,
      make("div", { class: "lab-motion" }, this.load.row, this.play, this.quantity.row),
      this.status,
      this.numbers,
    );
    const left = make("div", { class: "lab-left" }, this.startFrom(), this.drawing.element);
    this.element = make("div", { class: "lab-bench" }, left, result);
    if (!small) this.element.append(make("div", { class: "lab-more" }, this.settingsPanel(), this.saveAndShare()));
    this.acceptFiles();
  }

  get options(): LabelOptions & InflateOptions {
    const { pressure, lambda, mu, wall, clamped, element } = this.settings;
    return { pressure, lame: [lambda, mu], wall, clamped, element };
  }

  private get state(): State {
    return { image: this.drawing.image, settings: this.settings, targets: this.asked.get() };
  }

  /** Show what the page's address says: at first a structure where it says nothing, later what is drawn stays. */
  open(first: boolean): void {
    if (first) this.take(start(starts[FIRST].image));
    try {
      const told = this.small ? null : fromFragment(location.hash);
      if (told) this.restore(told);
    } catch (error) {
      this.notice = `${sentence((error as Error).message)} `;
      this.simulate();
    }
  }

  /** Replace the drawing. */
  take(image: Image): void {
    this.drawing.set(image);
  }

  private restore({ image, settings, targets }: State): void {
    this.settings = { ...settings };
    for (const follow of this.controls) follow(this.settings);
    this.asked.set(targets);
    this.take(image);
  }

  /** An error as a sentence on the page. */
  tell(error: unknown): void {
    if (!(error instanceof Refusal)) console.error(error);
    this.status.textContent = sentence((error as Error).message);
  }

  /** Inflate the drawing and show it. While that is going on, only the last of further strokes is kept. */
  async simulate(): Promise<void> {
    this.again = true;
    if (this.running) return;
    this.running = true;
    while (this.again) {
      this.again = false;
      try {
        const found = await this.solver.call<Simulation | string>("simulate", [this.drawing.image, this.options]);
        this.receive(found);
      } catch (error) {
        this.tell(error);
      }
    }
    this.running = false;
  }

  private receive(found: Simulation | string): void {
    const atEnd = this.step >= Number(this.load.input.max);
    this.simulation = typeof found === "string" ? null : found;
    this.element.classList.toggle("lab-empty", !this.simulation);
    if (typeof found === "string") {
      this.stop();
      this.status.textContent = `${this.notice}Nothing can be inflated. ${found}`;
      this.numbers.replaceChildren();
    } else {
      this.load.input.max = String(found.reached);
      if (atEnd || this.step > found.reached) this.step = found.reached;
      this.load.value = this.step;
      const note = found.note ? ` ${sentence(found.note)}` : "";
      const verdict = found.flaw ? `It cannot be built. ${found.flaw}` : "It can be built.";
      const { descriptors } = found;
      const size = descriptors ? ` Inflated it is ${inWords(descriptors)}.` : "";
      this.status.textContent = `${this.notice}${verdict}${note}${size}`;
      this.numbers.replaceChildren(...(found.descriptors ? numbers(found.descriptors, found.result.lame[1]) : []));
    }
    this.show();
  }

  private show(): void {
    const { simulation } = this;
    const quantity = this.quantity.value as Quantity;
    if (!simulation) {
      for (const canvas of this.views) {
        canvas.getContext("2d")?.clearRect(0, 0, PICTURE, PICTURE);
        canvas.setAttribute("aria-label", "nothing to show");
      }
      return;
    }
    draw(this.views[0], simulation, 0, quantity);
    draw(this.views[1], simulation, this.step, quantity);
    this.legend.tell(simulation, quantity);
    const { left, right, bottom, top } = frameOf(simulation);
    const size = simulation.descriptors
      ? `${inWords(simulation.descriptors)} when inflated`
      : `at most ${(top - bottom).toFixed(3)} high and ${(right - left).toFixed(3)} wide`;
    this.views[0].setAttribute(
      "aria-label",
      `The structure at rest, of ${simulation.result.mesh.cells.length / 4} wall pixels`,
    );
    this.views[1].setAttribute(
      "aria-label",
      `The structure at load step ${this.step} of ${simulation.result.pressures.length}, ${size}`,
    );
  }

  private stepWords(step: number): string {
    return step === 0 ? "at rest" : `${step} of ${this.simulation?.result.pressures.length ?? 10}`;
  }

  private go(step: number): void {
    this.stop();
    this.step = step;
    this.show();
  }

  private start(): void {
    const last = this.simulation?.reached ?? 0;
    if (quiet() || !last) {
      this.load.value = last;
      this.go(last);
      return;
    }
    this.step = -1;
    this.play.textContent = "Stop";
    const next = () => {
      this.step++;
      this.load.value = this.step;
      this.show();
      if (this.step >= (this.simulation?.reached ?? 0)) this.stop();
    };
    this.timer = window.setInterval(next, STEP_TIME);
    next();
  }

  private stop(): void {
    window.clearInterval(this.timer);
    this.timer = 0;
    this.play.textContent = "Inflate";
  }

  private startFrom(): HTMLElement {
    const options = starts.map(({ name }, k) => [String(k), name] as [string, string]);
    const chosen = choice("Start from", [["", "…"], ...options, ["empty", "nothing"]], (value) => {
      if (value === "") return;
      this.take(value === "empty" ? start("") : start(starts[Number(value)].image));
      chosen.value = "";
    });
    return chosen.row;
  }

  private settingsPanel(): HTMLElement {
    const change = (changes: Partial<Settings>) => {
      Object.assign(this.settings, changes);
      this.simulate();
    };
    const number = (name: NumberName, words: string, digits: number) => {
      const control = slider(
        words,
        RANGES[name],
        this.settings[name],
        (v) => v.toFixed(digits),
        (v) => change({ [name]: v }),
      );
      this.controls.push((settings) => {
        control.value = settings[name];
      });
      return control.row;
    };
    const list = <T extends string>(name: "clamped" | "element", words: string, options: [T, string][]) => {
      const control = choice(words, options, (value) => change({ [name]: value }));
      this.controls.push((settings) => {
        control.value = settings[name];
      });
      return control.row;
    };
    return make(
      "details",
      { class: "lab-settings" },
      make("summary", {}, "Pressure, material, wall, clamped edge, element"),
      number("pressure", "Pressure", 4),
      number("lambda", "Lamé λ", 2),
      number("mu", "Lamé μ", 4),
      number("wall", "Wall (pixels)", 0),
      list(
        "clamped",
        "Clamped edge",
        EDGES.map((edge): [Edge, string] => [edge, edge]),
      ),
      list(
        "element",
        "Element",
        ELEMENTS.map((one): [Element, string] => [one, ELEMENT_WORDS[one]]),
      ),
      button("The paper's values", () => {
        change(DEFAULTS);
        for (const follow of this.controls) follow(this.settings);
      }),
    );
  }

  private saveAndShare(): HTMLElement {
    const saves = (words: string, name: string, type: string, content: () => string | Promise<string | Blob>) =>
      button(words, async () => {
        try {
          const made = await content();
          save(name, typeof made === "string" ? new Blob([made], { type }) : made);
        } catch (error) {
          this.tell(error);
        }
      });
    const label = () => this.solver.call<Image>("label", [this.drawing.image, this.options]);
    const file: HTMLInputElement = make("input", {
      type: "file",
      accept: ".json,image/*",
      class: "lab-hidden",
      tabindex: -1,
      "aria-hidden": "true",
    });
    file.addEventListener("change", () => {
      if (file.files?.[0]) this.read(file.files[0]);
      file.value = "";
    });
    return make(
      "div",
      { class: "lab-buttons" },
      make("span", { class: "lab-title" }, "Save and share"),
      saves("PNG", "structure.png", "image/png", async () => toPng(await label())),
      saves("SVG (mm)", "outline.svg", "image/svg+xml", async () => toSvg(await label(), this.settings.clamped)),
      saves("JSON", "structure.json", "application/json", () => toJson(this.state)),
      button("Link", () => this.link()),
      button("Open a file …", () => file.click()),
      file,
    );
  }

  /** The page's address becomes a link to what it shows, and is copied where that is allowed. */
  private async link(): Promise<void> {
    try {
      history.replaceState(null, "", toFragment(this.state));
    } catch (error) {
      this.tell(error);
      return;
    }
    const copied = await navigator.clipboard?.writeText(location.href).then(
      () => true,
      () => false,
    );
    this.status.textContent = `The page's address is now a link to this structure${copied ? ", and it is copied" : ""}.`;
  }

  private async read(file: File): Promise<void> {
    try {
      if (file.size > 20e6) throw new Refusal("the file is larger than 20 MB");
      if (file.type === "application/json" || file.name.endsWith(".json")) this.restore(fromJson(await file.text()));
      else this.take(await fromPicture(file));
    } catch (error) {
      this.tell(error);
    }
  }

  /** A file may be dropped anywhere on the laboratory's page: the browser would leave the page for it. */
  private acceptFiles(): void {
    const place: EventTarget = this.small ? this.element : document;
    place.addEventListener("dragover", (event) => event.preventDefault());
    place.addEventListener("drop", (event) => {
      event.preventDefault();
      const file = (event as DragEvent).dataTransfer?.files[0];
      if (file) this.read(file);
    });
  }
}

/** A structure to start from; an empty text is an empty drawing. */
const start = (packed: string): Image => unpacked(packed) ?? new Float64Array(FRAME * FRAME);

const inWords = ({ height, width, area }: Descriptors) =>
  `${height.toFixed(3)} high and ${width.toFixed(3)} wide, with a hull area of ${area.toFixed(3)}`;

/** Descriptors as a list of names and numbers, and the medial axis as a small curve. */
function numbers(found: Descriptors, mu: number): HTMLElement[] {
  const rows: [string, string][] = [
    ["height h", found.height.toFixed(3)],
    ["width w", found.width.toFixed(3)],
    ["hull area A", found.area.toFixed(3)],
    ["peak stress σ/μ", (found.stress / mu).toFixed(2)],
    ["peak stretch", found.stretch.toFixed(3)],
  ];
  const sideways = found.axis.map(([x]) => x);
  const reach = Math.max(0.05, ...sideways.map(Math.abs));
  const path = found.axis.map(([x, y]) => `${x},${found.height - y}`).join(" ");
  const end = sideways[sideways.length - 1];
  const words = `Medial axis: it ends ${Math.abs(end).toFixed(3)} to the ${end < 0 ? "left" : "right"} of where it begins`;
  const axis = make(
    "svg",
    { viewBox: `${-reach - 0.05} -0.05 ${2 * reach + 0.1} ${found.height + 0.1}`, role: "img", class: "lab-axis" },
    make("title", {}, words),
    make("polyline", { points: path, fill: "none" }),
  );
  const supports = found.outline.map((value, k) => `${(360 * k) / found.outline.length}°: ${value.toFixed(3)}`);
  const outline = make(
    "details",
    { class: "lab-outline" },
    make("summary", {}, "Outline: how far the hull reaches from the ground below its middle"),
    make("p", {}, supports.join(", ")),
  );
  const terms = rows.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]);
  return [make("dl", {}, ...terms), make("figure", {}, axis, make("figcaption", {}, "medial axis")), outline];
}
