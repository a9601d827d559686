/** Calls to a worker as promises. Workers come from text, for a page on a disk may load no worker from a file. */

import { Refusal } from "./words.ts";

interface Waiting {
  resolve: (value: unknown) => void;
  reject: (error: Error) => void;
  watch?: (progress: unknown) => void;
}

export class Remote {
  private worker: Worker | null = null;
  private ready: Promise<Worker> | null = null;
  private waiting = new Map<number, Waiting>();
  private count = 0;

  /** `source` gives the text of the worker, `first` what every new one is asked before all else. */
  constructor(
    private readonly source: () => string,
    private readonly first: () => [string, unknown[]][] = () => [],
  ) {}

  /** Ask the worker for something; `watch` hears of its progress. */
  async call<T>(name: string, args: unknown[], watch?: (progress: never) => void): Promise<T> {
    this.ready ??= this.start(); // calls that arrive meanwhile wait for the same start
    return this.ask<T>(await this.ready, name, args, watch);
  }

  private ask<T>(worker: Worker, name: string, args: unknown[], watch?: (progress: never) => void): Promise<T> {
    return new Promise((resolve, reject) => {
      this.count++;
      this.waiting.set(this.count, {
        resolve: resolve as Waiting["resolve"],
        reject,
        watch: watch as Waiting["watch"],
      });
      worker.postMessage({ id: this.count, name, args });
    });
  }

  /** Whether something is being computed. */
  get busy(): boolean {
    return this.waiting.size > 0;
  }

  /** End what is being computed; the next call starts a new worker. */
  stop(): void {
    this.worker?.terminate();
    this.worker = this.ready = null;
    for (const { reject } of this.waiting.values()) reject(new Refusal("stopped"));
    this.waiting.clear();
  }

  private async start(): Promise<Worker> {
    const address = URL.createObjectURL(new Blob([this.source()], { type: "text/javascript" }));
    const worker = new Worker(address);
    worker.addEventListener("message", ({ data }) => {
      const waiting = this.waiting.get(data.id);
      if ("progress" in data) {
        waiting?.watch?.(data.progress);
        return;
      }
      this.waiting.delete(data.id);
      if ("refusal" in data) waiting?.reject(new Refusal(data.refusal));
      else if ("error" in data) waiting?.reject(new Error(data.error));
      else waiting?.resolve(data.result);
    });
    worker.addEventListener("error", (event) => {
      for (const { reject } of this.waiting.values()) reject(new Error(event.message || "the worker has failed"));
      this.waiting.clear();
    });
    this.worker = worker;
    try {
      await Promise.all(this.first().map(([name, args]) => this.ask(worker, name, args)));
    } catch (error) {
      this.ready = null; // the next call tries again
      throw error;
    }
    return worker;
  }
}

type Call = (watch: (progress: unknown) => void, ...args: never[]) => unknown;

/** In a worker: answer calls by name. */
export function answer(calls: Record<string, Call>): void {
  addEventListener("message", async ({ data: { id, name, args } }: MessageEvent) => {
    try {
      const call = calls[name];
      postMessage({ id, result: await call((progress) => postMessage({ id, progress }), ...(args as never[])) });
    } catch (error) {
      const { message } = error as Error;
      postMessage(error instanceof Refusal ? { id, refusal: message } : { id, error: message });
    }
  });
}
