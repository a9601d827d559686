/**
 * Bundles the laboratory into `built/`, which git keeps; with `--check`, says whether
 * that is current; with `--tests`, bundles its unit tests into `.tests/` for `node --test`.
 *
 * Each file of `built/` begins with the digest of all that it is made of, which tests/lab/test_built.py computes again.
 */

import { createHash } from "node:crypto";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

/** `import text from "worker:name.ts"`: a worker with all that it needs, as text. */
const workers = {
  name: "workers",
  setup({ onResolve, onLoad }) {
    onResolve({ filter: /^worker:/ }, ({ path }) => ({ path: path.slice("worker:".length), namespace: "worker" }));
    onLoad({ filter: /./, namespace: "worker" }, async ({ path }) => ({
      contents: await bundled(`src/${path}`),
      loader: "text",
    }));
  },
};

async function bundled(entry) {
  const { outputFiles } = await build({
    entryPoints: [entry],
    bundle: true,
    write: false,
    minify: true,
    format: "iife",
    target: "es2022",
    charset: "ascii",
    legalComments: "none",
    loader: { ".css": "text", ".wasm": "base64" },
    external: ["fs", "path", "os", "worker_threads", "perf_hooks", "util", "string_decoder", "crypto"], // of Node alone
    plugins: [workers],
    logLevel: "warning",
  });
  return outputFiles[0].text;
}

/** SHA-256 of the sources and of what pins the tools. */
function digest() {
  const files = [
    "build.mjs",
    "package-lock.json",
    ...readdirSync("src")
      .sort()
      .map((name) => `src/${name}`),
  ];
  const total = createHash("sha256");
  for (const file of files) total.update(file).update("\0").update(readFileSync(file)).update("\0");
  return total.digest("hex");
}

if (process.argv.includes("--tests")) {
  await build({
    entryPoints: readdirSync("tests")
      .filter((name) => name.endsWith(".test.ts"))
      .map((name) => `tests/${name}`),
    outdir: ".tests",
    outExtension: { ".js": ".mjs" },
    bundle: true,
    platform: "node",
    format: "esm",
    logLevel: "warning",
  });
} else {
  const head = `/* Made by lab/build.mjs from ${digest()} */\n`;
  for (const [name, entry] of Object.entries({ laboratory: "main.ts", laboratory_network: "network_script.ts" })) {
    const file = `built/${name}.js`;
    const content = head + (await bundled(`src/${entry}`));
    if (!process.argv.includes("--check")) writeFileSync(file, content);
    else if (readFileSync(file, "utf8") !== content) {
      console.error(`${file} is not made from the sources as they are: npm run build`);
      process.exitCode = 1;
    }
  }
}
