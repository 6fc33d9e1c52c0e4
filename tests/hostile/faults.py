"""Matchers that end their process or misuse its streams, and a disk that is full."""

from attack import EITHER, ROOT, Case, Make
from room import RECONSTRUCT, SUBMIT, UNIT, encoded, makes, picture, resumed, written

MATCHER = """\
import os, signal, sys
from dataclasses import replace
from mkpc_kaggle.matchers.adapters import sift

SPEC = replace(sift.SPEC, name="faulty")

class Faulty(sift.SiftMatcher):
    spec = SPEC

    def encode(self, pictures):
        {fault}
        return super().encode(pictures)

def load(weights, options, placement):
    return Faulty(options, placement.device)
"""
FAULTS = {
    "ends its process": "os._exit(3)",
    "meets an illegal instruction": "os.kill(os.getpid(), signal.SIGILL)",
    "prints bytes": "sys.stdout.buffer.write(b'x\\n'); sys.stdout.reconfigure(); print(sys.stdout.name)",
    "prints no text": "sys.stdout.write(b'x')",
}
ENV = {"PYTHONPATH": f"lib:{ROOT}"}
FINDING = "import mkpc_kaggle.matchers.adapters as known\nknown.__path__.append('lib')\n"
IN_WORKER = SUBMIT.replace("--workers 0", "--workers 1")
UNITS = f"units = [{UNIT.format(1).replace('sift', 'faulty')}, {UNIT.format(1)}]"


def with_matcher(fault: str) -> Make:
    texts = {"lib/faulty.py": MATCHER.format(fault=fault), "lib/sitecustomize.py": FINDING, "quick.toml": UNITS}
    return lambda room: [written(name, text)(room) for name, text in texts.items()]


SAYS = "2 of 2 pairs have an F"
CHANGED = resumed(written("I/0.png", encoded(".png", picture(2))))
CASES = [
    *makes(
        "faults",
        IN_WORKER,
        {f"the first matcher {name}": with_matcher(fault) for name, fault in FAULTS.items()},
        (0,),
        env=ENV,
        says=SAYS,
    ),
    Case("faults", "no file above 20 kB", SUBMIT, says=SAYS, limits="-f 40"),  # of 512 bytes
    *(
        Case(
            "faults", f"given again, no file above {kib} kB", RECONSTRUCT, CHANGED, EITHER, limits=f"-f {2 * kib}"
        )
        for kib in (4, 20, 100)
    ),
]
