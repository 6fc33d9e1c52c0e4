"""Whether the package computes, and how fast, on this machine's GPU, in at most ten minutes.

python -m benchmarks.gpu --out DIR [--device cuda:0] [--weights DIR] [--only PARTS]
python -m benchmarks.gpu --out DIR --device cpu --quick

It needs no network. Each row is printed; DIR gets ``gpu.json``, which is rewritten after each part,
so that a killed benchmark loses nothing. A part that cannot run here says why, and a part that the
time limit leaves out says "not reached". The exit status is 1 if a part failed or an outcome is not
the expected one. ``--quick`` rehearses a part of it on small images.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from benchmarks.gpu import forecast, networks, runs, speed, trained
from benchmarks.gpu.record import Part, Status, run_part, say, write
from benchmarks.gpu.setup import Setup, machine

TIME_LIMIT_S = 540.0
# The share of the limit at which each part ends. A part that ends early leaves its time to the rest.
PARTS: tuple[tuple[str, str, float, Callable[..., None]], ...] = (
    ("networks", "Networks with seeded weights", 0.2, networks.measure),
    ("trained", "ALIKED + LightGlue with trained weights", 0.25, trained.measure),
    ("runs", "Runs of submit", 0.6, runs.measure),
    ("speed", "Seconds of a pair", 1.0, speed.measure),
)


def main() -> int:
    arguments = _parser().parse_args()
    device = arguments.device
    if device != "cpu" and not torch.cuda.is_available():
        print(f"--device {device}: PyTorch sees no GPU here; --device cpu --quick rehearses")
        return 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    # Images, journals and logs of the runs: large, and of no use afterwards.
    with tempfile.TemporaryDirectory(prefix="scratch-", dir=arguments.out) as scratch:
        setup = Setup(device, arguments.quick, Path(scratch), tuple(arguments.weights))
        return _run(setup, arguments)


def _run(setup: Setup, arguments: argparse.Namespace) -> int:
    start = time.monotonic()
    facts = machine(setup)
    say(", ".join(f"{name} {value}" for name, value in facts.items()))
    parts = {}
    for name, title, share, _ in PARTS:
        parts[name] = Part(name, title, until=start + share * TIME_LIMIT_S)
    end = Part("forecast", "Pairs of 10,000 in 8 h 45 min", until=start + TIME_LIMIT_S + 5)
    wanted = arguments.only.split(",") if arguments.only else list(parts)
    for name, _, _, measure in PARTS:
        if name not in wanted:
            parts[name].reason = "not asked for"
            continue
        run_part(parts[name], partial(measure, setup=setup))
        if name == "speed":
            run_part(end, partial(forecast.measure, setup=setup, speed=parts[name]))
        write(arguments.out, facts, [*parts.values(), end])
    surprises = sum(len(part.surprises) for part in parts.values())
    failed = [part.name for part in parts.values() if part.status is Status.FAILED]
    say(f"{time.monotonic() - start:.0f} s; {arguments.out / 'gpu.json'}")
    say(
        f"rows not as expected: {surprises}; parts that failed: {', '.join(failed) or 'none'}"
    )
    return int(bool(surprises or failed))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="for gpu.json")
    add("--device", default="cuda:0", help="cuda:0 (the default), cuda:N or cpu")
    add("--quick", action="store_true", help="a rehearsal on small images, in under a minute")
    add(
        "--weights",
        action="append",
        default=[],
        type=Path,
        metavar="DIR",
        help="trained weights",
    )
    names = ", ".join(name for name, *_ in PARTS)
    add("--only", default="", metavar="PARTS", help=f"only these parts, by commas: {names}")
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
