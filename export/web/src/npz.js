// Results as files of numpy.
import { zipSync } from "fflate";

const TYPES = { Float32Array: "<f4", Int32Array: "<i4" };

/** An .npz file's bytes of arrays { name: { data, shape } }, float32 or int32. */
export function npz(arrays) {
  return zipSync(Object.fromEntries(Object.entries(arrays).map(([name, array]) => [`${name}.npy`, npy(array)])), { level: 0 });
}

/** Version 1.0 of the format: magic, length of the header, header padded to a multiple of 64 bytes, values. */
function npy({ data, shape }) {
  const sizes = shape.map((size) => `${size}, `).join("");
  const header = `{'descr': '${TYPES[data.constructor.name]}', 'fortran_order': False, 'shape': (${sizes}), }`;
  const length = 64 * Math.ceil((10 + header.length + 1) / 64) - 10;
  const start = new TextEncoder().encode(`\0NUMPY\x01\0\0\0${header.padEnd(length - 1)}\n`);
  start[0] = 0x93;
  start.set([length & 255, length >> 8], 8);
  const bytes = new Uint8Array(start.length + data.byteLength);
  bytes.set(start);
  bytes.set(new Uint8Array(data.buffer, data.byteOffset, data.byteLength), start.length);
  return bytes;
}
