"""How noisy images are, by machine code: what `pixel_noise` does, without gradients; a test holds both to the same numbers."""

import numpy as np

from ..machine_code import Kept, fingerprint, kept


@kept
def noises(images, stride, exposed, cut, rounds, divisor, found):
    """`found [B]` of images `[B, H, W]`; the numbers as of `noise`."""
    height, width = images.shape[1:]
    sizes = np.empty(-(-(height - 2) // stride) * -(-(width - 2) // stride), images.dtype)
    for b in range(len(images)):
        count, limit, mean = 0, np.inf, 0.0
        for v in range(1, height - 1, stride):
            above, here, below = images[b, v - 1], images[b, v], images[b, v + 1]
            for u in range(1, width - 1, stride):
                if exposed[0] < here[u] < exposed[1]:
                    left, right = above[u - 1] + below[u - 1] - 2 * here[u - 1], above[u + 1] + below[u + 1] - 2 * here[u + 1]
                    sizes[count] = abs(left + right - 2 * (above[u] + below[u] - 2 * here[u]))
                    count += 1
        for _ in range(rounds):
            total, among = 0.0, 0
            for k in range(count):
                if sizes[k] <= limit:
                    total, among = total + sizes[k], among + 1
            mean = total / max(among, 1)
            limit = cut * mean
        found[b] = mean / divisor


kept_noises = Kept(noises, fingerprint(__file__), 2)
"""Whether `noises` has been compiled."""
