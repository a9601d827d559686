/** The canvas that is drawn on: 28 × 28 pixels, by mouse, finger or keyboard, with undo. */

import { button, make } from "./dom.ts";
import { FRAME, type Image } from "./labels.ts";

const SCALE = 12; // canvas pixels per pixel
const TOOLS = { pen: "Pen", eraser: "Eraser", fill: "Fill" } as const;
type Tool = keyof typeof TOOLS;

export class Drawing {
  readonly element: HTMLElement;
  image: Image = new Float64Array(FRAME * FRAME);
  private readonly canvas: HTMLCanvasElement;
  private readonly said: HTMLElement;
  private tool: Tool = "pen";
  private cursor: [number, number] = [14, 14];
  private focused = false;
  private last: [number, number] | null = null;
  private history: Image[] = [];
  private marked: number[] = [];

  /** `changed` is called after every stroke, and while one is drawn. */
  constructor(private readonly changed: () => void) {
    const size = FRAME * SCALE;
    this.canvas = make("canvas", { width: size, height: size, class: "lab-drawing", tabindex: 0, role: "application" });
    this.said = make("p", { class: "lab-hidden", role: "status", "aria-live": "polite" });
    const name = `lab-tool-${Math.random().toString(36).slice(2)}`;
    const tools = Object.entries(TOOLS).map(([tool, words]) => {
      const radio: HTMLInputElement = make("input", { type: "radio", name, value: tool, checked: tool === "pen" });
      radio.addEventListener("change", () => {
        this.tool = tool as Tool;
      });
      return make("label", {}, radio, words);
    });
    const shift = (text: string, words: string, rows: number, columns: number) =>
      button(text, () => this.edit(() => this.shift(rows, columns)), { "aria-label": words, title: words });
    this.element = make(
      "div",
      { class: "lab-draw" },
      this.canvas,
      this.said,
      make("fieldset", { class: "lab-tools" }, make("legend", {}, "Tool"), ...tools),
      make(
        "div",
        { class: "lab-buttons" },
        button("Undo", () => this.undo()),
        button("Clear", () => this.set(new Float64Array(FRAME * FRAME))),
        button("Mirror", () => this.edit(() => this.mirror())),
        make(
          "span",
          { class: "lab-shifts" },
          shift("←", "Shift left", 0, -1),
          shift("→", "Shift right", 0, 1),
          shift("↑", "Shift up", -1, 0),
          shift("↓", "Shift down", 1, 0),
        ),
      ),
    );
    this.listen();
    this.show();
  }

  /** Replace the whole drawing, as one stroke. */
  set(image: Image): void {
    this.edit(() => this.image.set(image));
  }

  /** Frame pixels that were changed for the reader, until the next stroke. */
  mark(pixels: number[]): void {
    this.marked = pixels;
    this.show();
  }

  private edit(change: () => void): void {
    this.marked = [];
    this.history.push(this.image.slice());
    this.history.splice(0, this.history.length - 100);
    change();
    this.update();
  }

  private undo(): void {
    const before = this.history.pop();
    if (!before) return;
    this.image.set(before);
    this.update();
  }

  private update(): void {
    this.show();
    this.changed();
  }

  private mirror(): void {
    this.image.set(this.image.map((_, k) => this.image[k - (k % FRAME) + FRAME - 1 - (k % FRAME)]));
  }

  private shift(rows: number, columns: number): void {
    const before = this.image.slice();
    this.image.forEach((_, k) => {
      const [row, column] = [Math.floor(k / FRAME) - rows, (k % FRAME) - columns];
      const inside = row >= 0 && column >= 0 && row < FRAME && column < FRAME;
      this.image[k] = inside ? before[row * FRAME + column] : 0;
    });
  }

  /** Paint a pixel, or fill the area of equal pixels around it. */
  private paint([row, column]: [number, number]): void {
    const at = row * FRAME + column;
    if (this.tool !== "fill") {
      // The pen is two pixels wide, as the strokes of digits are; the eraser takes one.
      const wide = this.tool === "pen" ? [0, 1] : [0];
      for (const i of wide) {
        for (const j of wide) {
          if (row + i < FRAME && column + j < FRAME) this.image[at + i * FRAME + j] = this.tool === "pen" ? 1 : 0;
        }
      }
      return;
    }
    const before = this.image[at];
    const stack = [at];
    for (let k = stack.pop(); k !== undefined; k = stack.pop()) {
      if (this.image[k] !== before) continue;
      this.image[k] = 1 - before;
      if (k % FRAME > 0) stack.push(k - 1);
      if (k % FRAME < FRAME - 1) stack.push(k + 1);
      if (k >= FRAME) stack.push(k - FRAME);
      if (k < FRAME * (FRAME - 1)) stack.push(k + FRAME);
    }
  }

  private listen(): void {
    const { canvas } = this;
    const place = (event: PointerEvent): [number, number] => {
      const box = canvas.getBoundingClientRect();
      const pixel = (offset: number, length: number) =>
        Math.min(Math.max(Math.floor((offset / length) * FRAME), 0), FRAME - 1);
      return [pixel(event.clientY - box.top, box.height), pixel(event.clientX - box.left, box.width)];
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      canvas.setPointerCapture(event.pointerId);
      this.last = this.cursor = place(event);
      this.edit(() => this.paint(this.cursor));
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!this.last || this.tool === "fill") return;
      const [from, to] = [this.last, place(event)];
      const length = Math.max(Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1]));
      if (!length) return;
      for (let step = 1; step <= length; step++) {
        const on = (k: 0 | 1) => Math.round(from[k] + ((to[k] - from[k]) * step) / length);
        this.paint([on(0), on(1)]);
      }
      this.last = this.cursor = to;
      this.update();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, () => {
        this.last = null;
      });
    }
    const moves: Record<string, [number, number]> = {
      ArrowUp: [-1, 0],
      ArrowDown: [1, 0],
      ArrowLeft: [0, -1],
      ArrowRight: [0, 1],
    };
    canvas.addEventListener("keydown", (event) => {
      const move = moves[event.key];
      if (move) {
        this.cursor = [0, 1].map((k) => Math.min(Math.max(this.cursor[k] + move[k], 0), FRAME - 1)) as [number, number];
        if (event.shiftKey) this.edit(() => this.paint(this.cursor));
      } else if (event.key === " " || event.key === "Enter") {
        this.edit(() => this.paint(this.cursor));
      } else if (event.key === "z" && (event.ctrlKey || event.metaKey)) {
        this.undo();
      } else {
        return;
      }
      event.preventDefault();
      this.focused = true; // also where a click has brought the focus here
      const [row, column] = this.cursor;
      const here = this.image[row * FRAME + column] ? "drawn" : "empty";
      this.said.textContent = `Row ${row + 1}, column ${column + 1}: ${here}`;
      this.show();
    });
    for (const name of ["focus", "blur"]) {
      canvas.addEventListener(name, () => {
        this.focused = name === "focus" && canvas.matches(":focus-visible");
        this.show();
      });
    }
  }

  private show(): void {
    const context = this.canvas.getContext("2d");
    if (!context) return;
    const size = FRAME * SCALE;
    context.fillStyle = "#fff";
    context.fillRect(0, 0, size, size);
    context.fillStyle = "#0072b2";
    this.image.forEach((value, k) => {
      if (value) context.fillRect((k % FRAME) * SCALE, Math.floor(k / FRAME) * SCALE, SCALE, SCALE);
    });
    context.strokeStyle = "rgba(0, 0, 0, 0.12)";
    context.beginPath();
    for (let line = 0; line <= size; line += SCALE) {
      context.moveTo(line, 0);
      context.lineTo(line, size);
      context.moveTo(0, line);
      context.lineTo(size, line);
    }
    context.stroke();
    context.strokeStyle = "#e69f00";
    context.lineWidth = 2;
    for (const k of this.marked) context.strokeRect((k % FRAME) * SCALE, Math.floor(k / FRAME) * SCALE, SCALE, SCALE);
    context.lineWidth = 1;
    if (this.focused) {
      context.strokeStyle = "#d55e00";
      context.lineWidth = 3;
      context.strokeRect(this.cursor[1] * SCALE, this.cursor[0] * SCALE, SCALE, SCALE);
      context.lineWidth = 1;
    }
    const drawn = this.image.filter(Boolean).length;
    this.canvas.setAttribute(
      "aria-label",
      `Drawing of 28 by 28 pixels, ${drawn} drawn. Arrow keys move, space paints, shift and arrows draw a line.`,
    );
  }
}
