// What an image file holds, from its bytes: browsers show the first of several pictures, and eight of sixteen bits.
import { unzlibSync } from "fflate";

const FRAMES = new Set([0xc0, 0xc1, 0xc2, 0xc3, 0xc5, 0xc6, 0xc7, 0xc9, 0xca, 0xcb, 0xcd, 0xce, 0xcf]); // markers of a JPEG
const SCAN = 0xda;

/** How many pictures a PNG, GIF, WebP or JPEG holds; of a JPEG those of the first one's size, as others are its previews. */
export function picturesIn(bytes) {
  if (isPng(bytes)) {
    const animation = [...chunksOf(bytes)].find(({ type }) => type === "acTL");
    return animation ? viewOf(animation.data).getUint32(0) : 1;
  }
  if (text(bytes, 0, 3) === "GIF") return picturesInGif(bytes);
  if (text(bytes, 0, 4) === "RIFF") return Math.max(1, picturesInWebp(bytes));
  return isJpeg(bytes) ? picturesInJpeg(bytes) : 1;
}

/** Whether it is a TIFF, of which the browsers that read one take the first page, and 8 bits. */
export const isTiff = (bytes) => ["II*\0", "MM\0*", "II+\0", "MM\0+"].includes(text(bytes, 0, 4));

/** Width and height that a PNG or JPEG states; null of other files. */
export function sizeIn(bytes) {
  if (isPng(bytes) && bytes.length > 24) return [viewOf(bytes).getUint32(16), viewOf(bytes).getUint32(20)];
  return isJpeg(bytes) ? jpegSize(bytes) : null;
}

/** Bits of a value of a PNG, and whether it is grey without alpha; null of other files. */
export function depthIn(bytes) {
  return isPng(bytes) ? { bits: bytes[24], grey: bytes[25] === 0, interlaced: bytes[28] !== 0 } : null;
}

/** The bytes of a PNG without what turns it (eXIf), of a JPEG with that made unreadable: Python turns no picture. */
export function unturned(bytes) {
  if (isPng(bytes)) {
    const turning = [...chunksOf(bytes)].filter(({ type }) => type === "eXIf");
    const kept = [0, ...turning.flatMap(({ begin, end }) => [begin, end]), bytes.length];
    return turning.length ? joined(kept.flatMap((from, k) => (k % 2 ? [] : [bytes.subarray(from, kept[k + 1])]))) : bytes;
  }
  const start = text(bytes, 0, 1 << 16).indexOf("Exif\0\0");
  if (isJpeg(bytes) && start > 0) bytes[start] = 0;
  return bytes;
}

/** The values of a grey PNG of 16 bits, not interlaced; `Uint16Array`, row by row. */
export function valuesOf16(bytes) {
  const [width, height] = sizeIn(bytes);
  const stored = unzlibSync(joined([...chunksOf(bytes)].filter(({ type }) => type === "IDAT").map(({ data }) => data)));
  const length = 2 * width;
  if (stored.length < (length + 1) * height) throw new Error("it ends before its last pixel");
  let before = new Uint8Array(length);
  const values = new Uint16Array(width * height);
  for (let row = 0; row < height; row++) {
    const line = stored.subarray(row * (length + 1) + 1, (row + 1) * (length + 1));
    unfilter(stored[row * (length + 1)], line, before);
    for (let k = 0; k < width; k++) values[row * width + k] = (line[2 * k] << 8) | line[2 * k + 1];
    before = line;
  }
  return values;
}

/** Undoes a row's filter in place; `before` is the row above. PNG, second edition, 9.2. */
function unfilter(kind, line, before) {
  const predicted = [
    () => 0,
    (left) => left,
    (left, above) => above,
    (left, above) => (left + above) >> 1,
    (left, above, corner) => {
      const [a, b, c] = [above - corner, left - corner, left + above - 2 * corner].map(Math.abs);
      return a <= b && a <= c ? left : b <= c ? above : corner;
    },
  ][kind];
  if (!predicted) throw new Error(`its filter ${kind} is none`);
  for (let k = 0; k < line.length; k++) line[k] += predicted(k < 2 ? 0 : line[k - 2], before[k], k < 2 ? 0 : before[k - 2]);
}

const isPng = (bytes) => text(bytes, 1, 3) === "PNG";
const isJpeg = (bytes) => bytes[0] === 0xff && bytes[1] === 0xd8;
const viewOf = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
const text = (bytes, at, length) => new TextDecoder("latin1").decode(bytes.subarray(at, at + length));

function* chunksOf(png) {
  for (let begin = 8; begin + 12 <= png.length; ) {
    const length = viewOf(png).getUint32(begin);
    const end = begin + 12 + length;
    yield { type: text(png, begin + 4, 4), data: png.subarray(begin + 8, end - 4), begin, end: Math.min(end, png.length) };
    begin = end;
  }
}

function joined(parts) {
  const whole = new Uint8Array(parts.reduce((length, part) => length + part.length, 0));
  parts.reduce((at, part) => (whole.set(part, at), at + part.length), 0);
  return whole;
}

function picturesInGif(bytes) {
  const colours = (flags) => (flags & 0x80 ? 3 << ((flags & 7) + 1) : 0);
  const pastBlocks = (at) => {
    while (bytes[at]) at += bytes[at] + 1;
    return at + 1;
  };
  let [at, pictures] = [13 + colours(bytes[10]), 0];
  while (at < bytes.length) {
    if (bytes[at] === 0x21) at = pastBlocks(at + 2);
    else if (bytes[at] === 0x2c) {
      pictures++;
      at = pastBlocks(at + 11 + colours(bytes[at + 9]));
    } else break;
  }
  return pictures;
}

function picturesInWebp(bytes) {
  let pictures = 0;
  for (let at = 12; at + 8 <= bytes.length; ) {
    pictures += text(bytes, at, 4) === "ANMF";
    const length = viewOf(bytes).getUint32(at + 4, true);
    at += 8 + length + (length % 2);
  }
  return pictures;
}

/** Segments of a JPEG before its first scan: marker, where they begin and where their data do. */
function* segmentsOf(jpeg, at = 0) {
  for (at += 2; at + 4 <= jpeg.length && jpeg[at] === 0xff && jpeg[at + 1] !== SCAN; ) {
    if (jpeg[at + 1] === 0xff) at++; // fill
    else {
      yield { marker: jpeg[at + 1], data: at + 4 };
      at += 2 + viewOf(jpeg).getUint16(at + 2);
    }
  }
}

function jpegSize(jpeg, at = 0) {
  const view = viewOf(jpeg);
  for (const { marker, data } of segmentsOf(jpeg, at)) {
    if (FRAMES.has(marker) && data + 5 <= jpeg.length) return [view.getUint16(data + 3), view.getUint16(data + 1)];
  }
  return null;
}

/** The pictures that the list of an MPO (CIPA DC-007, tag 0xB002) leads to, of the first one's size. */
function picturesInJpeg(bytes) {
  const list = [...segmentsOf(bytes)].find(({ marker, data }) => marker === 0xe2 && text(bytes, data, 4) === "MPF\0");
  const size = jpegSize(bytes)?.join();
  if (!list || !size) return 1;
  try {
    const [view, begin] = [viewOf(bytes), list.data + 4];
    const little = text(bytes, begin, 2) === "II";
    const directory = begin + view.getUint32(begin + 4, little);
    const rows = Array.from({ length: view.getUint16(directory, little) }, (_, k) => directory + 2 + 12 * k);
    const row = rows.find((at) => view.getUint16(at, little) === 0xb002);
    const [count, entries] = [view.getUint32(row + 4, little) / 16, begin + view.getUint32(row + 8, little)];
    const offsets = Array.from({ length: count - 1 }, (_, k) => view.getUint32(entries + 16 * (k + 1) + 8, little));
    return 1 + offsets.filter((offset) => jpegSize(bytes, begin + offset)?.join() === size).length;
  } catch {
    throw new Error("the list of its pictures is damaged");
  }
}
