"""Ways to find dots, side by side: accuracy on rendered cases with truth, and speed.

python -m bench.accuracy.locators CASES [--json FILE]

CASES as for accuracy.py. `fit` and `soft` are the package's locators; `threshold` is threshold, components and the nearest of
its size (thresholded_dots.py); `opencv` is SimpleBlobDetector with each dot taking the blob nearest to where it was at rest.
All measure displacements against their own rest image. Printed for each sensor and kind of image: median and 95th percentile
of the error in px over found visible dots, the share found, how many are over 3 px off; then the processor time of a frame in
ms on one thread, least of several turns, alone and in a batch of 16 (`threshold` and `opencv` take one frame after another).
"""

import argparse
import time
import warnings
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from bench.accuracy.accuracy import cases_in
from bench.accuracy.thresholded_dots import ThresholdedDots
from bench.data.record import write
from torchmembrane.markers.observer import FOUND_CONFIDENCE
from torchmembrane.reconstruct import Reconstructor

METHODS = ("fit", "soft", "threshold", "opencv")
BATCHES, TURNS = (1, 16), 5


class OpenCvDots:
    """Blobs of OpenCV's SimpleBlobDetector, each dot taking the one nearest to where it was at rest."""

    def __init__(self, rest_image, model_pixels, polarity):
        settings = cv2.SimpleBlobDetector_Params()
        settings.filterByColor, settings.blobColor = True, 0 if polarity == "dark" else 255
        settings.filterByArea, settings.minArea, settings.maxArea = True, 8, 2000
        settings.filterByCircularity = settings.filterByInertia = settings.filterByConvexity = False
        settings.minDistBetweenBlobs, settings.thresholdStep = 4, 5
        self.detector = cv2.SimpleBlobDetector_create(settings)
        self.reach = cKDTree(model_pixels).query(model_pixels, k=2)[0][:, 1] / 2
        self.rest = self.nearest(rest_image, model_pixels)

    def nearest(self, image, pixels):
        """The blobs `[D, 2]` nearest to `pixels [D, 2]`, NaN where there is none within half the spacing."""
        keypoints = self.detector.detect((255 * image).round().astype(np.uint8))
        if not keypoints:
            return np.full(pixels.shape, np.nan)
        blobs = np.array([point.pt for point in keypoints])
        gap, index = cKDTree(blobs).query(np.nan_to_num(pixels, nan=-1e3))
        return np.where((gap < self.reach)[:, None], blobs[index], np.nan)

    def __call__(self, image):
        """Displacements `[D, 2]`, NaN where lost."""
        return self.nearest(image, self.rest) - self.rest


class Package:
    """One of the package's locators."""

    def __init__(self, reconstructor):
        self.locate, self.rest = reconstructor.observer.locator, reconstructor.observer.measured_rest.double().numpy()

    def __call__(self, image):
        with torch.no_grad():
            pixels, confidence = (a[0].double().numpy() for a in self.locate(torch.from_numpy(image)[None, None])[:2])
        return np.where(confidence[:, None] > FOUND_CONFIDENCE, pixels - self.rest, np.nan)


def methods_of(sensor_file):
    """The four methods for a sensor, and its reconstructor."""
    fit, soft = (Reconstructor.from_file(sensor_file, "minimum-energy", locator=name) for name in METHODS[:2])
    markers, model = fit.sensor.markers, fit.rest_pixels.double().numpy()
    large = np.array([size == "large" for size in markers.sizes])
    threshold = ThresholdedDots(markers.rest_image, model, large, markers.polarity)
    opencv = OpenCvDots(markers.rest_image, model, markers.polarity)
    return dict(zip(METHODS, (Package(fit), Package(soft), threshold, opencv), strict=True)), fit


def milliseconds(method, image):
    """Processor time of a frame for each of `BATCHES`."""
    times = {}
    for batch in BATCHES:
        images = torch.from_numpy(image).expand(batch, 1, -1, -1).contiguous()

        def once(images=images):
            if isinstance(method, Package):
                with torch.no_grad():
                    method.locate(images)
            else:
                for each in images[:, 0].numpy():
                    method(each)

        once()
        turns = []
        for _ in range(TURNS):
            start = time.process_time()
            once()
            turns.append(1e3 * (time.process_time() - start) / len(images))
        times[batch] = min(turns)
    return times


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    errors, cases = {}, cases_in(args.cases)
    for name in sorted({case["sensor"] for case in cases}):
        methods, r = methods_of(args.cases / name)
        model = r.rest_pixels.double().numpy()
        for case in (c for c in cases if c["sensor"] == name):
            truth = np.load(args.cases / case["truth"])
            visible = truth["visible_deformed"].astype(bool) if "visible_deformed" in truth else np.ones(len(model), bool)
            for path in case["images"]:
                kind = Path(path).stem.rpartition("_")[2] if len(case["images"]) > 1 else "images"
                image = r.read(args.cases / path)[0, 0].numpy()
                for method, moved in ((key, locate(image)) for key, locate in methods.items()):
                    error = np.linalg.norm(model + moved - truth["uv_deformed"], axis=1)[visible]
                    errors.setdefault((case["folder"], kind, method), []).append(error)
                    errors.setdefault(("all", kind, method), []).append(error)
    rows = []
    for (folder, kind, method), parts in sorted(errors.items(), key=lambda item: (*item[0][:2], METHODS.index(item[0][2]))):
        error = np.concatenate(parts)
        found = error[np.isfinite(error)]
        row = dict(sensor=folder, images=kind, method=method, median=float(np.median(found)), found=len(found) / len(error))
        rows.append(row | dict(p95=float(np.percentile(found, 95)), wrong=int((found > 3).sum())))
        print(
            "{sensor:16s} {images:6s} {method:9s} median {median:.3f} px, 95 % {p95:.3f} px, found {found:.4f}, "
            "wrong {wrong}".format(**rows[-1])
        )
    times = {key: milliseconds(method, image) for key, method in methods.items()}
    for key, each in times.items():
        print(f"{key:9s} " + ", ".join(f"batch {batch}: {ms:.1f} ms per frame" for batch, ms in each.items()))
    write(args.json, dict(dots=rows, milliseconds=times))


if __name__ == "__main__":
    main()
