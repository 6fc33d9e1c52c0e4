"""What tests of LoMa share: the results of its networks, batched, by the golden files' names."""

import torch
from golden import recorded

from mkpc_kaggle.matchers.networks.layers import mutual_matches
from mkpc_kaggle.matchers.networks.loma_matcher import LAYERS, log_scores


@torch.inference_mode()
def detector_values(detector, images, number):
    logits, found = detector.logits(images), detector(images, number)
    return {
        "score_map": logits,
        "dense_probs": logits.flatten(1).softmax(dim=1).view_as(logits),
        "keypoints": torch.stack([each.points for each in found]),
        "keypoint_probs": torch.stack([each.scores for each in found]),
    }


@torch.inference_mode()
def descriptor_values(descriptor, images, points):
    """At the points, and at every third pixel of the images."""
    height, width = images.shape[2:]
    rows, columns = ((2 * torch.arange(side) + 1) / side - 1 for side in (height, width))
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=2)[::3, ::3]
    dense = descriptor(images, pixels.reshape(1, -1, 2).expand(len(images), -1, -1))
    return {
        "dense_descriptors": dense.mT.unflatten(2, pixels.shape[:2])[:, ::32],
        "descriptors": descriptor(images, points),
    }


@torch.inference_mode()
def matcher_values(matcher, image0, image1, threshold):
    """Of a single pair, as a batch of one."""
    last = f"transformers.{LAYERS - 1}"
    with recorded(matcher, [last]) as calls:
        matcher(image0, image1, threshold)
    similarity = matcher.similarity(calls[last][0][1], len(image0.points))
    scores = log_scores(similarity)
    return {"similarity": similarity, "scores": scores.exp()} | assignment_values(scores[0], threshold)


def assignment_values(log_scores, threshold, suffix=""):
    """By keypoint of either image, as a batch of one: its match, and the score of any mutual pair."""
    found, every, values = mutual_matches(log_scores, threshold), mutual_matches(log_scores, 0), {}
    for side, count in enumerate(log_scores.shape):
        matches, scores = torch.full((1, count), -1), torch.zeros(1, count)
        matches[0, (found.index0, found.index1)[side]] = (found.index1, found.index0)[side]
        scores[0, (every.index0, every.index1)[side]] = every.scores
        values |= {f"matches{side}{suffix}": matches, f"matching_scores{side}": scores}
    return values
