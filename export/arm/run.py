"""Run images through a model with the edge package, and write all outputs to one file.

python run.py FOLDER_OF_torchmembrane_edge MODEL.onnx IMAGES.npy OUT.npz [FOLDER_OF_PACKAGES]
"""

import platform
import sys
import time

edge, model, images, out, *site = sys.argv[1:]
sys.path[:0] = [edge, *site]

import numpy as np  # noqa: E402
import onnxruntime  # noqa: E402
from torchmembrane_edge import Session  # noqa: E402

session, frames = Session(model), np.load(images)
start = time.perf_counter()
results = [session.run(frame) for frame in frames]
seconds = (time.perf_counter() - start) / len(frames)
np.savez(out, **{name: np.concatenate([result[name] for result in results]) for name in results[0]})
print(f"{platform.machine()}, onnxruntime {onnxruntime.__version__}: {len(frames)} frames, {seconds:.2f} s each", flush=True)
