/**
 * The U-Net of `inflate_lib.diffusion.unet` on TensorFlow.js, whose WebAssembly backend brings the convolutions.
 *
 * All images of a call are asked for the same descriptors, so what the network is told is computed once for all.
 */

import { setWasmPaths } from "@tensorflow/tfjs-backend-wasm";
import * as tf from "@tensorflow/tfjs-core";
import { bytes, fromHalf, type StoredModel } from "./model.ts";

const EPSILON = 1e-5; // of the normalisations

/** Start the backend from the bytes of its WebAssembly, for there is no file to fetch it from. */
export async function startBackend(wasm: Uint8Array): Promise<void> {
  const content = new Response(wasm as BlobPart, { headers: { "content-type": "application/wasm" } });
  tf.env().platform.fetch = async () => content.clone();
  const names = ["", "-simd", "-threaded-simd"].map((kind) => [`tfjs-backend-wasm${kind}.wasm`, "embedded"]);
  setWasmPaths(Object.fromEntries(names), true);
  await tf.setBackend("wasm");
  await tf.ready();
}

type Vector = Float32Array;

export class Network {
  private readonly plain = new Map<string, { shape: number[]; values: Vector }>();
  private readonly filters = new Map<string, tf.Tensor4D>();
  private readonly biases = new Map<string, tf.Tensor1D>();
  private readonly averages = new Map<string, tf.Tensor>();

  constructor(private readonly model: StoredModel) {
    const all = fromHalf(new Uint16Array(bytes(model.weights).buffer));
    for (const { name, shape, at } of model.tensors) {
      const values = all.subarray(at, at + shape.reduce((a, b) => a * b, 1));
      if (shape.length === 4) {
        // PyTorch's order is outputs, inputs, rows, columns; here it is rows, columns, inputs, outputs.
        const transposed = tf.tidy(() =>
          tf.transpose(tf.tensor4d(values, shape as [number, number, number, number]), [2, 3, 1, 0]),
        );
        this.filters.set(name, transposed as tf.Tensor4D);
      } else this.plain.set(name, { shape, values });
    }
  }

  /**
   * The answer to images (n, size, size) at time t.
   *
   * `conditions` are min–max scaled, NaN where nothing is asked for.
   */
  predict(x: Float32Array, size: number, t: number, conditions: number[], guidance: number): Float32Array {
    const context = this.context(t, conditions, guidance).map(silu);
    const { blocks } = this.model.config;
    const scales = this.model.config.channels.length;
    const answer = tf.tidy(() => {
      let h: tf.Tensor4D = tf.tensor4d(x, [x.length / size ** 2, size, size, 1]);
      h = this.convolved(h, "stem");
      const skips: tf.Tensor4D[] = [];
      for (let i = 0; i < scales * blocks; i++) {
        if (i > 0 && i % blocks === 0) {
          skips.push(h); // the next scale
          h = this.convolved(h, `downs.${i / blocks - 1}`, 2);
        }
        h = this.block(h, `down_blocks.${i}`, context);
      }
      skips.push(h);
      h = this.block(this.block(h, "middle.0", context), "middle.1", context);
      for (let i = 0; i < scales * blocks; i++) {
        if (i % blocks === 0) {
          if (i > 0) h = this.convolved(doubled(h), `ups.${i / blocks - 1}`);
          h = tf.concat([h, skips.pop() as tf.Tensor4D], 3);
        }
        h = this.block(h, `up_blocks.${i}`, context);
      }
      const [scale, shift] = [this.values("norm.weight"), this.values("norm.bias")];
      return this.convolved(activated(this.normalised(h, scale, shift)), "out");
    });
    const values = answer.dataSync() as Float32Array;
    answer.dispose();
    return values;
  }

  /** ζ = ζ_t + ζ_d + ζ_w: what the network is told of time, descriptor and strength of guidance. */
  private context(t: number, conditions: number[], guidance: number): Vector {
    const { embedding } = this.model.config;
    const half = embedding / 2;
    const context = new Float32Array(embedding);
    for (let k = 0; k < half; k++) {
      const angle = t * Math.exp((-Math.log(10_000) * k) / half);
      context[k] = Math.cos(angle);
      context[half + k] = Math.sin(angle);
    }
    let place = 0;
    const known = this.model.parts.map(({ length }) => {
      place += length;
      return Number(!Number.isNaN(conditions[place - length]));
    });
    let described = this.values("null");
    if (known.includes(1)) {
      described = Float32Array.from([...conditions.map((value) => (Number.isNaN(value) ? 0 : value)), ...known]);
      for (const layer of [0, 2, 4]) {
        described = this.linear(layer ? described.map(silu) : described, `descriptor.${layer}`);
      }
    }
    described.forEach((value, k) => {
      context[k] += value;
    });
    if (this.plain.has("strength.0.weight")) {
      const hidden = this.linear(Float32Array.of(Math.log(guidance)), "strength.0").map(silu);
      this.linear(hidden, "strength.2").forEach((value, k) => {
        context[k] += value;
      });
    }
    return context;
  }

  private block(x: tf.Tensor4D, name: string, context: Vector): tf.Tensor4D {
    const told = this.linear(context, `${name}.context`);
    const first = this.normalised(x, this.values(`${name}.norm1.weight`), this.values(`${name}.norm1.bias`));
    let h = this.convolved(activated(first), `${name}.conv1`);
    let [scale, shift] = [this.values(`${name}.norm2.weight`), this.values(`${name}.norm2.bias`)];
    if (this.model.config.conditioning === "scale-shift") {
      const c = scale.length;
      shift = shift.map((value, k) => value * (1 + told[k]) + told[c + k]);
      scale = scale.map((value, k) => value * (1 + told[k]));
    } else h = tf.add(h, tf.tensor1d(told));
    h = this.convolved(activated(this.normalised(h, scale, shift)), `${name}.conv2`);
    const beside = this.filters.has(`${name}.shortcut.weight`) ? this.convolved(x, `${name}.shortcut`) : x;
    return tf.add(beside, h);
  }

  /** Group normalisation, then scale and shift. Means over pixels are products with a row of equal numbers: quick. */
  private normalised(x: tf.Tensor4D, scale: Vector, shift: Vector): tf.Tensor4D {
    const [n, height, width, c] = x.shape;
    const flat = tf.reshape(x, [n, height * width, c]);
    const pixels = this.average(`pixels ${height * width}`, [1, 1, height * width], () => 1 / (height * width));
    const groups = gcd(this.model.groups, c);
    const size = c / groups;
    const within = (k: number) => Number(Math.floor(k / c / size) === Math.floor((k % c) / size)) / size;
    const pooled = this.average(`groups ${c}`, [c, c], within);
    const rows = tf.tile(pixels, [n, 1, 1]);
    const mean = tf.matMul(tf.reshape(tf.matMul(rows, flat), [n, c]), pooled);
    const square = tf.matMul(tf.reshape(tf.matMul(rows, tf.square(flat)), [n, c]), pooled);
    const factor = tf.mul(tf.rsqrt(tf.add(tf.sub(square, tf.square(mean)), EPSILON)), tf.tensor1d(scale));
    const offset = tf.sub(tf.tensor1d(shift), tf.mul(mean, factor));
    const scaled = tf.mul(flat, tf.reshape(factor, [n, 1, c]));
    return tf.reshape(tf.add(scaled, tf.reshape(offset, [n, 1, c])), [n, height, width, c]);
  }

  private average(name: string, shape: number[], value: (k: number) => number): tf.Tensor {
    const known = this.averages.get(name);
    if (known) return known;
    const size = shape.reduce((a, b) => a * b, 1);
    const made = tf.keep(
      tf.tensor(
        Float32Array.from({ length: size }, (_, k) => value(k)),
        shape,
      ),
    );
    this.averages.set(name, made);
    return made;
  }

  private convolved(x: tf.Tensor4D, name: string, stride = 1): tf.Tensor4D {
    const filter = this.filters.get(`${name}.weight`) as tf.Tensor4D;
    const bias = this.biases.get(name) ?? tf.keep(tf.tensor1d(this.values(`${name}.bias`)));
    this.biases.set(name, bias);
    const pad = (filter.shape[0] - 1) / 2;
    return tf.fused.conv2d({ x, filter, strides: stride, pad, dimRoundingMode: "floor", bias }) as tf.Tensor4D;
  }

  private linear(x: Vector, name: string): Vector {
    const { shape, values } = this.plain.get(`${name}.weight`) as { shape: number[]; values: Vector };
    return this.values(`${name}.bias`).map((bias, i) => {
      let sum = bias;
      for (let j = 0; j < shape[1]; j++) sum += values[i * shape[1] + j] * x[j];
      return sum;
    });
  }

  private values(name: string): Vector {
    return (this.plain.get(name) as { values: Vector }).values;
  }
}

const silu = (value: number) => value / (1 + Math.exp(-value));
const activated = (x: tf.Tensor4D): tf.Tensor4D => tf.mul(x, tf.sigmoid(x));
const gcd = (a: number, b: number): number => (b ? gcd(b, a % b) : a);

/** Every pixel four times. */
function doubled(x: tf.Tensor4D): tf.Tensor4D {
  const [n, height, width, c] = x.shape;
  const columns = tf.reshape(x, [n * height * width, 1, c]);
  const wide = tf.reshape(tf.concat([columns, columns], 1), [n * height, 1, 2 * width * c]);
  return tf.reshape(tf.concat([wide, wide], 1), [n, 2 * height, 2 * width, c]);
}
