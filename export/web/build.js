// Bundles the page into dist/: node build.js MODEL.onnx EXAMPLE.png...
import { cpSync, mkdirSync, rmSync } from "node:fs";
import { basename } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const [model, ...examples] = process.argv.slice(2);
if (!model?.endsWith(".onnx")) throw new Error(`build.js: model ${model}; expected node build.js MODEL.onnx EXAMPLE.png...`);
const here = fileURLToPath(new URL(".", import.meta.url));

rmSync(`${here}dist`, { recursive: true, force: true });
await build({
  absWorkingDir: here,
  entryPoints: ["src/page.js", "src/worker.js", "src/page.css", "src/index.html"],
  outdir: "dist",
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  loader: { ".wasm": "file", ".html": "copy" },
  define: { EXAMPLES: JSON.stringify(examples.map((example) => basename(example))) },
  assetNames: "[name]",
  legalComments: "linked",
  logLevel: "warning",
});
mkdirSync(`${here}dist/examples`);
cpSync(model, `${here}dist/model.onnx`);
for (const example of examples) cpSync(example, `${here}dist/examples/${basename(example)}`);
