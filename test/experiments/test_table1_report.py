"""The page of results, from reports made up so that what it has to say is known."""

import re

import pytest
from test_claims import record

from contact_reach_ros.experiments.table1_report import document, tables

METHODS = ["contact_reach", "reference_posture", "rrt_star"]


def report(episodes, scenes=("ball",), goals=("hold", "free")):
    latencies = {"contact_reach": 0.03, "reference_posture": 0.01, "rrt_star": 0.01}
    return {
        "command": "contact-reach bench table1 --targets 3",
        "grid": {
            "scenes": list(scenes),
            "goals": list(goals),
            "methods": METHODS,
            "targets": 3,
            "repeats": 1,
            "seed": 4,
        },
        "settings": {
            "success": 0.01,
            "timeout": 20.0,
            "planning": {
                "population": 200,
                "elite": 50,
                "horizon": 3,
                "knot_duration": 0.1,
                "translation_bound": 0.01,
                "rotation_bound": 0.2,
                "posture_bound": 0.2,
            },
            "controller": {
                "impedance": {"task_stiffness": 880, "task_damping": 100, "null_stiffness": 30, "null_damping": 1}
            },
            "budget": {"permitted_force": 10.0},
        },
        "machine": {"cpu": "a processor", "cores": 2, "python": "3.11"},
        "latencies": {
            scene: {
                name: {"latency_s": value, "median_s": value, "cpu_median_s": value, "plans": 40}
                for name, value in latencies.items()
            }
            for scene in scenes
        },
        "episodes": episodes,
    }


def episodes(goal, method, forces, times):
    return [
        record(
            goal=goal,
            method=method,
            target=target,
            max_contact_force=force,
            time=seconds,
            time_ratio=1.2,
            path_length=0.4,
        )
        for target, (force, seconds) in enumerate(zip(forces, times, strict=True))
    ]


@pytest.fixture
def page(tmp_path):
    made = [
        *episodes("hold", "contact_reach", [1.0, 1.2, 0.8], [4.0, 4.1, 4.2]),
        *episodes("hold", "reference_posture", [4.0, 5.0, 3.0], [3.0, 3.1, 3.2]),
        *episodes("free", "contact_reach", [2.0, 1.0, 3.0], [4.0, 4.1, 4.2]),
        *episodes("free", "reference_posture", [1.0, 3.0, 2.0], [4.0, 4.1, 4.2]),
        *episodes("hold", "rrt_star", [0.0, 0.0, 0.0], [16.0, 16.0, 16.0]),
        *[record(goal="free", method="rrt_star", target=target, failure=f"no path to {target}") for target in range(3)],
    ]
    return document(report(made), tmp_path / "results.md")


def test_measured_and_published_figures_stand_side_by_side(page):
    held, free = page.split("### Goals: position only")
    assert "| ball | **contact_reach** | 3/3 | 4.10 ± 0.10 | 12.8 ± 0.5 | 1.00 ± 0.20 | 2.8 ± 1.2 |" in held
    assert "| ball | rrt_star | 0/3 | – | 37.8 ± 3.9 | – | 0 |" in free


def test_columns_of_every_table_agree(page):
    for table in re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE):
        assert len({line.count("|") for line in table.splitlines()}) == 1


def test_demands_and_their_verdicts(page):
    (line,) = re.findall(r".*reference posture over the method \| orientation held.*", page)
    assert re.search(r"≥ 1\.7 \| 4\.00 \[3\.\d\d, 4\.\d\d\], paired median 4\.00, 3 targets \| met", line)
    (line,) = re.findall(r".*reference posture over the method \| position only.*", page)
    assert line.endswith("| **not met** |")
    (line,) = re.findall(r".*collision-free over the method \| orientation held.*", page)
    assert "3.90" in line
    (line,) = re.findall(r".*collision-free over the method \| position only.*", page)
    assert line.endswith("| not measured |")


def test_the_condition_that_decides_has_its_ratios(page):
    (line,) = re.findall(r"\| ball \| orientation held \| 1\.00 ± 0\.20 .*", page)
    assert re.search(r"\| 4\.00 ± 1\.00 \| 4\.00 \[3\.\d\d, 4\.\d\d\]", line)
    assert re.search(r"\| ball \| position only \| .* \| 1\.00 \[", page)


def test_baselines_that_are_ahead_are_listed(page):
    assert "- ball, orientation held: reference_posture is faster: 3.10 ± 0.10 against 4.10 ± 0.10 s." in page
    assert "- ball, orientation held: rrt_star presses less: 0.00 ± 0.00 against 1.00 ± 0.20 N." in page
    assert "- ball, position only, rrt_star: 3 × no plan (no path to 0)" in page


def test_without_episodes_of_a_kind_there_is_still_a_page(tmp_path):
    alone = report(episodes("hold", "contact_reach", [0.0], [3.0]), goals=("hold",))
    alone["grid"]["methods"] = ["contact_reach"]
    page = document(alone, tmp_path / "results.md")
    assert "Not measured: that takes contact_reach and reference_posture." in page
    assert "Nowhere, as far as the differences are certain." in page
    assert tables(alone).count("Goals:") == 1


def test_another_run_tells_which_condition_decides(tmp_path):
    held = [
        *episodes("hold", "contact_reach", [1.0, 1.2, 0.8], [4.0, 4.1, 4.2]),
        *episodes("hold", "reference_posture", [4.0, 5.0, 3.0], [3.0, 3.1, 3.2]),
    ]
    free = [
        *episodes("free", "contact_reach", [2.0, 1.0, 3.0], [4.0, 4.1, 4.2]),
        *episodes("free", "reference_posture", [1.0, 3.0, 2.0], [4.0, 4.1, 4.2]),
    ]
    one, other = report(held, goals=("hold",)), report(free, goals=("free",))
    other["command"] = "contact-reach bench table1 --goals free"
    page = document(one, tmp_path / "results.md", other)
    assert re.search(r"\| ball \| position only \| .* \| 1\.00 \[", page)
    assert "contact-reach bench table1 --goals free --json other.json" in page
    assert "--report-only --json table1.json --other other.json --results docs/results.md" in page
    # All else is of the first run alone.
    assert "### Goals: position only" not in page and "6 episodes" in page
