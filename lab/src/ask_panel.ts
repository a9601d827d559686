/** Ask: targets in any combination, structures drawn for them before the reader's eyes, ranked by what they miss. */

import type { Bench } from "./bench.ts";
import { axisHeight, type DescriptorName, describeNodes, largestMiss, type Targets } from "./descriptors.ts";
import { button, type Choice, choice, make, type Slider, slider } from "./dom.ts";
import { MU } from "./inflation.ts";
import { FRAME, type Image, VOID } from "./labels.ts";
import type { StoredModel } from "./model.ts";
import type { Try } from "./refine.ts";
import type { Remote } from "./remote.ts";
import { AXIS_POINTS, across, outlineCorners } from "./shape.ts";
import { type Simulation, sentence } from "./simulate.ts";
import { draw } from "./view.ts";
import { Refusal } from "./words.ts";

const NUMBERS: [DescriptorName, string, number, number][] = [
  // name, words, value at first, factor from what is shown to what is asked for
  ["height", "Height", 1.05, 1],
  ["width", "Width", 0.9, 1],
  ["area", "Hull area", 0.75, 1],
  ["stress", "Stress σ/μ", 1.2, MU],
  ["stretch", "Stretch", 1.35, 1],
];
const HEIGHTS = [0.25, 0.5, 0.75, 1]; // of the handles of an axis, in shares of its height
const TRIES = 60;

export class AskPanel {
  readonly element: HTMLElement;
  private readonly fields = new Map<DescriptorName, { wanted: HTMLInputElement; value: HTMLInputElement }>();
  private readonly axis = new AxisField();
  private readonly outline = new OutlineField();
  private readonly status: HTMLElement = make("p", { class: "lab-status", role: "status", "aria-live": "polite" });
  private readonly gallery: HTMLElement = make("div", { class: "lab-gallery" });
  private readonly go: HTMLButtonElement;
  private readonly refining: HTMLButtonElement;
  private readonly purpose: Choice;
  private readonly guidance: Slider;
  private readonly steps: Slider;
  private readonly number: Slider;
  private readonly seed: HTMLInputElement;

  constructor(
    private readonly bench: Bench,
    private readonly network: () => Promise<{ remote: Remote; model: StoredModel }>,
    private readonly solver: Remote,
  ) {
    const rows = NUMBERS.map(([name, words, start]) => {
      const wanted: HTMLInputElement = make("input", { type: "checkbox", checked: name === "height" });
      const value: HTMLInputElement = make("input", {
        type: "number",
        step: 0.01,
        min: 0,
        value: start,
        "aria-label": `${words}: value`,
      });
      value.addEventListener("input", () => {
        wanted.checked = true;
      });
      this.fields.set(name, { wanted, value });
      return make("div", { class: "lab-field" }, make("label", {}, wanted, ` ${words}`), value);
    });
    const none = () => {};
    const ways: [string, string][] = [
      ["quick", "quick"],
      ["varied", "varied"],
      ["", "as below"],
    ];
    this.purpose = choice("Sampling", ways, () => this.takeWay());
    const own = () => {
      this.purpose.value = "";
    };
    this.guidance = slider("Guidance", [1, 10, 0.5], 8, (v) => v.toFixed(1), own);
    this.steps = slider("Steps", [2, 25, 1], 5, String, own);
    this.number = slider("Structures", [1, 8, 1], 4, String, none);
    this.seed = make("input", { type: "number", min: 0, step: 1, value: 0 });
    this.go = button("Draw structures", () => (this.stopping ? this.stop() : this.ask()));
    this.refining = button("Refine the drawing", () => this.refine());
    this.outline.drawn = (points) => this.takeOutline(points);
    this.outline.copy = () => this.takeOutlineOfDrawing();
    this.element = make(
      "section",
      { class: "lab-ask", "aria-label": "Ask for a structure" },
      make("p", { class: "lab-title" }, "Ask for a structure"),
      make("div", { class: "lab-targets" }, make("div", {}, ...rows), this.axis.element, this.outline.element),
      make(
        "div",
        { class: "lab-options" },
        this.purpose.row,
        this.guidance.row,
        this.steps.row,
        this.number.row,
        make("label", {}, "Seed ", this.seed),
      ),
      make("div", { class: "lab-buttons" }, this.go, this.refining),
      this.status,
      this.gallery,
    );
  }

  private stopping = false;

  private targets(): Targets {
    const targets: Targets = {};
    for (const [name, , , factor] of NUMBERS) {
      const field = this.fields.get(name);
      if (field?.wanted.checked) targets[name] = Number(field.value.value) * factor;
    }
    if (this.axis.box.checked) targets.axis = this.axis.points();
    if (this.outline.box.checked && this.outline.supports) targets.outline = this.outline.supports;
    return targets;
  }

  /** The targets, which go with the structure from now on. */
  private asked(): Targets {
    this.bench.targets = this.targets();
    return this.bench.targets;
  }

  /** The sliders follow the way in which the model is asked. */
  private async takeWay(): Promise<void> {
    try {
      const way = (await this.network()).model.ways[this.purpose.value];
      if (!way) return;
      this.guidance.value = way.sampling.guidance;
      this.steps.value = way.sampling.steps;
    } catch (error) {
      this.tell(error);
    }
  }

  private async ask(): Promise<void> {
    this.busy(true);
    try {
      this.status.textContent = "The network is being loaded.";
      const { remote } = await this.network();
      const targets = this.asked();
      const n = this.number.value;
      const canvases = Array.from({ length: n }, () =>
        make("canvas", { width: FRAME, height: FRAME, role: "img", "aria-label": "A structure that is being drawn" }),
      );
      const figures = canvases.map((canvas, k) =>
        make("figure", {}, canvas, make("figcaption", {}, `structure ${k + 1}`)),
      );
      let state = 0;
      const watch = (states: Float64Array[]) => {
        if (state === 0) this.gallery.replaceChildren(...figures);
        states.forEach((image, k) => {
          paint(canvases[k], image);
        });
        this.status.textContent = `Noise turns into structures: step ${state} of ${own.steps}.`;
        state++;
      };
      const own = { steps: this.steps.value, guidance: this.guidance.value };
      const purpose = this.purpose.value;
      const options = { n, seed: Number(this.seed.value), ...(purpose ? { purpose } : own) };
      const images = await remote.call<Float64Array[]>("draw", [targets, options], watch);
      const judged = [];
      for (const [k, image] of images.entries()) {
        const found = await this.solver.call<Simulation | string>("simulate", [image, {}]);
        judged.push(this.judged(figures[k], image, found, targets));
      }
      judged.sort((a, b) => a.miss - b.miss);
      this.gallery.replaceChildren(...judged.map((one) => one.figure));
      const good = judged.filter((one) => Number.isFinite(one.miss));
      this.status.textContent = good.length
        ? `${good.length} of ${n} structures can be built; the best misses by ${percent(good[0].miss)}.`
        : `None of ${n} structures can be built: try another seed.`;
    } catch (error) {
      this.tell(error);
    }
    this.busy(false);
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
    canvas.setAttribute("aria-label", `An inflated structure: ${words}`);
    const cavity =
      typeof found === "string" ? image.map((v) => Number(v > 0.5)) : found.label.map((v) => Number(v === VOID));
    caption.replaceChildren(
      words,
      make("br"),
      button("Take it to the drawing", () => this.bench.take(cavity)),
    );
    return { figure, miss };
  }

  private async refine(): Promise<void> {
    this.busy(true);
    const { bench } = this;
    try {
      const targets = this.asked();
      let last: Try | null = null;
      const watch = (progress: Try) => {
        if (progress.flipped.length !== (last?.flipped.length ?? 0)) {
          bench.take(cavityOf(progress.label));
          bench.drawing.mark(progress.flipped);
        }
        last = progress;
        this.status.textContent = `Try ${progress.tried} of ${TRIES}: the largest miss is ${percent(progress.miss)}.`;
      };
      if (!bench.simulation) throw new Refusal("there is no structure to refine");
      const found = await this.solver.call<Try>(
        "refine",
        [bench.simulation.label, targets, bench.options, 0.002, TRIES],
        watch,
      );
      if (found.flipped.length) bench.take(cavityOf(found.label));
      bench.drawing.mark(found.flipped);
      const pixels = found.flipped.map((k) => `row ${Math.floor(k / FRAME) + 1}, column ${(k % FRAME) + 1}`).join("; ");
      const changed = pixels ? ` Pixels that were changed: ${pixels}.` : " No pixel was changed.";
      this.status.textContent = `After ${found.tried} tries the largest miss is ${percent(found.miss)}.${changed}`;
    } catch (error) {
      this.tell(error);
    }
    this.busy(false);
  }

  private stop(): void {
    this.network().then(({ remote }) => remote.stop());
    this.solver.stop();
  }

  private busy(busy: boolean): void {
    this.stopping = busy;
    this.go.textContent = busy ? "Stop" : "Draw structures";
    this.refining.disabled = busy;
  }

  private tell(error: unknown): void {
    if (!(error instanceof Refusal)) console.error(error);
    this.status.textContent = sentence((error as Error).message);
  }

  private takeOutlineOfDrawing(): void {
    const { simulation } = this.bench;
    if (!simulation?.descriptors) this.tell(new Refusal("there is no inflated structure whose outline could be taken"));
    else this.takeOutline(pairs(simulation.positions[simulation.reached]));
  }

  /** An outline says what height, width, area and axis are, so these are asked for no longer. */
  private takeOutline(points: number[][]): void {
    try {
      const { height, width, area, axis, outline } = describeNodes(Float64Array.from(points.flat()));
      for (const [name, value] of Object.entries({ height, width, area })) {
        const field = this.fields.get(name as DescriptorName);
        if (!field) continue;
        field.wanted.checked = false;
        field.value.value = value.toFixed(3);
      }
      this.axis.set(axis);
      this.axis.box.checked = false;
      this.outline.set(outline);
      this.status.textContent = `The outline is ${height.toFixed(3)} high and ${width.toFixed(3)} wide, its hull area is ${area.toFixed(3)}.`;
    } catch (error) {
      this.tell(error);
    }
  }
}

const pairs = (nodes: Float64Array) =>
  Array.from({ length: nodes.length / 2 }, (_, k) => [nodes[2 * k], nodes[2 * k + 1]]);
const percent = (share: number) => `${(100 * share).toFixed(1)} %`;
const cavityOf = (label: Image) => label.map((value) => Number(value === VOID));

function paint(canvas: HTMLCanvasElement, image: ArrayLike<number>): void {
  const picture = new ImageData(FRAME, FRAME);
  for (let k = 0; k < image.length; k++) picture.data.set([255 * image[k], 255 * image[k], 255 * image[k], 255], 4 * k);
  canvas.getContext("2d")?.putImageData(picture, 0, 0);
}

/** A medial axis as a curve through four points that are dragged, or moved by sliders. */
class AxisField {
  readonly element: HTMLElement;
  readonly box: HTMLInputElement = make("input", { type: "checkbox" });
  private readonly curve = make("polyline", { fill: "none" });
  private readonly handles;
  private readonly sliders: Slider[];
  private readonly height: Slider;

  constructor() {
    const moved = () => {
      this.box.checked = true;
      this.show();
    };
    this.height = slider("Axis: height", [0.5, 1.45, 0.01], 1.05, (v) => v.toFixed(2), moved);
    const words = ["at a quarter", "at half", "at three quarters", "at the top"];
    this.sliders = words.map((text) => slider(`sideways ${text}`, [-0.5, 0.5, 0.01], 0, (v) => v.toFixed(2), moved));
    this.handles = HEIGHTS.map(() => make("circle", { r: 0.04 }));
    const pad = make(
      "svg",
      { viewBox: PAD, class: "lab-pad", "aria-hidden": "true" },
      make("line", GROUND),
      this.curve,
      ...this.handles,
    );
    let held = -1;
    const place = (event: PointerEvent) => placeOn(pad, event);
    pad.addEventListener("pointerdown", (event: PointerEvent) => {
      pad.setPointerCapture(event.pointerId);
      const [, y] = place(event);
      const apart = HEIGHTS.map((share) => Math.abs(share * this.height.value - y));
      held = apart.indexOf(Math.min(...apart));
    });
    pad.addEventListener("pointermove", (event: PointerEvent) => {
      if (held < 0) return;
      const [x, y] = place(event);
      this.sliders[held].value = x;
      if (held === HEIGHTS.length - 1) this.height.value = y;
      moved();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      pad.addEventListener(end, () => {
        held = -1;
      });
    }
    const numbers = make(
      "details",
      {},
      make("summary", {}, "by sliders"),
      this.height.row,
      ...this.sliders.map((one) => one.row),
    );
    this.element = make("div", {}, make("label", {}, this.box, " Medial axis (drag)"), pad, numbers);
    this.show();
  }

  /** (30, 2) points of the axis: a curve through the handles, at equal increments of height. */
  points(): number[][] {
    const corners = [[0, 0], ...HEIGHTS.map((share, k) => [this.sliders[k].value, share])];
    const height = this.height.value;
    return Array.from({ length: AXIS_POINTS }, (_, k) => [
      smooth(corners, k / AXIS_POINTS),
      (height * k) / AXIS_POINTS,
    ]);
  }

  /** Follow a measured axis. */
  set(axis: number[][]): void {
    const height = axisHeight(axis);
    this.height.value = height;
    HEIGHTS.forEach((share, k) => {
      this.sliders[k].value = across(axis, Math.min(share * height, axis[AXIS_POINTS - 1][1]));
    });
    this.show();
  }

  private show(): void {
    const height = this.height.value;
    this.curve.setAttribute(
      "points",
      this.points()
        .map(([x, y]) => `${x},${-y}`)
        .join(" "),
    );
    this.handles.forEach((handle, k) => {
      handle.setAttribute("cx", this.sliders[k].value);
      handle.setAttribute("cy", -HEIGHTS[k] * height);
    });
  }
}

const PAD = "-0.75 -1.55 1.5 1.65";
const GROUND = { x1: -0.75, x2: 0.75, y1: 0, y2: 0, class: "lab-ground" };

/** Where on a pad the pointer is: x from its middle, y above the ground. */
function placeOn(pad: SVGGraphicsElement, event: PointerEvent): number[] {
  const { a, d, e, f } = pad.getScreenCTM() as DOMMatrix;
  return [(event.clientX - e) / a, (f - event.clientY) / d];
}

/** x of the polynomial through points (x, y), at y (Lagrange). */
function smooth(points: number[][], y: number): number {
  return points.reduce((sum, [x, at], i) => {
    const others = points.filter((_, j) => j !== i);
    return sum + others.reduce((product, [, other]) => (product * (y - other)) / (at - other), x);
  }, 0);
}

/** The inflated shape, drawn by hand as one closed line; its convex hull, standing on the ground, is asked for. */
class OutlineField {
  readonly element: HTMLElement;
  readonly box: HTMLInputElement = make("input", { type: "checkbox", disabled: true });
  supports: number[] | null = null;
  drawn: (points: number[][]) => void = () => {};
  copy: () => void = () => {};
  private readonly line = make("polyline", {});

  constructor() {
    const pad = make("svg", { viewBox: PAD, class: "lab-pad", "aria-hidden": "true" }, make("line", GROUND), this.line);
    let points: number[][] | null = null;
    pad.addEventListener("pointerdown", (event: PointerEvent) => {
      pad.setPointerCapture(event.pointerId);
      points = [placeOn(pad, event)];
    });
    pad.addEventListener("pointermove", (event: PointerEvent) => {
      if (!points) return;
      points.push(placeOn(pad, event));
      this.show(points);
    });
    pad.addEventListener("pointerup", () => {
      const line = points;
      points = null;
      if (line) this.drawn(line);
    });
    pad.addEventListener("pointercancel", () => {
      points = null;
    });
    const copy = button("Take that of the drawing", () => this.copy());
    this.element = make("div", {}, make("label", {}, this.box, " Outline (draw it)"), pad, copy);
  }

  set(supports: number[]): void {
    this.supports = supports;
    this.box.disabled = false;
    this.box.checked = true;
    const corners = outlineCorners(supports);
    this.show([...corners, corners[0]]);
  }

  private show(points: number[][]): void {
    this.line.setAttribute("points", points.map(([x, y]) => `${x},${-y}`).join(" "));
  }
}
