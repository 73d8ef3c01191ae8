// Image files as grey values, the same as Python reads.

/**
 * The pixels of an image file as stored, without colour management or EXIF rotation; an `ImageData`.
 * Not as Python reads them: 16 bits arrive as 8, and a PNG's eXIf rotation (rare) is applied.
 */
export async function pixelsOf(file) {
  const bytes = unturned(new Uint8Array(await file.arrayBuffer()));
  let bitmap;
  try {
    bitmap = await createImageBitmap(new Blob([bytes]), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  } catch {
    throw new Error("not readable as an image; expected a PNG or JPEG");
  }
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  const pixels = context.getImageData(0, 0, bitmap.width, bitmap.height);
  if (pixels.data.some((value, k) => k % 4 === 3 && value < 255)) {
    throw new Error("the image has transparent pixels; expected an opaque one");
  }
  return pixels;
}

/** Grey values in 0..1 of RGBA bytes: 0.299 R + 0.587 G + 0.114 B. */
export function greyOf(rgba) {
  return Float32Array.from({ length: rgba.length / 4 }, (_, k) => {
    return (0.299 * rgba[4 * k] + 0.587 * rgba[4 * k + 1] + 0.114 * rgba[4 * k + 2]) / 255;
  });
}

/** A JPEG's bytes with the EXIF segment made unreadable: browsers offer no other way to leave its rotation out. */
function unturned(bytes) {
  const jpeg = bytes[0] === 0xff && bytes[1] === 0xd8;
  const start = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 16)).indexOf("Exif\0\0");
  if (jpeg && start > 0) bytes[start] = 0;
  return bytes;
}
