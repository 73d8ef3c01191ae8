// The built page in headless Chromium against Python: node --test; the Makefile's test-web sets CHROMIUM, PYTHON, REFERENCE.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { basename, join } from "node:path";
import { after, afterEach, before, test } from "node:test";
import { fileURLToPath } from "node:url";
import { context } from "esbuild";
import { chromium } from "playwright-core";
import { greyOf } from "../src/image.js";

const { CHROMIUM, PYTHON, REFERENCE, TRACKING, SCREENSHOTS } = process.env;
const EXAMPLES = { "Two contacts": "two_contacts", "Press on axis": "press_on_axis", "Flat plate": "flat_plate" };
const FLAGS =
  "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking " +
  "--disable-component-update --disable-sync --use-angle=swiftshader --enable-unsafe-swiftshader";
const WIDE = { width: 1280, height: 800 };
const here = fileURLToPath(new URL(".", import.meta.url));
const reference = (name) => join(REFERENCE, name);
const [errors, elsewhere] = [[], []];
let server, browser, origin, page;

before(async () => {
  server = await context({});
  const { port } = await server.serve({ host: "127.0.0.1", servedir: join(here, "../dist") });
  origin = `http://127.0.0.1:${port}`;
  browser = await chromium.launch({ executablePath: CHROMIUM, args: FLAGS.split(" ") });
  page = await browser.newPage({ viewport: WIDE });
  page.setDefaultTimeout(20_000);
  page.on("console", (message) => message.type() === "error" && errors.push(message.text()));
  page.on("pageerror", (error) => errors.push(error.message));
  page.on("request", (request) => new URL(request.url()).origin === origin || elsewhere.push(request.url()));
  await page.goto(origin);
  await idle();
});

afterEach(() => assert.deepEqual({ errors, elsewhere }, { errors: [], elsewhere: [] }));

after(async () => {
  await browser?.close();
  await server?.dispose();
});

const text = (selector) => page.locator(selector).innerText();
const idle = () => page.locator('body[aria-busy="false"]').waitFor({ timeout: 120_000 });

async function example(title) {
  await page.getByRole("button", { name: title }).click();
  await idle();
}

/** Files dropped onto the page, as from a file manager. */
async function drop(...paths) {
  const files = paths.map((path) => [basename(path), readFileSync(path).toString("base64")]);
  await page.evaluate((files) => {
    const transfer = new DataTransfer();
    for (const [name, content] of files) {
      transfer.items.add(new File([Uint8Array.from(atob(content), (byte) => byte.charCodeAt())], name));
    }
    dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, cancelable: true }));
  }, files);
  await idle();
}

/** The result that the page saves, compared with Python's. */
async function compared(name, expected = name) {
  const [download] = await Promise.all([page.waitForEvent("download"), page.getByRole("button", { name: "Save result" }).click()]);
  assert.equal(download.suggestedFilename(), `${name}.npz`);
  const saved = reference(`saved_${name}.npz`);
  await download.saveAs(saved);
  return JSON.parse(execFileSync(PYTHON, [join(here, "compare.py"), saved, reference(`${expected}.npz`)]));
}

function agree({ status, arrays, expected, vertices, force }) {
  assert.equal(status[0], status[1]);
  assert.deepEqual(arrays, expected);
  assert.ok(vertices <= 1e-3, `vertices differ by ${vertices} mm`);
  assert.ok(force <= 1e-3, `forces differ by ${force} of the force`);
}

/** How many colours a picture of the surface's canvas has, below what may be written over it. */
async function coloursShown() {
  const { x, y, width, height } = await page.locator("#surface").boundingBox();
  const clip = { x, y: y + height / 2, width, height: height / 2 };
  const picture = (await page.screenshot({ clip })).toString("base64");
  return page.evaluate(async (picture) => {
    const bitmap = await createImageBitmap(new Blob([Uint8Array.from(atob(picture), (byte) => byte.charCodeAt())]));
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
    context.drawImage(bitmap, 0, 0);
    return new Set(new Uint32Array(context.getImageData(0, 0, bitmap.width, bitmap.height).data.buffer)).size;
  }, picture);
}

const picture = async () => (await page.locator("#surface").screenshot()).toString("base64");

test("loads the model, without an error and from its own server alone", async () => {
  assert.equal(await text("#status"), "ready for an image");
  assert.equal(await text("#sensor"), "finger_fisheye_nh130");
});

for (const [title, name] of Object.entries(EXAMPLES)) {
  test(`example ${name}: the same surface and force as Python`, async (t) => {
    await example(title);
    const differences = await compared(name);
    t.diagnostic(`vertices within ${differences.vertices.toExponential(1)} mm, ${await text("#time")} a frame`);
    agree(differences);
    assert.equal(await text("#status"), "ok");
    assert.match(await text("#time"), /^\d+ ms$/);
  });
}

test("the surface turns by itself, by keys, and stands still", async () => {
  await example("Two contacts");
  const first = await picture();
  await page.waitForTimeout(200);
  assert.notEqual(await picture(), first);
  await page.getByLabel("turn", { exact: true }).uncheck();
  await page.locator("#surface").press("ArrowLeft"); // also gives it the focus, which is drawn
  const still = await picture();
  await page.waitForTimeout(200);
  assert.equal(await picture(), still);
  await page.locator("#surface").press("ArrowLeft");
  assert.notEqual(await picture(), still);
});

test("an image of another size is refused in words, and what was shown stays", async () => {
  await example("Two contacts");
  await drop(reference("narrow.png"));
  assert.equal(await text("#message"), "narrow.png: the image is 320 x 480 px, expected 640 x 480: use images of this sensor's camera");
  agree(await compared("two_contacts"));
  await example("Flat plate");
  assert.equal(await page.locator("#message").isHidden(), true);
});

test("a blank image has a status and no surface", async () => {
  await example("Two contacts");
  assert.ok((await coloursShown()) > 100);
  await drop(reference("blank.png"));
  assert.equal(await text("#status"), "blank or saturated image: no contrast; no surface");
  assert.equal(await page.getByText("No surface for this image").isVisible(), true);
  assert.equal(await coloursShown(), 1);
  const { status, finite } = await compared("blank");
  assert.deepEqual({ status, finite }, { status: [status[1], status[1]], finite: false });
  assert.equal(await text("#force"), "–");
});

test("of a file of several pictures none is taken for all", async () => {
  await example("Two contacts");
  for (const name of ["sequence.png", "sequence.gif", "sequence.webp", "sequence.jpg"]) {
    await drop(reference(name));
    assert.equal(await text("#message"), `${name}: the file holds 3 pictures; expected one: save each as a file of its own`);
  }
  await drop(reference("preview.jpg"));
  assert.equal(await page.locator("#message").isHidden(), true);
  assert.equal(await text("#name"), "preview.jpg");
});

test("what is no image, or too large, is refused in words", async () => {
  await example("Two contacts");
  for (const name of ["text.png", "empty.png", "cut.png"]) {
    await drop(reference(name));
    assert.equal(await text("#message"), `${name}: not readable as an image; expected a whole PNG or JPEG`);
  }
  for (const [name, side] of [["huge.png", 20000], ["huge.jpg", 20000]]) {
    await drop(reference(name));
    assert.match(await text("#message"), new RegExp(`${name}: the image is ${side} x ${side} px, expected 640 x 480`));
  }
  agree(await compared("two_contacts"));
});

test("grey of 16 bits is read as it is, also of a camera of fewer", async () => {
  const cases = [["another.onnx", "sixteen.png"], ["twelve.onnx", "twelve.png"]];
  for (const [model, image] of cases) {
    await drop(reference(model), reference(image));
    assert.equal(await page.locator("#message").isHidden(), true);
    const { vertices, force } = await compared(image.replace(".png", ""), "two_contacts");
    assert.ok(vertices <= 2e-3 && force <= 2e-3, `${image}: vertices differ by ${vertices} mm, forces by ${force}`);
  }
  await drop(reference("sixteen.png"));
  assert.match(await text("#message"), /sixteen.png: values up to \d+; expected at most 4095 for the 12 bits that the model states/);
  await drop(reference("colour_16.png"));
  assert.match(await text("#message"), /colour_16.png: colour, alpha or interlacing of 16 bits is read as 8 bits/);
  await page.reload();
  await idle();
});

test("pixels are those that Python reads", async () => {
  for (const name of ["linear.png", "colour.png", "upside_down.jpg", "upside_down.png"]) {
    await page.locator("#pick-image").setInputFiles(reference(name));
    await idle();
    assert.equal(await text("#name"), name);
    const shown = await page.locator("#image").evaluate((canvas) => {
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      return btoa(Array.from(data, (byte) => String.fromCharCode(byte)).join(""));
    });
    const bytes = readFileSync(reference(`${name}.f32`));
    const expected = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.length / 4);
    assert.ok(greyOf(Buffer.from(shown, "base64")).every((value, k) => Math.abs(value - expected[k]) < 1e-6), name);
  }
  await drop(reference("transparent.png"));
  assert.match(await text("#message"), /transparent pixels; expected an opaque one/);
});

test("where less motion is wanted the surface stands still", async () => {
  await page.emulateMedia({ reducedMotion: "reduce" });
  await page.reload();
  await idle();
  await example("Two contacts");
  const still = await picture();
  await page.waitForTimeout(200);
  assert.equal(await picture(), still);
});

test("time per frame", async (t) => {
  const times = [];
  for (let k = 0; k < 11; k++) {
    await example("Two contacts");
    times.push(parseFloat(await text("#time")));
  }
  t.diagnostic(`median of 11: ${times.sort((a, b) => a - b)[5]} ms, best ${times[0]} ms`);
  await page.getByLabel("turn", { exact: true }).check();
  if (SCREENSHOTS) await page.screenshot({ path: join(SCREENSHOTS, "browser.png") });
});

test("a narrow screen needs no scrolling sideways", async () => {
  await page.setViewportSize({ width: 400, height: 800 });
  await example("Two contacts");
  assert.equal(await page.evaluate(() => document.documentElement.scrollWidth), 400);
  if (SCREENSHOTS) await page.screenshot({ path: join(SCREENSHOTS, "browser_narrow.png"), fullPage: true });
  await page.setViewportSize(WIDE);
});

test("another model takes its place, what is none is refused in words", async () => {
  await drop(reference("foreign.onnx"));
  assert.match(await text("#message"), /foreign.onnx: not a model of format 1 from "torchmembrane export"/);
  assert.equal(await text("#sensor"), "finger_fisheye_nh130");
  for (const [name, said] of Object.entries({
    "no_mesh.onnx": "its metadata lack mesh",
    "no_size.onnx": "its metadata are damaged (image_size)",
    "no_part.onnx": "its metadata are damaged (image_part)",
    "apart.onnx": "it takes an image for each of the views left, right",
    "no_vertices.onnx": "its metadata are damaged (rest_vertices)",
    "no_texts.onnx": "its metadata are damaged (status_texts)",
    "cut.onnx": "onnxruntime cannot load it",
    "text.onnx": "not readable as an ONNX model",
    "empty.onnx": "not a model of format 1",
  })) {
    await drop(reference(name));
    assert.ok((await text("#message")).startsWith(`${name}: ${said}`), await text("#message"));
    assert.doesNotMatch(await text("#status"), /loading/);
    assert.equal(await text("#sensor"), "finger_fisheye_nh130");
  }
  await drop(reference("another.onnx"), reference("blank.png"));
  assert.equal(await text("#sensor"), "another sensor");
  assert.equal(await text("#name"), "blank.png");
});

test("a model of views that share an image takes the whole image", async () => {
  await drop(reference("regions.onnx"), "examples/two_contacts.png");
  assert.equal(await page.locator("#message").isHidden(), true);
  assert.equal(await text("#sensor"), "two views");
  agree(await compared("two_contacts"));
});

test("a model that tracks starts a frame from the one before, and from rest when told", async () => {
  const images = Object.values(EXAMPLES).map((name) => `examples/${name}.png`);
  await drop(TRACKING);
  assert.equal(await text("#status"), "ready for a video's images");
  for (const round of [1, 2]) {
    for (const [place, image] of images.toSorted().entries()) {
      await drop(image);
      agree(await compared(basename(image, ".png"), `tracked_${place}`));
    }
    await page.getByRole("button", { name: "Next from rest" }).click();
    await idle();
  }
  await drop(...images.toReversed()); // in the order of their names
  agree(await compared("two_contacts", "tracked_2"));
  await drop(reference("another.onnx"));
  assert.equal(await page.locator("#forget").isHidden(), true);
});
