/** What a reader saves and shares: all that the page shows in a link or a file, the structure as picture and outline. */

import { type DescriptorName, NAMES, type Targets } from "./descriptors.ts";
import { ELEMENTS, type Element } from "./equilibrium.ts";
import { LAMBDA, MU, PRESSURE } from "./inflation.ts";
import { EDGES, type Edge, FRAME, type Image, THICKNESS, WALL } from "./labels.ts";
import { boundaryLoops, buildMesh } from "./mesh.ts";
import { checkTargets, targetToText, textToTarget } from "./targets.ts";
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

/** Least and most of each number among the settings, and the step of its slider. */
export const RANGES = {
  pressure: [0, 0.03, 0.0005],
  lambda: [1, 40, 0.01],
  mu: [0.05, 0.5, 0.0001],
  wall: [1, 4, 1],
} as const;
export type NumberName = keyof typeof RANGES;

/** All that a link and a file restore. */
export interface State {
  image: Image; // the cavity as it is drawn: 28 · 28 times 0 or 1
  settings: Settings;
  targets: Targets; // empty where nothing is asked for
}

/** The part of an address behind #: the pixels as bits in base64, settings that are not the usual ones, and targets. */
export function toFragment({ image, settings, targets }: State): string {
  const told = new URLSearchParams({ [KEY]: packed(image) });
  for (const [name, value] of Object.entries(settings)) {
    if (value !== DEFAULTS[name as keyof Settings]) told.set(name, String(value));
  }
  for (const [name, target] of Object.entries(targets)) told.set(name, targetToText(name as DescriptorName, target));
  return `#${told}`;
}

/** What a link says; null where it says nothing about a structure. Throws a Refusal where it is malformed. */
export function fromFragment(fragment: string): State | null {
  const { [KEY]: drawing, ...others } = Object.fromEntries(new URLSearchParams(fragment.replace(/^#/, "")));
  if (drawing === undefined) return null;
  const problem = "the link is malformed";
  const image = unpacked(drawing);
  if (!image) throw new Refusal(`${problem}: it holds no drawing of 28 by 28 pixels`);
  const targets: Targets = {};
  for (const name of NAMES) {
    if (name in others) targets[name] = textToTarget(name, others[name]);
    delete others[name];
  }
  return { image, settings: readSettings(others, problem), targets: readTargets(targets, problem) };
}

/** A drawing as text: its bits in base64, with the letters that an address may hold. */
function packed(image: Image): string {
  const bits = new Uint8Array(image.length / 8);
  image.forEach((value, k) => {
    if (value) bits[k >> 3] |= 1 << (k & 7);
  });
  return btoa(String.fromCharCode(...bits))
    .replace(/\+/g, "-")
    .replace(/\//g, "_")
    .replace(/=/g, "");
}

/** The drawing of such a text, null where there is none. */
export function unpacked(text: string): Image | null {
  let bits = "";
  try {
    bits = atob(text.replace(/-/g, "+").replace(/_/g, "/"));
  } catch {
    return null;
  }
  if (bits.length !== (FRAME * FRAME) / 8) return null;
  return Float64Array.from({ length: FRAME * FRAME }, (_, k) => (bits.charCodeAt(k >> 3) >> (k & 7)) & 1);
}

function readSettings(told: Record<string, unknown>, problem: string): Settings {
  const settings: Settings = { ...DEFAULTS };
  for (const [name, value] of Object.entries(told)) {
    const range = Object.hasOwn(RANGES, name) ? RANGES[name as NumberName] : null;
    const number = typeof value === "number" || (typeof value === "string" && value) ? Number(value) : Number.NaN;
    if (range) {
      const fits = number >= range[0] && number <= range[1] && (name !== "wall" || Number.isInteger(number));
      if (!fits) throw new Refusal(`${problem}: ${name} must be from ${range[0]} to ${range[1]}, not ${value}`);
      settings[name as NumberName] = number;
    } else if (name === "clamped" && EDGES.includes(value as Edge)) settings.clamped = value as Edge;
    else if (name === "element" && ELEMENTS.includes(value as Element)) settings.element = value as Element;
    else throw new Refusal(`${problem}: ${name} is ${JSON.stringify(value)}`);
  }
  return settings;
}

function readTargets(told: Targets, problem: string): Targets {
  if (!Object.keys(told).length) return {};
  try {
    return checkTargets(told);
  } catch (error) {
    throw new Refusal(`${problem}: ${(error as Error).message}`);
  }
}

/** All of it as JSON, which `inflate design --from` continues. */
export function toJson({ image, settings, targets }: State): string {
  const rows = Array.from({ length: FRAME }, (_, i) => Array.from(image.subarray(i * FRAME, (i + 1) * FRAME)).join(""));
  return `${JSON.stringify({ format: FORMAT, image: rows, settings, targets }, null, 1)}\n`;
}

/** What a file says. Throws a Refusal where it is none of ours. */
export function fromJson(text: string): State {
  let told: { format?: unknown; image?: unknown; settings?: unknown; targets?: unknown };
  try {
    told = JSON.parse(text);
  } catch {
    throw new Refusal("the file is no JSON");
  }
  if (told?.format !== FORMAT) throw new Refusal(`the file is none of the laboratory's: its format is not "${FORMAT}"`);
  const rows = told.image;
  const fits = Array.isArray(rows) && rows.length === FRAME && rows.every((row) => /^[01]{28}$/.test(String(row)));
  if (!fits) throw new Refusal("the file holds no drawing of 28 rows of 28 digits, 0 or 1");
  const problem = "the file is malformed";
  const object = (name: "settings" | "targets"): Record<string, unknown> => {
    const value = told[name] ?? {};
    if (typeof value !== "object" || Array.isArray(value)) throw new Refusal(`${problem}: ${name} is no object`);
    return value as Record<string, unknown>;
  };
  return {
    image: Float64Array.from(rows.join(""), Number),
    settings: readSettings(object("settings"), problem),
    targets: readTargets(object("targets") as Targets, problem),
  };
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
