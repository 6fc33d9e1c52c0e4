"""The tables of `benchmarks.crops`: gains by groups of scenes."""

from benchmarks.crops import gain_lines


def run(accuracies):
    """The figures of a run on scenes of one pair each."""
    scenes = []
    for scene, accuracy in accuracies.items():
        pair = {"images": ["b", "a"], "accuracy_by_step": {"MAGSAC": 0.0, "+ prior": accuracy}}
        scenes.append({"scene": scene, "pairs": [pair]})
    return {"scenes": scenes}


def test_gains_are_those_of_the_last_layout_in_each_group_of_scenes():
    first = run({"castle_zoom2": 0.1, "castle_zoom4": 0.2, "herz_zoom4": 0.3})
    last = run({"castle_zoom2": 0.2, "castle_zoom4": 0.6, "herz_zoom4": 0.9})
    lines = gain_lines([first, last], ["one", "rule"], chosen="castle")
    cells = {line[:14].strip(): line[14:].split()[:4] for line in lines[1:]}
    assert cells == {
        "all": ["3", "0.2000", "0.5667", "+0.3667"],
        "x2": ["1", "0.1000", "0.2000", "+0.1000"],
        "x4": ["2", "0.2500", "0.7500", "+0.5000"],
        "chosen on": ["2", "0.1500", "0.4000", "+0.2500"],
        "confirmed on": ["1", "0.3000", "0.9000", "+0.6000"],
    }
