// onnxruntime in a thread of its own, so that the surface turns on while a frame is computed. One worker holds one model.
import * as ort from "onnxruntime-web/wasm";
import wasm from "onnxruntime-web/ort-wasm-simd-threaded.wasm";

ort.env.wasm.wasmPaths = { wasm: new URL(wasm, import.meta.url).href };
ort.env.wasm.numThreads = 1; // more need cross-origin isolation, and a single frame gains nothing by them

const PREVIOUS = "previous_";
const NEEDED = [
  ...["vertices", "displacement", "normals", "confidence", "traction", "contact_points"],
  ...["force", "pressure", "pressure_change", "volume_error", "status"],
];

let session, given, state;

/** A model of images `width` x `height`, run once, as browsers compile what they run more slowly than they run it. */
async function open({ bytes, width, height }) {
  try {
    session = await ort.InferenceSession.create(bytes, { executionProviders: ["wasm"], logSeverityLevel: 3 });
  } catch (error) {
    throw new Error(`onnxruntime cannot load it (${error.message}); expected a model from "torchmembrane export"`);
  }
  const missing = NEEDED.find((name) => !session.outputNames.includes(name));
  if (missing) throw new Error(`it gives no ${missing}; expected a model from "torchmembrane export"`);
  given = session.inputMetadata.filter(({ name }) => name.startsWith(PREVIOUS));
  forget();
  await session.run({ image: imageOf({ grey: new Float32Array(width * height), width, height }), ...state });
  return { tracks: given.length > 0 };
}

/** The next frame starts from rest. */
function forget() {
  state = Object.fromEntries(given.map(({ name, shape }) => [name, unknown([1, ...shape.slice(1)])]));
}

const unknown = (dims) => new ort.Tensor("float32", new Float32Array(dims.reduce((size, n) => size * n, 1)).fill(NaN), dims);
const imageOf = ({ grey, width, height }) => new ort.Tensor("float32", grey, [1, 1, height, width]);

/** One frame's outputs, { name: { data, shape } }, and the milliseconds of the run; a model that tracks keeps where it ended. */
async function run(pixels) {
  const image = imageOf(pixels);
  const start = performance.now();
  const outputs = await session.run({ image, ...state });
  const milliseconds = performance.now() - start;
  state = Object.fromEntries(given.map(({ name }) => [name, outputs[name.slice(PREVIOUS.length)]]));
  const frame = Object.entries(outputs).map(([name, { data, dims }]) => [name, { data, shape: dims.slice(1) }]);
  return { frame: Object.fromEntries(frame), milliseconds };
}

onmessage = async ({ data: { model, image } }) => {
  try {
    postMessage({ answer: await (model ? open(model) : image ? run(image) : forget()) });
  } catch (error) {
    postMessage({ error: error.message });
  }
};
