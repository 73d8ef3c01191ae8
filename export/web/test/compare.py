"""Print as JSON how far two results of one image differ: python export/web/test/compare.py SAVED.npz EXPECTED.npz."""

import json
import sys

import numpy as np

saved, expected = (dict(np.load(path)) for path in sys.argv[1:])
force = np.linalg.norm(expected["force"])
differences = {
    "status": [int(saved["status"]), int(expected["status"])],
    "arrays": {key: (str(array.dtype), array.shape) for key, array in sorted(saved.items())},
    "expected": {key: (str(array.dtype), array.shape) for key, array in sorted(expected.items())},
    "finite": bool(np.isfinite(saved["vertices"]).all()),
    "vertices": float(np.abs(saved["vertices"] - expected["vertices"]).max()),
    "force": float(np.linalg.norm(saved["force"] - expected["force"]) / force),
}
print(json.dumps(differences).replace("NaN", "null"))
