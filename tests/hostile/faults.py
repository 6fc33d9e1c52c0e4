"""Matchers that end their process or misuse its streams, and a disk that is full."""

from attack import EITHER, ROOT, Case, Make
from room import RECONSTRUCT, SUBMIT, UNIT, encoded, picture, resumed, written

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
FAULTS = {  # and a part of the output
    "prints bytes": (
        "sys.stdout.reconfigure(); sys.stdout.buffer.write(b'arrived\\n')",
        "complete after",
    ),
    "ends its process": ("os._exit(3)", "2 units run"),
    "meets an illegal instruction": ("os.kill(os.getpid(), signal.SIGILL)", "2 units run"),
    "prints no text": (
        "sys.stdout.write(b'x')",
        "(TypeError: write() argument must be str, not bytes): b1;x-y, b1;y-z",
    ),
}
ENV = {"PYTHONPATH": f"lib:{ROOT}"}
# The registry gets another matcher.
FINDING = (
    "from mkpc_kaggle.matchers.registry import MATCHERS\nMATCHERS['faulty'] = 'faulty'\n"
)
IN_WORKER = SUBMIT.replace("--workers 0", "--workers 1")
UNITS = f"units = [{UNIT.format(1).replace('sift', 'faulty')}, {UNIT.format(1)}]"


def with_matcher(fault: str) -> Make:
    texts = {
        "lib/faulty.py": MATCHER.format(fault=fault),
        "lib/sitecustomize.py": FINDING,
        "quick.toml": UNITS,
    }
    return lambda room: [written(name, text)(room) for name, text in texts.items()]


CHANGED = resumed(written("I/0.png", encoded(".png", picture(2))))
CASES = [
    *(
        Case(
            "faults",
            f"the first matcher {name}",
            IN_WORKER,
            with_matcher(fault),
            says=says,
            env=ENV,
        )
        for name, (fault, says) in FAULTS.items()
    ),
    # `ulimit -f` counts blocks of 512 bytes; a file that reaches the limit fails as on a full disk.
    # The journal is such a file: the submission is complete, and the status says that results are lost.
    Case(
        "faults",
        "no file above 20 kB",
        SUBMIT,
        statuses=(1,),
        says="2 of 2 pairs with an F",
        limits="-f 40",
    ),
    *(
        Case(
            "faults",
            f"again, no file above {kib} kB",
            RECONSTRUCT,
            CHANGED,
            EITHER,
            limits=f"-f {2 * kib}",
        )
        for kib in (4, 20, 100)
    ),
]
