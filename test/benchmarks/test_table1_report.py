"""Tables and claims in Markdown, from reports made up so that what they have to say is known."""

from test_claims import record

from benchmarks.claims import Results, claims
from benchmarks.table1_report import tables

METHODS = ["contact_reach", "reference_posture", "rrt_star"]


def report(episodes, scenes=("wall",), goals=("hold",)):
    grid = {"scenes": list(scenes), "goals": list(goals), "methods": METHODS, "targets": 4, "repeats": 1, "seed": 4}
    return {
        "command": "python -m benchmarks.table1 --targets 4",
        "grid": grid,
        "settings": {"timeout": 20.0},
        "machine": {"cpu": "a processor", "cores": 2},
        "claims": claims(Results(episodes), scenes, goals),
        "episodes": episodes,
    }


def episodes(method, time, force, **figures):
    return [
        record("wall", method=method, target=target, time=time, max_contact_force=force, **figures)
        for target in range(12)
    ]


def test_cells_have_figures_beside_the_papers_and_claims_a_verdict():
    text = tables(report([*episodes("contact_reach", 5.0, 1.0), *episodes("reference_posture", 6.0, 6.0)]))
    (ours,) = (line for line in text.splitlines() if line.startswith("| wall | **contact_reach** |"))
    assert ours.startswith("| wall | **contact_reach** | 12/12 | 5.00 ± 0.00 | 17.5 ± 1.5 | 0.5 ± 0.3 |")
    assert "| wall | rrt_star | 0/0 | – | no path | – |" in text
    assert "Targets 4 to 7 of each scene" in text
    rows = [line for line in text.splitlines() if line.startswith("| wall: ")]
    (row,) = (line for line in rows if "reference posture" in line)
    assert "| > 0 N | 2.00 [2.00, 2.00] | [2.00, 2.00] | 12 | met |" in row
    (row,) = (line for line in rows if "peak force of the paper" in line)
    assert row.endswith("| ≤ 0.5 N | 1.00 [1.00, 1.00] | [1.00, 1.00] | 12 | **not met** |")


def test_a_baseline_that_is_ahead_for_certain_is_named():
    text = tables(report([*episodes("contact_reach", 5.0, 3.0), *episodes("reference_posture", 4.0, 1.0)]))
    assert "- wall, orientation held: reference_posture is faster, by 1.00 [1.00, 1.00] s." in text
    assert "- wall, orientation held: reference_posture presses less, by 2.00 [2.00, 2.00] N." in text
    same = tables(report([*episodes("contact_reach", 5.0, 1.0), *episodes("reference_posture", 5.0, 1.0)]))
    assert "No baseline is ahead in any scene" in same


def test_failures_are_listed_with_their_reasons():
    lost = [record("wall", method="rrt_star", target=target, failure="no path") for target in range(3)]
    text = tables(report([*episodes("contact_reach", 5.0, 1.0), *lost]))
    assert "- wall, orientation held, rrt_star: 3 × no plan (no path)" in text
