"""What tests of LoMa share: all intermediate values of its networks, batched, by the golden files' names."""

import torch
from golden import recorded

from mkpc_kaggle.matchers.networks.layers import mutual_matches
from mkpc_kaggle.matchers.networks.loma_matcher import LAYERS, log_scores


def refined(decoder, levels):
    """The values of every refiner, and the prediction after each but the last."""
    values, prediction, context = {}, None, None
    for stride in decoder.layers:
        refiner, features = decoder.at(stride), levels.pop()
        mixed = refiner.mixed(refiner.entry(features), context)
        outputs = refiner.outputs(refiner.hidden(mixed))
        values[f"block1_{stride}"] = mixed
        values[f"delta_{stride}"] = outputs[:, : decoder.prediction]
        values[f"context_{stride}"] = outputs[:, decoder.prediction :]
        if stride != "1":
            prediction, context = decoder.refined(int(stride), refiner.entry(features), prediction, context)
            values[f"answer_{stride}"] = prediction
    return values


def encoded(levels, strides):
    return {f"encoder_{stride}": level for stride, level in zip(strides, levels, strict=True)}


@torch.inference_mode()
def detector_values(detector, images, number):
    logits = detector.logits(images)
    levels = list(detector.levels(images))
    values = encoded(levels, (1, 2, 4, 8)) | refined(detector.decoder, levels)
    found = detector(images, number)
    return values | {
        "score_map": logits,
        "dense_probs": logits.flatten(1).softmax(dim=1).view_as(logits),
        "keypoints": torch.stack([each.points for each in found]),
        "keypoint_probs": torch.stack([each.scores for each in found]),
    }


def features_of(encoder, images):
    """The encoder's values, those of its vision transformer included if it has one, and its levels."""
    if not hasattr(encoder, "frozen_dinov2"):
        levels = list(encoder.levels(images))
        return encoded(levels, (1, 2, 4, 8)), levels
    last = len(encoder.frozen_dinov2["dinov2_vitl14"].blocks)
    blocks = {
        number: f"frozen_dinov2.dinov2_vitl14.blocks.{number - 1}" for number in (1, 2, 12, 24) if number <= last
    }
    with recorded(encoder, blocks.values()) as calls:
        levels = list(encoder.levels(images))
    values = {"vit_tokens": calls[blocks[1]][0][0][0]}
    values |= {f"vit_block{number}": calls[block][0][1] for number, block in blocks.items()}
    return values | encoded(levels, (1, 2, 4, 8, 14)), levels


@torch.inference_mode()
def descriptor_values(descriptor, images, points):
    values, levels = features_of(descriptor.encoder, images)
    values |= refined(descriptor.decoder, levels)
    height, width = images.shape[2:]
    rows, columns = ((2 * torch.arange(side) + 1) / side - 1 for side in (height, width))
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=2).view(1, -1, 2)
    dense = descriptor(images, pixels.expand(len(images), -1, -1))
    return values | {
        "dense_descriptors": dense.mT.unflatten(2, (height, width)),
        "descriptors": descriptor(images, points),
    }


@torch.inference_mode()
def matcher_values(matcher, image0, image1, threshold):
    """Of a single pair, as a batch of one."""
    names = ["input_proj", "transformers.0.self_attn", *(f"transformers.{index}" for index in (0, 4, 8))]
    assignment = f"log_assignment.{LAYERS - 1}.final_proj"
    with recorded(matcher, ["posenc", *names, assignment]) as calls:
        matcher(image0, image1, threshold)
    n0 = len(image0.points)
    rotation = calls["posenc"][0][1][:, 0, :n0].repeat_interleave(2, dim=2)
    values = {"rotary_cos0": rotation.real, "rotary_sin0": rotation.imag}
    files = ["input_proj", "layer1_self", "layer1", "layer5", "layer9", "final_proj"]
    for name, call in zip(files, [*names, assignment], strict=True):
        output = calls[call][0][1]
        values |= {f"{name}_0": output[:, :n0], f"{name}_1": output[:, n0:]}
    similarity = matcher.similarity(calls[f"transformers.{LAYERS - 1}"][0][1], n0)
    scores = log_scores(similarity)
    values |= {"similarity": similarity, "scores": scores.exp()}
    return values | assignment_values(scores[0], threshold)


def assignment_values(log_scores, threshold, suffix=""):
    """By keypoint of either image, as a batch of one: its match, and the score of any mutual pair."""
    found, every, values = mutual_matches(log_scores, threshold), mutual_matches(log_scores, 0), {}
    for side, count in enumerate(log_scores.shape):
        matches, scores = torch.full((1, count), -1), torch.zeros(1, count)
        matches[0, (found.index0, found.index1)[side]] = (found.index1, found.index0)[side]
        scores[0, (every.index0, every.index1)[side]] = every.scores
        values |= {f"matches{side}{suffix}": matches, f"matching_scores{side}": scores}
    return values
