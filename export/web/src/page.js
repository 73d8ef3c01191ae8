// The page: a model and an image in; the surface, and the traction on it, out.
import { imageOf } from "./image.js";
import { Model } from "./model.js";
import { npz } from "./npz.js";
import { COLOURS, Surface } from "./surface.js";

const SECONDS_PER_MB = 4; // that a core of a PC takes to load a model
const READINGS = ["force", "pressure", "volume", "displacement", "markers", "time"];
const at = (id) => document.getElementById(id);
const surface = new Surface(at("surface"));
let model, result;

async function openModel(file) {
  const [before, megabytes] = [at("status").textContent, file.size / 1e6];
  const seconds = Math.max(1, SECONDS_PER_MB * megabytes).toFixed(0);
  at("status").textContent = `loading a model of ${megabytes.toFixed(1)} MB; this takes some ${seconds} s`;
  let next;
  try {
    next = await Model.open(new Uint8Array(await file.arrayBuffer()));
  } catch (error) {
    at("status").textContent = model ? before : "no model";
    throw error;
  }
  model?.close();
  model = next;
  result = null;
  at("sensor").textContent = model.sensor.name;
  at("status").textContent = model.tracks ? "ready for a video's images" : "ready for an image";
  at("forget").hidden = !model.tracks;
  for (const id of READINGS) at(id).textContent = "–";
  at("save").disabled = true;
  document.body.classList.remove("failed");
  surface.begin(model.sensor.mesh);
  showColours("Compressive traction", null);
}

async function openImage(file, name) {
  if (!model) throw new Error("there is no model yet; open one first");
  const { imageSize, bits } = model.sensor;
  const { pixels, grey } = await imageOf(file, imageSize, bits);
  const [width, height] = imageSize;
  const { frame, milliseconds } = await model.run(grey);
  Object.assign(at("image"), { width, height });
  at("image").setAttribute("aria-label", name);
  at("image").getContext("2d", { willReadFrequently: true }).putImageData(pixels, 0, 0);
  at("name").textContent = name;
  result = { frame, stem: name.replace(/\.[^.]*$/, "") };
  at("save").disabled = false;
  showReadings(frame, milliseconds);
  showSurface(frame);
}

function showReadings(frame, milliseconds) {
  const { lengthUnit, forceUnit } = model.sensor;
  const [force, stress] = forceUnit === "relative" ? ["(relative)", "(relative)"] : [forceUnit, `${forceUnit}/${lengthUnit}²`];
  const [pressure, change, volume] = ["pressure", "pressure_change", "volume_error"].map((name) => frame[name].data[0]);
  const components = [...frame.force.data];
  const say = (id, value, text) => (at(id).textContent = Number.isFinite(value) ? text : "–");
  say("force", components[0], `${short(length(components))} ${force} (${components.map(short).join(", ")})`);
  say("pressure", pressure, `${short(pressure)} ${stress} (${change < 0 ? "" : "+"}${short(change)})`);
  say("volume", volume, short(volume));
  const moved = Math.max(...rows(frame.displacement).map(length));
  say("displacement", moved, `up to ${short(moved)} ${lengthUnit}`);
  const confidence = frame.confidence.data;
  at("markers").textContent = `${confidence.filter((value) => value > 0).length} of ${confidence.length}`;
  at("time").textContent = `${milliseconds.toFixed(0)} ms`;
  at("status").textContent = model.statusText(frame.status.data[0]);
}

/** The surface with the inward traction on it; of a model that finds no forces, with the depth. */
function showSurface(frame) {
  const { lengthUnit, forceUnit, mesh } = model.sensor;
  const found = frame.vertices.data.every(Number.isFinite);
  document.body.classList.toggle("failed", !found);
  if (!found) return surface.clear();
  const forces = frame.traction.data.some((value) => value !== 0);
  const values = forces ? inward(frame.traction, rows(frame.normals)) : inward(frame.displacement, mesh.rest_normals);
  const most = Math.max(...values, Number.MIN_VALUE);
  const contacts = rows(frame.contact_points).filter((point) => point.every(Number.isFinite));
  surface.show(frame.vertices.data, values, most, contacts, forces ? [...frame.force.data] : null);
  const unit = forceUnit === "relative" ? "(relative)" : `[${forceUnit}/${lengthUnit}²]`;
  showColours(forces ? `Compressive traction ${unit}` : `Pressed in by [${lengthUnit}]`, most);
}

/** The colour bar from 0 to `most`, or without numbers. */
function showColours(quantity, most) {
  at("quantity").textContent = quantity;
  at("colours").style.background = `linear-gradient(to right, ${COLOURS.join(", ")})`;
  const step = most && [1, 2, 5, 10].map((m) => m * 10 ** Math.floor(Math.log10(most / 4))).find((size) => most / size <= 5);
  const ticks = most ? Array.from({ length: Math.floor(most / step) + 1 }, (_, k) => k * step) : [];
  at("ticks").replaceChildren(
    ...ticks.map((value) => {
      const tick = document.createElement("span");
      tick.textContent = short(value);
      tick.style.left = `${(100 * value) / most}%`;
      return tick;
    }),
  );
}

/** Components against the outward normals, one number per vertex. */
const inward = (vectors, normals) => rows(vectors).map((row, k) => -row.reduce((sum, x, c) => sum + x * normals[k][c], 0));

function rows({ data, shape: [count, size] }) {
  return Array.from({ length: count }, (_, k) => [...data.subarray(size * k, size * (k + 1))]);
}

const length = (vector) => Math.hypot(...vector);

/** Three digits; tiny values as powers of ten. */
function short(value) {
  const text = value !== 0 && Math.abs(value) < 1e-3 ? value.toExponential(1) : String(Number(value.toPrecision(3)));
  return text.replaceAll("-", "−");
}

async function fetched(path) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`the server answers ${response.status}`);
  return response.blob();
}

/** Jobs run one after another; failures are shown as messages. */
let last = Promise.resolve();
function inTurn(name, job) {
  last = last.then(async () => {
    at("message").hidden = true;
    document.body.setAttribute("aria-busy", "true");
    await job().catch((error) => {
      at("message").textContent = `${name}: ${error.message}`;
      at("message").hidden = false;
    });
    document.body.setAttribute("aria-busy", "false");
  });
}

const isModel = (file) => /\.(onnx|ort)$/i.test(file.name);

/** Files as they are given; several at once in the order of their names, for a model that tracks takes them for a video. */
function open(files) {
  const order = new Intl.Collator("en", { numeric: true });
  files.sort((one, other) => isModel(other) - isModel(one) || order.compare(one.name, other.name));
  for (const file of files) inTurn(file.name, () => (isModel(file) ? openModel(file) : openImage(file, file.name)));
}

// EXAMPLES: the names of the files given to build.js
for (const name of EXAMPLES) {
  const words = name.replace(/\.[^.]*$/, "").replaceAll("_", " ");
  const button = document.createElement("button");
  Object.assign(button, { type: "button", textContent: words[0].toUpperCase() + words.slice(1) });
  button.onclick = () => inTurn(name, async () => openImage(await fetched(`examples/${name}`), name));
  at("examples").append(button);
}

for (const id of ["pick-image", "pick-model"]) {
  at(id).onchange = () => {
    open([...at(id).files]);
    at(id).value = ""; // so that the same file can be opened again
  };
}

addEventListener("dragover", (event) => event.preventDefault());
addEventListener("drop", (event) => {
  event.preventDefault();
  open([...event.dataTransfer.files]);
});

at("save").onclick = () => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([npz(result.frame)]));
  link.download = `${result.stem}.npz`;
  link.click();
  URL.revokeObjectURL(link.href);
};

at("forget").onclick = () => inTurn("from rest", () => model.forget());

at("turn").checked = !matchMedia("(prefers-reduced-motion: reduce)").matches;
at("turn").onchange = () => (surface.turning = at("turn").checked);
at("turn").onchange();

inTurn("model.onnx", async () => openModel(await fetched("model.onnx")));
