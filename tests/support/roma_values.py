"""All intermediate values of RoMa on the way to a pair's match, by the names of the golden files."""

import torch
from dense import joined, one_thread, recorded_refinement, refiner_values, side_by_side
from golden import recorded

from mkpc_kaggle.matchers.networks.dense_warp import dense_warp, kernel, tokens
from mkpc_kaggle.matchers.networks.grids import as_map

DINOV2_BLOCKS, DECODER_BLOCKS = (1, 12, 24), (1, 5)


@one_thread()
@torch.inference_mode()
def computed(network, images, fine_images=(None, None), *, symmetric=True):
    """In the network's order; "up_" in the second pass.

    The images and the directions are run one after the other; here they are one batch, as in the golden files.
    """
    decoder = network.decoder
    dinov2_blocks, decoder_blocks = (
        {f"blocks.{number - 1}": number for number in numbers if number <= len(blocks)}
        for numbers, blocks in (
            (DINOV2_BLOCKS, network.dinov2.blocks),
            (DECODER_BLOCKS, decoder.embedding_decoder.blocks),
        )
    )
    with (
        recorded(network.dinov2, ["patch_embed", *dinov2_blocks, "norm"]) as seen,
        recorded(network, ["encoder.cnn"]) as convolved,
    ):
        features = [network.encode(*versions) for versions in zip(images, fine_images, strict=True)]
    with (
        recorded_refinement(decoder) as calls,
        recorded(decoder.embedding_decoder, [*decoder_blocks, "to_out"]) as decoded,
    ):
        dense = side_by_side(network.match(*features) if symmetric else [dense_warp(*network.decoder(*features))])
    passes = 1 if fine_images[0] is None else 2

    values = dinov2_values(network.dinov2, seen, dinov2_blocks)
    values |= encoded([gave for _, gave in convolved["encoder.cnn"][::passes]], [each.coarse for each in features])
    values |= coarse_values(decoder, features, calls)
    values |= {f"dec_block{number}": outputs(decoded[name]) for name, number in decoder_blocks.items()}
    values |= anchor_values(outputs(decoded["to_out"]), features[0].coarse.at(16).shape[2:])
    values |= refiner_values(decoder, calls, 0, passes, certainty=2)
    final = ""
    if passes == 2:
        final = "up_"
        second = encoded([gave for _, gave in convolved["encoder.cnn"][1::2]], [each.fine for each in features])
        second |= refiner_values(decoder, calls, 1, passes, certainty=2)
        values |= {f"up_{name}": value for name, value in second.items()}
    return values | {f"{final}warp": dense.warp, f"{final}certainty": dense.certainty}


def outputs(calls):
    return torch.cat([gave for _, gave in calls])


def dinov2_values(dinov2, calls, blocks):
    patches = outputs(calls["patch_embed"])  # (B, C, h, w)
    h, w = patches.shape[2:]
    values = {"dino_patch": tokens(patches), f"pos_{h}x{w}": dinov2.positions(h, w)}
    values |= {f"dino_block{number}": outputs(calls[name]) for name, number in blocks.items()}
    return values | {"dino_norm": outputs(calls["norm"])}


def encoded(maps, pyramids):
    """Features before and after their projections; DINOv2's before are among its own values."""
    levels = [torch.cat(level) for level in zip(*maps, strict=True)]
    projected = [torch.cat(level) for level in zip(*(pyramid.levels for pyramid in pyramids), strict=True)]
    values = {f"enc{2**i}": level for i, level in enumerate(levels)}
    return values | {f"proj{2**i}": level for i, level in enumerate(projected)}


def coarse_values(decoder, features, calls):
    queries, supports = (
        tokens(torch.cat([each.coarse.at(16) for each in order])) for order in orders(features, calls)
    )
    posterior, _ = joined(got for got, _ in calls["embedding_decoder"])
    flow, certainty = joined((gave.flow, gave.certainty) for _, gave in calls["embedding_decoder"])
    return {
        "gp_pos": decoder.process.embed_coordinates(features[1].coarse.at(16)),
        "K_yy": kernel(supports, supports),
        "K_xy": kernel(queries, supports),
        "gp": posterior,
        "coarse_flow": flow,
        "coarse_cert": certainty,
    }


def orders(features, calls):
    """The queries, then the supports, of the directions that were run."""
    directions = len(calls["embedding_decoder"])
    return features[:directions], features[::-1][:directions]


def anchor_values(logits, size):
    """(B, h w, 4097) as maps; the last is the certainty's."""
    anchors = logits[..., :-1].unflatten(1, tuple(size))  # (B, h, w, 4096)
    best, mode = anchors.softmax(dim=-1).max(dim=-1)
    return {"cls": as_map(anchors), "cls_mode": mode, "cls_pmax": best}
