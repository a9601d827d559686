/** What a reader takes along: the structure in a link, in a file, as an outline in millimetres. */

import type { Targets } from "./descriptors.ts";
import { ELEMENTS, type Element } from "./equilibrium.ts";
import { LAMBDA, MU, PRESSURE } from "./inflation.ts";
import { EDGES, type Edge, FRAME, type Image, THICKNESS, WALL } from "./labels.ts";
import { boundaryLoops, buildMesh } from "./mesh.ts";
import { Refusal } from "./words.ts";

export const FORMAT = "inflate-lab 1";
const KEY = "lab"; // of the fragment
const SIZE_MM = 100; // side of the frame

export interface Settings {
  pressure: number;
  lambda: number;
  mu: number;
  wall: number;
  clamped: Edge;
  element: Element;
}

export const DEFAULTS: Settings = {
  pressure: PRESSURE,
  lambda: LAMBDA,
  mu: MU,
  wall: THICKNESS,
  clamped: "bottom",
  element: "mean-dilatation",
};

/** The part of an address behind #: the pixels as bits in base64, and the settings that are not the usual ones. */
export function toFragment(image: Image, settings: Settings): string {
  const bits = new Uint8Array(image.length / 8);
  image.forEach((value, k) => {
    if (value) bits[k >> 3] |= 1 << (k & 7);
  });
  const text = btoa(String.fromCharCode(...bits))
    .replace(/\+/g, "-")
    .replace(/\//g, "_")
    .replace(/=/g, "");
  const told = new URLSearchParams({ [KEY]: text });
  for (const [name, value] of Object.entries(settings)) {
    if (value !== DEFAULTS[name as keyof Settings]) told.set(name, String(value));
  }
  return `#${told}`;
}

/** What a link says; null where it says nothing about a structure. Throws a Refusal where it is malformed. */
export function fromFragment(fragment: string): { image: Image; settings: Settings } | null {
  const told = new URLSearchParams(fragment.replace(/^#/, ""));
  const text = told.get(KEY);
  if (text === null) return null;
  let bits = "";
  try {
    bits = atob(text.replace(/-/g, "+").replace(/_/g, "/"));
  } catch {
    bits = "";
  }
  if (bits.length !== (FRAME * FRAME) / 8)
    throw new Refusal("the link is malformed: it holds no drawing of 28 by 28 pixels");
  const image = Float64Array.from({ length: FRAME * FRAME }, (_, k) => (bits.charCodeAt(k >> 3) >> (k & 7)) & 1);
  told.delete(KEY);
  return { image, settings: readSettings(Object.fromEntries(told), "the link is malformed") };
}

function readSettings(told: Record<string, unknown>, problem: string): Settings {
  const settings: Settings = { ...DEFAULTS };
  const wrong = (name: string) => new Refusal(`${problem}: ${name} is ${JSON.stringify(told[name])}`);
  for (const [name, value] of Object.entries(told)) {
    if (name === "clamped" && EDGES.includes(value as Edge)) settings.clamped = value as Edge;
    else if (name === "element" && ELEMENTS.includes(value as Element)) settings.element = value as Element;
    else if (name === "pressure" || name === "lambda" || name === "mu" || name === "wall") {
      const number = Number(value);
      const least = name === "wall" ? 1 : 0;
      if (value === "" || !(number >= least && number <= 100) || (name === "wall" && number % 1)) throw wrong(name);
      settings[name] = number;
    } else throw wrong(name);
  }
  return settings;
}

/** The structure as JSON, which `inflate design --from` continues. */
export function toJson(image: Image, settings: Settings, targets: Targets): string {
  const rows = Array.from({ length: FRAME }, (_, i) => Array.from(image.subarray(i * FRAME, (i + 1) * FRAME)).join(""));
  return `${JSON.stringify({ format: FORMAT, image: rows, settings, targets }, null, 1)}\n`;
}

/** What a file says. Throws a Refusal where it is none of ours. */
export function fromJson(text: string): { image: Image; settings: Settings } {
  let told: { format?: unknown; image?: unknown; settings?: unknown };
  try {
    told = JSON.parse(text);
  } catch {
    throw new Refusal("the file is no JSON");
  }
  if (told?.format !== FORMAT) throw new Refusal(`the file is none of the laboratory's: its format is not "${FORMAT}"`);
  const rows = told.image;
  const fits = Array.isArray(rows) && rows.length === FRAME && rows.every((row) => /^[01]{28}$/.test(String(row)));
  if (!fits) throw new Refusal("the file holds no drawing of 28 rows of 28 digits, 0 or 1");
  const image = Float64Array.from(rows.join(""), Number);
  return { image, settings: readSettings({ ...(told.settings ?? {}) }, "the file is malformed") };
}

/** The wall of a label image as one path, in millimetres. */
export function toSvg(label: Image, clamped: Edge): string {
  const mesh = buildMesh(label, clamped);
  const number = (value: number) => String(Number(value.toFixed(4)));
  const loops = boundaryLoops(mesh.cells).map((loop) => {
    const points = loop.map((node) => [mesh.nodes[2 * node], mesh.nodes[2 * node + 1]]);
    const corners = points.filter(([x, y], k) => {
      const [before, after] = [points.at(k - 1) ?? [0, 0], points[(k + 1) % points.length]];
      return (before[0] === x) !== (x === after[0]) || (before[1] === y) !== (y === after[1]);
    });
    return `M ${corners.map(([x, y]) => `${number(x * SIZE_MM)},${number((1 - y) * SIZE_MM)}`).join(" L ")} Z`;
  });
  return (
    `<svg xmlns="http://www.w3.org/2000/svg" width="${SIZE_MM}mm" height="${SIZE_MM}mm" viewBox="0 0 ${SIZE_MM} ${SIZE_MM}">\n` +
    `<path d="${loops.join(" ")}" fill="#0072B2" fill-rule="evenodd" stroke="none"/>\n</svg>\n`
  );
}

/** The label image as a picture of 28 × 28 pixels, which `inflate simulate` reads. */
export function toPng(label: Image): Promise<Blob> {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = FRAME;
  const context = canvas.getContext("2d");
  const picture = new ImageData(FRAME, FRAME);
  label.forEach((value, k) => {
    const grey = value === WALL ? 127 : Math.round(254 * value);
    picture.data.set([grey, grey, grey, 255], 4 * k);
  });
  context?.putImageData(picture, 0, 0);
  return new Promise((resolve, reject) => {
    canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("the picture could not be made"))), "image/png");
  });
}

/** A picture of any size as a drawing: its darker or brighter part, whichever is the smaller, made 28 × 28. */
export async function fromPicture(file: Blob): Promise<Image> {
  let bitmap: ImageBitmap;
  try {
    bitmap = await createImageBitmap(file);
  } catch {
    throw new Refusal("the file is no picture that this browser can read");
  }
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = FRAME;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  if (!context) throw new Refusal("this browser gives no canvas");
  context.fillStyle = "#fff";
  context.fillRect(0, 0, FRAME, FRAME);
  const scale = FRAME / Math.max(bitmap.width, bitmap.height);
  const [width, height] = [bitmap.width * scale, bitmap.height * scale];
  context.drawImage(bitmap, (FRAME - width) / 2, (FRAME - height) / 2, width, height);
  const { data } = context.getImageData(0, 0, FRAME, FRAME);
  const grey = Float64Array.from(
    { length: FRAME * FRAME },
    (_, k) => (data[4 * k] + data[4 * k + 1] + data[4 * k + 2]) / 765,
  );
  const bright = grey.map((value) => Number(value > 0.5));
  const share = bright.reduce((sum, value) => sum + value, 0) / bright.length;
  return share <= 0.5 ? bright : bright.map((value) => 1 - value);
}
