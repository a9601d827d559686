/** The worker that draws structures. It is given the model once, and keeps it. */

import wasm from "@tensorflow/tfjs-backend-wasm/wasm-out/tfjs-backend-wasm-simd.wasm";
import { type DrawOptions, drawStructures } from "./ask.ts";
import type { Targets } from "./descriptors.ts";
import { bytes, type StoredModel } from "./model.ts";
import { Network, startBackend } from "./network.ts";
import { answer } from "./remote.ts";
import { Refusal } from "./words.ts";

let ready: { model: StoredModel; network: Network } | null = null;

answer({
  load: async (_, model: StoredModel) => {
    const code = bytes(wasm);
    if (typeof WebAssembly === "undefined") throw new Refusal("this browser has no WebAssembly, which drawing needs");
    if (!WebAssembly.validate(code as BufferSource))
      throw new Refusal("this browser's WebAssembly has no SIMD, which drawing needs");
    await startBackend(code);
    ready = { model, network: new Network(model) };
  },
  draw: (watch, targets: Targets, options?: DrawOptions) => {
    if (!ready) throw new Error("the model is not loaded");
    return drawStructures(ready.model, ready.network, targets, options, watch);
  },
});
