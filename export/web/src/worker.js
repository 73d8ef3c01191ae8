// onnxruntime in a thread of its own, so that the surface turns on while a frame is computed. One worker holds one model.
import * as ort from "onnxruntime-web/wasm";
import wasm from "onnxruntime-web/ort-wasm-simd-threaded.wasm";

ort.env.wasm.wasmPaths = { wasm: new URL(wasm, import.meta.url).href };
ort.env.wasm.numThreads = 1; // more need cross-origin isolation, and a single frame gains nothing by them

let session;

/** A model of images `width` x `height`, run once, as browsers compile what they run more slowly than they run it. */
async function open({ bytes, width, height }) {
  session = await ort.InferenceSession.create(bytes, { executionProviders: ["wasm"], logSeverityLevel: 3 });
  if (session.inputNames.join() !== "image") {
    throw new Error(`a model with the inputs ${session.inputNames.join(", ")}; expected one exported without --tracking`);
  }
  await run({ grey: new Float32Array(width * height), width, height });
}

/** One frame's outputs, { name: { data, shape } }, and the milliseconds of the run. */
async function run({ grey, width, height }) {
  const image = new ort.Tensor("float32", grey, [1, 1, height, width]);
  const start = performance.now();
  const outputs = await session.run({ image });
  const milliseconds = performance.now() - start;
  const frame = Object.entries(outputs).map(([name, { data, dims }]) => [name, { data, shape: dims.slice(1) }]);
  return { frame: Object.fromEntries(frame), milliseconds };
}

onmessage = async ({ data: { model, image } }) => {
  try {
    postMessage({ answer: await (model ? open(model) : run(image)) });
  } catch (error) {
    postMessage({ error: error.message });
  }
};
