"""From a rendered view to a photograph: exposure, colour, vignette, a little blur and noise."""

import cv2
import numpy as np

from mkpc_kaggle.demo.texture import FloatImage, Picture


def develop(image: FloatImage, rng: np.random.Generator) -> Picture:
    """(H, W, 3) float32 in 0..255 to uint8, with random camera settings.

    The geometry of the picture does not change.
    """
    height, width = image.shape[:2]
    gain = 2.0 ** rng.uniform(-0.4, 0.3)
    balance = rng.uniform(0.93, 1.07, 3).astype(np.float32)
    gamma = np.float32(rng.uniform(0.85, 1.2))
    light = np.clip(image * (balance * np.float32(gain / 255)), 0, 1) ** gamma
    x = np.linspace(-1, 1, width, dtype=np.float32)[None, :]
    y = np.linspace(-1, 1, height, dtype=np.float32)[:, None]
    light *= (1 - np.float32(rng.uniform(0.03, 0.12)) * (x * x + y * y))[..., None]
    light = np.asarray(cv2.GaussianBlur(light, (5, 5), float(rng.uniform(0.3, 0.7))), dtype=np.float32)
    noise = np.float32(rng.uniform(0.006, 0.016)) * rng.standard_normal(light.shape, dtype=np.float32)
    light += noise * np.sqrt(light + np.float32(0.1))
    return np.asarray(np.clip(light * 255 + 0.5, 0, 255), dtype=np.uint8)
