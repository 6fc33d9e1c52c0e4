"""A table at the end: cases, passed and seconds of each group."""

import re
from collections import defaultdict

from _pytest.terminal import TerminalReporter  # pytest's own name for it is younger than our floor


def pytest_terminal_summary(terminalreporter: TerminalReporter) -> None:
    done: dict[str, list[tuple[bool, float]]] = defaultdict(list)
    for outcome in ("passed", "failed"):
        for report in terminalreporter.stats.get(outcome, []):
            group = re.search(r"is_survived\[(\w+):", report.nodeid)
            if group and report.when == "call":
                done[group[1]].append((outcome == "passed", report.duration))
    if done:
        done["all"] = [case for cases in done.values() for case in cases]
        terminalreporter.section("hostile cases")
        terminalreporter.write_line(f"{'group':<12}{'cases':>7}{'passed':>8}{'failed':>8}{'seconds':>9}")
        for group, cases in done.items():
            passed, seconds = sum(well for well, _ in cases), sum(duration for _, duration in cases)
            terminalreporter.write_line(
                f"{group:<12}{len(cases):>7}{passed:>8}{len(cases) - passed:>8}{seconds:>9.0f}"
            )
