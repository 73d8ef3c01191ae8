// Image files as grey values, the same as Python reads.
import { depthIn, isTiff, picturesIn, sizeIn, unturned, valuesOf16 } from "./file.js";

/**
 * An image file of the sensor's `size` [width, height]: `pixels` as stored, without colour management or rotation, an
 * `ImageData`, and `grey` [width * height] in 0..1, of 16-bit grey by all bits; `bits` of the camera, where these hold fewer.
 * Not as Python reads them: colour of 16 bits arrives as 8.
 */
export async function imageOf(file, size, bits) {
  const bytes = new Uint8Array(await file.arrayBuffer());
  if (isTiff(bytes)) throw new Error("not readable as an image (a TIFF); expected a whole PNG or JPEG");
  refuseSize(sizeIn(bytes), size); // before pixels are decoded
  const pictures = picturesIn(bytes);
  if (pictures > 1) throw new Error(`the file holds ${pictures} pictures; expected one: save each as a file of its own`);
  const depth = depthIn(bytes);
  const deep = depth?.bits === 16 && depth.grey && !depth.interlaced;
  if (bits && depth?.bits === 16 && !deep) {
    throw new Error(`colour, alpha or interlacing of 16 bits is read as 8 bits; expected plain grey, of ${bits} bits in 16`);
  }
  const pixels = await pixelsOf(unturned(bytes), size);
  return { pixels, grey: deep ? greyOf16(valuesOf16(bytes), bits) : greyOf(pixels.data) };
}

/** Grey values in 0..1 of RGBA bytes: 0.299 R + 0.587 G + 0.114 B. */
export function greyOf(rgba) {
  return Float32Array.from({ length: rgba.length / 4 }, (_, k) => {
    return (0.299 * rgba[4 * k] + 0.587 * rgba[4 * k + 1] + 0.114 * rgba[4 * k + 2]) / 255;
  });
}

/** Grey values in 0..1 of values of 16 bits, of which the camera fills `bits`. */
export function greyOf16(values, bits = 16) {
  const white = 2 ** bits - 1;
  const most = values.reduce((high, value) => Math.max(high, value), 0);
  if (most > white) {
    throw new Error(`values up to ${most}; expected at most ${white} for the ${bits} bits that the model states`);
  }
  return Float32Array.from(values, (value) => value / white);
}

async function pixelsOf(bytes, size) {
  let bitmap;
  try {
    bitmap = await createImageBitmap(new Blob([bytes]), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  } catch {
    throw new Error("not readable as an image; expected a whole PNG or JPEG");
  }
  refuseSize([bitmap.width, bitmap.height], size);
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  const pixels = context.getImageData(0, 0, bitmap.width, bitmap.height);
  if (pixels.data.some((value, k) => k % 4 === 3 && value < 255)) {
    throw new Error("the image has transparent pixels; expected an opaque one");
  }
  return pixels;
}

function refuseSize(came, [width, height]) {
  if (came && (came[0] !== width || came[1] !== height)) {
    const said = `the image is ${came[0]} x ${came[1]} px, expected ${width} x ${height}`;
    throw new Error(`${said}: use images of this sensor's camera`);
  }
}
