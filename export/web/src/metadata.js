// What a model says of its sensor. onnxruntime-web has no access to a model's metadata: it is read from the file itself.
import { PbfReader } from "pbf";

const FORMAT = "1";
const METADATA_PROPS = 14; // field of ModelProto in onnx.proto; an entry's fields: 1 key, 2 value

/**
 * The sensor of a model from `torchmembrane export`: name, lengthUnit, forceUnit, statusTexts (code to text), mesh
 * (rest_vertices [V][3], triangles [T][3], grid [2], image_size [2] ...).
 */
export function sensorOf(bytes) {
  const known = metadata(bytes);
  if (known.format !== FORMAT) {
    throw new Error(`not a model of format ${FORMAT} from "torchmembrane export" (its format: ${known.format ?? "none"})`);
  }
  return {
    name: known.name,
    lengthUnit: known.length_unit,
    forceUnit: known.force_unit,
    statusTexts: JSON.parse(known.status_texts),
    mesh: JSON.parse(known.mesh),
  };
}

function metadata(bytes) {
  try {
    return new PbfReader(bytes).readFields((field, known, reader) => {
      if (field !== METADATA_PROPS) return;
      const [key, value] = reader.readMessage((part, entry, inner) => (entry[part - 1] = inner.readString()), []);
      known[key] = value;
    }, {});
  } catch (error) {
    throw new Error(`not readable as an ONNX model (${error.message})`);
  }
}
