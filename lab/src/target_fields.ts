/** What is asked for, on the page: numbers, an axis that is dragged, an outline that is drawn; all of them by keyboard, too. */

import { axisHeight, type DescriptorName, describeNodes, type Targets } from "./descriptors.ts";
import { button, make, type Slider, slider } from "./dom.ts";
import { MU } from "./inflation.ts";
import { AXIS_POINTS, outlineCorners, outlineHeight, outlineWidth } from "./shape.ts";
import { axisOf, checkTargets, rounded } from "./targets.ts";
import { Refusal } from "./words.ts";

const NUMBERS: [name: DescriptorName, words: string, first: number, factor: number][] = [
  ["height", "Height", 1.05, 1],
  ["width", "Width", 0.9, 1],
  ["area", "Hull area", 0.75, 1],
  ["stress", "Stress σ/μ", 1.2, MU], // shown in units of μ
  ["stretch", "Stretch", 1.35, 1],
];
const HANDLES = [0.25, 0.5, 0.75, 1]; // of an axis, in shares of its height
const HEIGHTS: [number, number, number] = [0.5, 1.45, 0.01];
const WIDTHS: [number, number, number] = [0.4, 1.35, 0.01];

export class TargetFields {
  readonly element: HTMLElement;
  private readonly numbers = new Map<DescriptorName, { wanted: HTMLInputElement; value: HTMLInputElement }>();
  private readonly axis = new AxisField();
  private readonly outline: OutlineField;
  private touched = false; // else nothing has been asked for: the first height is only proposed

  /** `nodes` are those of the inflated structure on the page, `tell` says a sentence or an error. */
  constructor(
    nodes: () => Float64Array,
    private readonly tell: (words: unknown) => void,
  ) {
    const rows = NUMBERS.map(([name, words]) => {
      const wanted: HTMLInputElement = make("input", { type: "checkbox" });
      const value: HTMLInputElement = make("input", {
        type: "number",
        step: 0.01,
        min: 0,
        "aria-label": `${words}: value`,
      });
      value.addEventListener("input", () => {
        wanted.checked = true;
      });
      this.numbers.set(name, { wanted, value });
      return make("div", { class: "lab-field" }, make("label", {}, wanted, ` ${words}`), value);
    });
    this.outline = new OutlineField(
      (points) =>
        this.takeOutline(() => {
          if (points.length < 3) throw new Refusal("the line encloses nothing: draw around an area");
          return Float64Array.from(points.flat());
        }),
      () => this.takeOutline(nodes),
    );
    this.element = make(
      "div",
      { class: "lab-targets" },
      make("div", {}, ...rows),
      this.axis.element,
      this.outline.element,
    );
    for (const event of ["input", "click", "pointerup"]) {
      this.element.addEventListener(event, () => {
        this.touched = true;
      });
    }
    this.set({});
  }

  /** What is asked for now, to four digits. Throws a Refusal where something is no target, or nothing is asked for. */
  get(): Targets {
    return checkTargets(this.ticked());
  }

  private ticked(): Targets {
    const targets: Targets = {};
    for (const [name, , , factor] of NUMBERS) {
      const field = this.numbers.get(name);
      if (field?.wanted.checked) targets[name] = rounded(Number(field.value.value) * factor);
    }
    if (this.axis.box.checked) targets.axis = this.axis.points();
    if (this.outline.box.checked && this.outline.supports) targets.outline = this.outline.supports;
    return targets;
  }

  /** What goes with the structure into a file: nothing, until something has been asked for. */
  stored(): Targets {
    return this.touched && Object.keys(this.ticked()).length ? this.get() : {};
  }

  set(targets: Targets): void {
    this.touched = Object.keys(targets).length > 0;
    for (const [name, , first, factor] of NUMBERS) {
      const field = this.numbers.get(name);
      if (!field) continue;
      field.wanted.checked = name in targets;
      field.value.value = String(rounded(((targets[name] as number) ?? first * factor) / factor));
    }
    this.axis.box.checked = "axis" in targets;
    if (targets.axis) this.axis.set(targets.axis as number[][]);
    this.outline.box.checked = "outline" in targets;
    if (targets.outline) this.outline.set(targets.outline as number[]);
    const height = this.numbers.get("height");
    if (height && !this.touched) height.wanted.checked = true;
  }

  /** An outline says what height, width, area and axis are, so these are asked for no longer. */
  private takeOutline(nodes: () => Float64Array): void {
    try {
      const { height, width, area, axis, outline } = describeNodes(nodes());
      for (const [name, value] of Object.entries({ height, width, area })) {
        const field = this.numbers.get(name as DescriptorName);
        if (!field) continue;
        field.wanted.checked = false;
        field.value.value = value.toFixed(3);
      }
      this.axis.set(axis);
      this.axis.box.checked = false;
      this.outline.set(outline);
      this.outline.box.checked = true;
      this.tell(
        `The outline is ${height.toFixed(3)} high and ${width.toFixed(3)} wide, its hull area is ${area.toFixed(3)}.`,
      );
    } catch (error) {
      this.tell(error);
    }
  }
}

/** A field to drag or draw in: what lies on it stands on the ground. `moved` hears of a pointer that is held down. */
function pad(moved: (place: number[], first: boolean) => void, done: () => void, ...children: Node[]): HTMLElement {
  const ground = make("line", { x1: -0.75, x2: 0.75, y1: 0, y2: 0, class: "lab-ground" });
  const attributes = { viewBox: "-0.75 -1.55 1.5 1.65", class: "lab-pad", "aria-hidden": "true" };
  const field = make("svg", attributes, ground, ...children);
  const place = (event: PointerEvent) => {
    const { a, d, e, f } = field.getScreenCTM() as DOMMatrix;
    return [(event.clientX - e) / a, (f - event.clientY) / d]; // x from the middle, y above the ground
  };
  field.addEventListener("pointerdown", (event: PointerEvent) => {
    if (event.button) return;
    field.setPointerCapture(event.pointerId);
    moved(place(event), true);
  });
  field.addEventListener("pointermove", (event: PointerEvent) => {
    if (field.hasPointerCapture(event.pointerId)) moved(place(event), false);
  });
  field.addEventListener("pointerup", (event: PointerEvent) => {
    if (field.hasPointerCapture(event.pointerId)) done();
  });
  return field;
}

const bySliders = (...sliders: Slider[]) =>
  make("details", {}, make("summary", {}, "by sliders"), ...sliders.map((one) => one.row));

/** A medial axis as a curve through four points that are dragged, or moved by sliders. */
class AxisField {
  readonly element: HTMLElement;
  readonly box: HTMLInputElement = make("input", { type: "checkbox" });
  private readonly curve = make("polyline", { fill: "none" });
  private readonly handles = HANDLES.map(() => make("circle", { r: 0.04 }));
  private readonly sideways: Slider[];
  private readonly height: Slider;

  constructor() {
    const moved = () => {
      this.box.checked = true;
      this.show();
    };
    this.height = slider("Height", HEIGHTS, 1.05, (v) => v.toFixed(2), moved);
    this.sideways = HANDLES.map((share) =>
      slider(`at ${100 * share}\u00a0%`, [-0.5, 0.5, 0.01], 0, (v) => v.toFixed(2), moved),
    );
    let held = 0;
    const drag = ([x, y]: number[], first: boolean) => {
      const apart = HANDLES.map((share) => Math.abs(share * this.height.value - y));
      if (first) held = apart.indexOf(Math.min(...apart));
      this.sideways[held].value = x;
      if (held === HANDLES.length - 1) this.height.value = y;
      moved();
    };
    this.element = make(
      "div",
      { role: "group", "aria-label": "Medial axis" },
      make("label", {}, this.box, " Medial axis (drag)"),
      pad(drag, () => {}, this.curve, ...this.handles),
      bySliders(this.height, ...this.sideways),
    );
    this.show();
  }

  /** (30, 2) points of the axis: the curve through the handles, at equal increments of height. */
  points(): number[][] {
    const handles = [[0, 0], ...HANDLES.map((share, k) => [this.sideways[k].value, share])];
    const sideways = Array.from({ length: AXIS_POINTS }, (_, k) => rounded(smooth(handles, k / AXIS_POINTS)));
    return axisOf(this.height.value, sideways);
  }

  /** The curve through five points of an axis: the axis itself, where it comes from here. */
  set(axis: number[][]): void {
    const height = axisHeight(axis);
    this.height.value = height;
    const through = [0, 7, 15, 22, 29].map((k) => [axis[k][0], axis[k][1] / height]);
    HANDLES.forEach((share, k) => {
      this.sideways[k].value = smooth(through, share);
    });
    this.show();
  }

  private show(): void {
    this.curve.setAttribute("points", line(this.points()));
    this.handles.forEach((handle, k) => {
      handle.setAttribute("cx", this.sideways[k].value);
      handle.setAttribute("cy", -HANDLES[k] * this.height.value);
    });
  }
}

/** The inflated shape, drawn as one closed line or made by sliders; its convex hull, standing on the ground, is asked for. */
class OutlineField {
  readonly element: HTMLElement;
  readonly box: HTMLInputElement = make("input", { type: "checkbox", disabled: true });
  supports: number[] | null = null;
  private readonly line = make("polyline", {});
  private readonly height: Slider;
  private readonly width: Slider;

  constructor(drawn: (points: number[][]) => void, copy: () => void) {
    let points: number[][] = [];
    const draw = (place: number[], first: boolean) => {
      points = first ? [place] : [...points, place];
      this.show(points);
    };
    const slid = () => drawn(roundedBox(this.width.value, this.height.value, corners.value));
    this.height = slider("Height", HEIGHTS, 1.05, (v) => v.toFixed(2), slid);
    this.width = slider("Width", WIDTHS, 0.9, (v) => v.toFixed(2), slid);
    const corners = slider("Corners", [2, 8, 0.5], 2, (v) => (v === 2 ? "none" : v.toFixed(1)), slid);
    this.element = make(
      "div",
      { role: "group", "aria-label": "Outline" },
      make("label", {}, this.box, " Outline (draw)"),
      pad(draw, () => drawn(points), this.line),
      bySliders(this.height, this.width, corners),
      button("From the drawing", copy),
    );
  }

  set(supports: number[]): void {
    this.supports = supports.map(rounded);
    this.box.disabled = false;
    this.height.value = outlineHeight(supports);
    this.width.value = outlineWidth(supports);
    const corners = outlineCorners(supports);
    this.show([...corners, corners[0]]);
  }

  private show(points: number[][]): void {
    this.line.setAttribute("points", line(points));
  }
}

const line = (points: number[][]) => points.map(([x, y]) => `${x},${-y}`).join(" ");

/** x of the polynomial through points (x, y), at y (Lagrange). */
function smooth(points: number[][], y: number): number {
  return points.reduce((sum, [x, at], i) => {
    const others = points.filter((_, j) => j !== i);
    return sum + others.reduce((product, [, other]) => (product * (y - other)) / (at - other), x);
  }, 0);
}

/** Points of |2x / width|ᵖ + |2y / height − 1|ᵖ = 1: an ellipse for p = 2, nearly a rectangle for a large p. */
function roundedBox(width: number, height: number, p: number): number[][] {
  return Array.from({ length: 96 }, (_, k) => {
    const [c, s] = [Math.cos((Math.PI * k) / 48), Math.sin((Math.PI * k) / 48)];
    const power = (value: number) => Math.sign(value) * Math.abs(value) ** (2 / p);
    return [(width / 2) * power(c), (height / 2) * (1 + power(s))];
  });
}
