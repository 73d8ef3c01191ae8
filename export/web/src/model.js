// A model, what it says of its sensor, and images to results.
import { sensorOf } from "./metadata.js";

export class Model {
  #worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });

  /** The model of a .onnx file's bytes, ready to run; `sensor` as `sensorOf`; `tracks`: a frame starts from the one before. */
  static async open(bytes) {
    const model = new Model();
    try {
      model.sensor = sensorOf(bytes);
      const [width, height] = model.sensor.imageSize;
      model.tracks = (await model.#ask({ model: { bytes, width, height } })).tracks;
    } catch (error) {
      model.close();
      throw error;
    }
    return model;
  }

  /** The result of an image's grey values [width * height]: `frame`, the outputs by name, and `milliseconds`. */
  run(grey) {
    const [width, height] = this.sensor.imageSize;
    return this.#ask({ image: { grey, width, height } });
  }

  /** What a status says, also one that the model has no text for. */
  statusText(code) {
    return this.sensor.statusTexts[code] ?? `status ${code}`;
  }

  /** The next frame starts from rest. */
  forget() {
    return this.#ask({});
  }

  close() {
    this.#worker.terminate();
  }

  #ask(message) {
    return new Promise((resolve, reject) => {
      this.#worker.onmessage = ({ data }) => ("error" in data ? reject(new Error(data.error)) : resolve(data.answer));
      this.#worker.onerror = () => reject(new Error("onnxruntime could not be started; serve the page, do not open it as a file"));
      this.#worker.postMessage(message);
    });
  }
}
