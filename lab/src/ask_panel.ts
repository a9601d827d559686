/** Ask: targets in any combination, structures drawn for them before the reader's eyes, ranked by what they miss. */

import type { Bench } from "./bench.ts";
import { largestMiss, type Targets } from "./descriptors.ts";
import { button, type Choice, choice, make, quiet, type Slider, slider } from "./dom.ts";
import { MU } from "./inflation.ts";
import { FRAME, type Image, VOID } from "./labels.ts";
import type { StoredModel } from "./model.ts";
import type { Try } from "./refine.ts";
import type { Remote } from "./remote.ts";
import { DEFAULTS, type Settings } from "./share.ts";
import { type Simulation, sentence } from "./simulate.ts";
import { TargetFields } from "./target_fields.ts";
import { draw } from "./view.ts";
import { general, Refusal } from "./words.ts";

const TRIES = 60;
const OTHER_SETTINGS =
  " They are inflated with the settings above; the network has learned with the paper's values, and may miss by more here.";
const FILM = 1500; // milliseconds at least that noise takes to turn into structures, so that it can be watched

export class AskPanel {
  readonly element: HTMLElement;
  private readonly fields: TargetFields;
  private readonly status: HTMLElement = make("p", { class: "lab-status", role: "status", "aria-live": "polite" });
  private readonly gallery: HTMLElement = make("div", { class: "lab-gallery" });
  private readonly go: HTMLButtonElement;
  private readonly refining: HTMLButtonElement;
  private readonly purpose: Choice;
  private readonly guidance: Slider;
  private readonly steps: Slider;
  private readonly number: Slider;
  private readonly seed: HTMLInputElement;
  private computing = false;
  private stopped = false;

  constructor(
    private readonly bench: Bench,
    private readonly network: () => Promise<{ remote: Remote; model: StoredModel }>,
    private readonly solver: Remote,
  ) {
    const nodes = () => {
      const { simulation } = bench;
      if (!simulation?.descriptors) throw new Refusal("there is no inflated structure whose outline could be used");
      return simulation.positions[simulation.reached];
    };
    this.fields = new TargetFields(nodes, (words) => this.tell(words));
    bench.asked = { get: () => this.fields.stored(), set: (targets) => this.fields.set(targets) };
    const ways: [string, string][] = [
      ["quick", "quick"],
      ["varied", "varied"],
      ["", "custom"],
    ];
    this.purpose = choice("Sampling", ways, () => this.followWay().catch((error) => this.tell(error)));
    const own = () => {
      this.purpose.value = "";
    };
    this.guidance = slider("Guidance", [1, 10, 0.5], 8, (v) => v.toFixed(1), own);
    this.steps = slider("Steps", [2, 25, 1], 5, String, own);
    this.number = slider("Structures", [1, 8, 1], 4, String, () => {});
    this.seed = make("input", { type: "number", min: 0, step: 1, value: 0 });
    this.go = button("Draw structures", () => (this.computing ? this.stop() : this.compute(() => this.ask())), {
      class: "lab-first",
    });
    this.refining = button("Refine the drawing", () => this.compute(() => this.refine()));
    this.element = make(
      "section",
      { class: "lab-ask", "aria-label": "Ask for a structure" },
      make("p", { class: "lab-title" }, "Ask for a structure"),
      this.fields.element,
      make(
        "div",
        { class: "lab-options" },
        this.purpose.row,
        make("div", { class: "lab-choice" }, make("label", {}, make("span", {}, "Seed"), this.seed)),
        this.guidance.row,
        this.steps.row,
        this.number.row,
      ),
      make("div", { class: "lab-buttons" }, this.go, this.refining),
      this.status,
      this.gallery,
    );
    // What the sliders say is the model's, which is loaded when the panel comes into view.
    const sight = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      sight.disconnect();
      this.followWay().catch((error) => this.tell(error));
    });
    sight.observe(this.element);
  }

  /** The sliders follow the way in which the model is asked. */
  private async followWay(): Promise<void> {
    const { model } = await this.network();
    this.guidance.input.max = String(model.config.strongest);
    const way = model.ways[this.purpose.value];
    if (!way) return;
    this.guidance.value = way.sampling.guidance;
    this.steps.value = way.sampling.steps;
  }

  /** One thing at a time; what goes wrong is said. */
  private async compute(task: () => Promise<void>): Promise<void> {
    this.stopped = false;
    this.busy(true);
    try {
      await task();
    } catch (error) {
      this.tell(error);
    }
    this.busy(false);
  }

  private async ask(): Promise<void> {
    const targets = this.fields.get();
    this.status.textContent = "The network is being loaded.";
    await this.followWay();
    const { remote } = await this.network();
    this.goOn();
    const n = this.number.value;
    const own = { steps: this.steps.value, guidance: this.guidance.value };
    const figures = Array.from({ length: n }, (_, k) => {
      const canvas = make("canvas", { width: FRAME, height: FRAME, role: "img", "aria-label": "being drawn" });
      return make("figure", {}, canvas, make("figcaption", {}, `structure ${k + 1}`));
    });
    let film = Promise.resolve();
    let state = 0;
    const show = async (states: Float64Array[]) => {
      if (this.stopped) return;
      if (state === 0) this.gallery.replaceChildren(...figures);
      if (!quiet() || state === 0 || state === own.steps) {
        for (const [k, image] of states.entries()) paint(figures[k].firstChild, image);
      }
      this.status.textContent = `Noise turns into structures: step ${state} of ${own.steps}.`;
      state++;
      if (!quiet() && !document.hidden) await new Promise((next) => setTimeout(next, FILM / (own.steps + 1)));
    };
    const watch = (states: Float64Array[]) => {
      film = film.then(() => show(states));
    };
    const purpose = this.purpose.value;
    const options = { n, seed: Number(this.seed.value), ...(purpose ? { purpose } : own) };
    const images = await remote.call<Float64Array[]>("draw", [targets, options], watch);
    await film;
    const judged = [];
    for (const [k, image] of images.entries()) {
      this.goOn();
      const found = await this.solver.call<Simulation | string>("simulate", [image, this.bench.options]);
      judged.push(this.judged(figures[k], image, found, targets));
    }
    judged.sort((a, b) => a.miss - b.miss);
    this.gallery.replaceChildren(...judged.map((one) => one.figure));
    const good = judged.filter((one) => Number.isFinite(one.miss));
    const verdict = good.length
      ? `${good.length} of ${n} structures can be built; the best misses by ${percent(good[0].miss)}.`
      : `None of ${n} structures can be built: try another seed.`;
    const { settings } = this.bench;
    const usual = (Object.keys(DEFAULTS) as (keyof Settings)[]).every((name) => settings[name] === DEFAULTS[name]);
    this.status.textContent = `${verdict}${usual ? "" : OTHER_SETTINGS}`;
  }

  /** A figure with what a structure inflates to and what it misses; broken ones miss by infinity. */
  private judged(figure: HTMLElement, image: Image, found: Simulation | string, targets: Targets) {
    const caption = figure.querySelector("figcaption") as HTMLElement;
    const canvas = make("canvas", { width: 260, height: 260, role: "img" });
    let miss = Number.POSITIVE_INFINITY;
    let words = "";
    if (typeof found === "string") words = found;
    else {
      draw(canvas, found, found.reached, "vonMises");
      figure.replaceChild(canvas, figure.firstChild as Node);
      if (found.flaw || !found.descriptors) words = found.flaw;
      else {
        miss = largestMiss(targets, found.descriptors);
        words = `misses by ${percent(miss)}`;
      }
    }
    figure.querySelector("canvas")?.setAttribute("aria-label", `A structure that was drawn: ${words}`);
    const cavity =
      typeof found === "string" ? image.map((v) => Number(v > 0.5)) : found.label.map((v) => Number(v === VOID));
    caption.replaceChildren(
      words,
      make("br"),
      button("Edit this one", () => this.bench.take(cavity), { "aria-label": `Edit this one: ${words}` }),
    );
    return { figure, miss };
  }

  private async refine(): Promise<void> {
    const { bench } = this;
    const targets = this.fields.get();
    const { image } = bench.drawing; // what is drawn now may not have been inflated yet
    let known = image.slice();
    let last: Try | null = null;
    const watch = (progress: Try) => {
      if (known.some((value, k) => value !== image[k])) return this.stop(); // the reader draws on
      if (progress.flipped.length !== (last?.flipped.length ?? 0)) {
        bench.take(cavityOf(progress.label));
        bench.drawing.mark(progress.flipped);
        known = image.slice();
      }
      last = progress;
      this.status.textContent = `Try ${progress.tried} of ${TRIES}: the largest miss is ${percent(progress.miss)}.`;
    };
    const found = await this.solver.call<Try>("refine", [image, targets, bench.options, 0.002, TRIES], watch);
    bench.drawing.mark(found.flipped);
    const pixels = found.flipped.map((k) => `row ${Math.floor(k / FRAME) + 1}, column ${(k % FRAME) + 1}`).join("; ");
    const changed = pixels ? ` Pixels that were changed: ${pixels}.` : " No pixel was changed.";
    const tries = `${found.tried} ${found.tried === 1 ? "try" : "tries"}`;
    this.status.textContent = `After ${tries} the largest miss is ${percent(found.miss)}.${changed}`;
  }

  private goOn(): void {
    if (this.stopped) throw new Refusal("stopped");
  }

  private stop(): void {
    this.stopped = true;
    this.network().then(({ remote }) => remote.stop());
    this.solver.stop();
    this.bench.simulate(); // what is drawn now was waiting for the solver, too
  }

  private busy(busy: boolean): void {
    this.computing = busy;
    this.go.textContent = busy ? "Stop" : "Draw structures";
    this.refining.disabled = busy;
  }

  private tell(words: unknown): void {
    if (words instanceof Error && !(words instanceof Refusal)) console.error(words);
    this.status.textContent = words instanceof Error ? sentence(inMu(words.message)) : String(words);
  }
}

/** A refusal with its stresses in units of μ, in which the page asks for them and shows them. */
const inMu = (text: string) =>
  text.replace(/\bstress (\d[\d.e+-]*\b)(?: to (\d[\d.e+-]*\b))?/g, (_, ...[from, to]) => {
    const ends = [from, to].filter(Boolean).map((value) => general(Number(value) / MU, 3));
    return `stress σ/μ ${ends.join(" to ")}`;
  });

const percent = (share: number) => `${(100 * share).toFixed(1)} %`;
const cavityOf = (label: Image) => label.map((value) => Number(value === VOID));

function paint(canvas: HTMLCanvasElement, image: ArrayLike<number>): void {
  const picture = new ImageData(FRAME, FRAME);
  for (let k = 0; k < image.length; k++) picture.data.set([255 * image[k], 255 * image[k], 255 * image[k], 255], 4 * k);
  canvas.getContext("2d")?.putImageData(picture, 0, 0);
}
