"""A custom matcher: ORB with OpenCV. Copy this file and change the class.

``python own_matcher.py a.jpg b.jpg`` matches two images with it.
"""

import sys

import cv2

from mkpc_kaggle import (
    Colour,
    MatcherSpec,
    Matches,
    PairwiseMatcher,
    Recipe,
    TwoStageMatcher,
    Unit,
)

# Results are kept for later runs under the version: change it whenever equal pictures get other points. (For a
# file in the package's `matchers/adapters/`, increase `POINTS_VERSION` of `engine/keys.py` instead.)
SPEC = MatcherSpec("orb", colour=Colour.GRAY, version="1", packages=("opencv",))


class OrbMatcher(PairwiseMatcher):
    """ORB keypoints, matched by mutual nearest neighbours."""

    spec = SPEC

    def encode(self, pictures):
        """Return points and descriptors of each picture. They are cached for its other pairs."""
        orb = cv2.ORB_create(4000)
        found = [orb.detectAndCompute(picture.pixels, None) for picture in pictures]
        # Arrays, whose bytes the cache can count
        return [(cv2.KeyPoint.convert(keypoints), features) for keypoints, features in found]

    def _match(self, first, second):
        """Return the matches of two encodings, in pixels of the two pictures."""
        points0, descriptors0 = first
        points1, descriptors1 = second
        # OpenCV has no descriptors, instead of an empty array, for a picture without keypoints.
        if descriptors0 is None or descriptors1 is None:
            return Matches.empty()
        neighbours = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        pairs = neighbours.match(descriptors0, descriptors1)
        index0 = [pair.queryIdx for pair in pairs]
        index1 = [pair.trainIdx for pair in pairs]
        scores = [1 - pair.distance / 256 for pair in pairs]  # 256 bits; higher is better
        return Matches(points0[index0], points1[index1], scores)


def load(weights, options, placement):
    """Return the matcher: used only in ``mkpc_kaggle/matchers/adapters/``.

    ``matchers/registry.py`` names the file, which must define ``SPEC`` and this function. ``options`` is an
    instance of the frozen dataclass ``SPEC.options``, and ``SPEC.slots`` names the weights.
    A network reads its tensors with ``weights.load("slot")`` and moves to ``placement.device``.
    """
    return OrbMatcher()


if __name__ == "__main__":
    recipe = Recipe([Unit(1, "orb", 1024), Unit(2, "orb", 1024)])
    matcher = TwoStageMatcher(recipe, matchers={"orb": OrbMatcher()})
    match = matcher(sys.argv[1], sys.argv[2])
    print(f"{match.estimate.inlier_count} inliers")
    print(match.estimate.matrix)
