// What a model says of its sensor. onnxruntime-web has no access to a model's metadata: it is read from the file itself.
import { PbfReader } from "pbf";

const FORMAT = "1";
const METADATA_PROPS = 14; // field of ModelProto in onnx.proto; an entry's fields: 1 key, 2 value
const EXPECTED = 'a model of format 1 from "torchmembrane export"';
const MESH = { rest_vertices: 3, rest_normals: 3, triangles: 3 }; // what is drawn, and the numbers of a row

/**
 * The sensor of a model from `torchmembrane export`: name, lengthUnit, forceUnit, statusTexts (code to text), mesh
 * (rest_vertices [V][3], triangles [T][3], grid [2] ...); imageSize [2] of its images, which several views may share; bits of
 * the camera, where images of 16 hold fewer.
 */
export function sensorOf(bytes) {
  const known = metadata(bytes);
  if (known.format !== FORMAT) throw new Error(`not ${EXPECTED} (its format: ${known.format ?? "none"})`);
  const missing = ["name", "length_unit", "force_unit", "status_texts", "mesh"].find((key) => !known[key]);
  if (missing) throw new Error(`its metadata lack ${missing}; expected ${EXPECTED}: export it again`);
  const [statusTexts, mesh] = ["status_texts", "mesh"].map((key) => parsed(key, known[key]));
  const [views, part] = [String(mesh.view_names ?? "").split(" "), mesh.image_part ?? []];
  if (views.length > 1 && part.length === 0) {
    throw new Error(`it takes an image for each of the views ${views.join(", ")}; expected a model of one image per frame`);
  }
  const bits = known.bits ? Number(known.bits) : undefined;
  const wrong = unlike(mesh) || (bits !== undefined && !(bits >= 8 && bits <= 16) && "bits");
  if (wrong) throw new Error(`its metadata are damaged (${wrong}); expected ${EXPECTED}: export it again`);
  const imageSize = part.length ? part.slice(2) : mesh.image_size;
  return { name: known.name, lengthUnit: known.length_unit, forceUnit: known.force_unit, statusTexts, mesh, imageSize, bits };
}

function metadata(bytes) {
  try {
    return new PbfReader(bytes).readFields((field, known, reader) => {
      if (field !== METADATA_PROPS) return;
      const [key, value] = reader.readMessage((part, entry, inner) => (entry[part - 1] = inner.readString()), []);
      known[key] = value;
    }, {});
  } catch (error) {
    throw new Error(`not readable as an ONNX model (${error.message}); expected ${EXPECTED}`);
  }
}

function parsed(key, text) {
  try {
    const value = JSON.parse(text.replaceAll(/\bNaN\b/g, "null")); // Python writes NaN, which JSON lacks
    if (value && typeof value === "object" && !Array.isArray(value)) return value;
  } catch {
    // said below
  }
  throw new Error(`its metadata are damaged (${key}); expected ${EXPECTED}: export it again`);
}

/** What of a mesh is not as it is drawn; undefined of one that is. */
function unlike(mesh) {
  const numbers = (list, length) => Array.isArray(list) && list.length === length && list.every(Number.isFinite);
  const rows = (list, length) => Array.isArray(list) && list.every((row) => numbers(row, length));
  const wrong = Object.keys(MESH).find((key) => !rows(mesh[key], MESH[key]));
  if (wrong) return wrong;
  const counts = (list) => numbers(list, 2) && list.every((n) => Number.isInteger(n) && n > 0);
  const pair = ["grid", "image_size"].find((key) => !counts(mesh[key]));
  if (pair) return pair;
  const part = mesh.image_part ?? [];
  if (part.length !== 0 && !(numbers(part, 4) && counts(part.slice(2)))) return "image_part";
  const count = mesh.rest_vertices.length;
  if (mesh.grid[0] * mesh.grid[1] !== count || mesh.rest_normals.length !== count) return "grid";
  if (!mesh.triangles.flat().every((corner) => Number.isInteger(corner) && corner >= 0 && corner < count)) return "triangles";
}
