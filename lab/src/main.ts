/**
 * Brings the laboratories of a page to life: every element of the class `inflate-lab`, a small one on the first page.
 *
 * `window.inflateLab` offers the same to a console and to tests, as promises.
 */

import solverSource from "worker:solver_worker.ts";
import type { DrawOptions } from "./ask.ts";
import { AskPanel } from "./ask_panel.ts";
import { Bench } from "./bench.ts";
import type { Descriptors, Targets } from "./descriptors.ts";
import { make } from "./dom.ts";
import type { InflateOptions, Inflation } from "./inflation.ts";
import css from "./lab.css";
import type { Image, LabelOptions } from "./labels.ts";
import type { StoredModel } from "./model.ts";
import { Remote } from "./remote.ts";
import { Refusal } from "./words.ts";

const here = (document.currentScript as HTMLScriptElement | null)?.src ?? "";
const solver = new Remote(() => solverSource);

/** Load a script that lies beside this one: it sets a variable, for a page on a disk can fetch nothing. */
function script(name: string): Promise<void> {
  return new Promise((resolve, reject) => {
    const element: HTMLScriptElement = make("script", { src: new URL(name, here).href });
    element.addEventListener("load", () => resolve());
    element.addEventListener("error", () => reject(new Refusal(`the file ${name} of this page is missing`)));
    document.head.append(element);
  });
}

declare global {
  interface Window {
    inflateNetwork: string;
    inflateModel: StoredModel;
    inflateMountExplorer?: (root: HTMLElement) => void; // explorer.js of the book
  }
}
let scripts: Promise<unknown> | null = null;
const drawer = new Remote(
  () => window.inflateNetwork,
  () => [["load", [window.inflateModel]]],
);

/** The worker with the network, and the model; both are loaded when something is asked for the first time. */
async function network() {
  scripts ??= Promise.all([script("laboratory_network.js"), script("laboratory_model.js")]);
  await scripts;
  return { remote: drawer, model: window.inflateModel };
}

/** What a call may be told; the values are checked where they are used. */
const OPTIONS = {
  label: ["threshold", "wall", "clamped"],
  inflate: ["steps", "pressure", "lame", "clamped", "element", "timeLimit"],
  draw: ["n", "seed", "purpose", "steps", "guidance", "eta", "sampler", "crowding", "noise"],
};

function known<T extends object>(call: keyof typeof OPTIONS, options: T): T {
  const unknown = Object.keys(options ?? {}).find((name) => !OPTIONS[call].includes(name));
  if (unknown) throw new Refusal(`${call} has no option ${unknown}; it has ${OPTIONS[call].join(", ")}`);
  return options ?? {};
}

const inflateLab = {
  /** Label image of a picture: 28 rows of 28 numbers in [0, 1], or an array of all 784. */
  label: async (image: unknown, options: LabelOptions = {}) =>
    solver.call<Image>("label", [image, known("label", options)]),
  /** Inflate a label image; `result.converged` says whether every load step has an equilibrium. */
  inflate: async (label: unknown, options: InflateOptions = {}) =>
    solver.call<Inflation>("inflate", [label, known("inflate", options)]),
  /** Descriptors of an inflated structure at a load step, the last one by default. */
  describe: (result: Inflation, step?: number) =>
    solver.call<Descriptors>("describe", step === undefined ? [result] : [result, step]),
  /** Images (784 numbers in [0, 1] each) that are drawn to inflate to targets. */
  draw: async (targets: Targets, options: DrawOptions = {}) =>
    (await network()).remote.call<Float64Array[]>("draw", [targets, known("draw", options)]),
};

declare global {
  interface Window {
    inflateLab: typeof inflateLab;
  }
}
window.inflateLab = inflateLab;

/** Where something cannot be computed here: what was computed when the book was made. */
async function mountStored(root: HTMLElement, why: string): Promise<void> {
  const explorer = make("div", { class: "design-explorer" });
  root.append(make("p", { role: "status" }, why), explorer);
  try {
    await script("explorer_data.js");
    window.inflateMountExplorer?.(explorer);
  } catch (error) {
    explorer.append((error as Error).message);
  }
}

function mount(root: HTMLElement): void {
  const small = root.dataset.small !== undefined;
  const stored = "What follows was computed when the book was made.";
  if (typeof Worker === "undefined") {
    const why = "This browser runs no workers, which the laboratory needs.";
    if (small) root.append(make("p", {}, why));
    else mountStored(root, `${why} ${stored}`);
    return;
  }
  const bench = new Bench(solver, small);
  root.append(bench.element);
  if (!small && typeof WebAssembly === "undefined") {
    mountStored(root, `This browser has no WebAssembly, with which structures are drawn for what you ask. ${stored}`);
  } else if (!small) root.append(new AskPanel(bench, network, solver).element);
  bench.open(true);
  if (!small) window.addEventListener("hashchange", () => bench.open(false));
}

function start(): void {
  const roots = document.querySelectorAll<HTMLElement>(".inflate-lab");
  if (!roots.length) return;
  document.head.append(make("style", {}, css));
  roots.forEach(mount);
}

if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", start);
else start();
