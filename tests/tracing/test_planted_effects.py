"""Effects that nobody declared to the tool, planted in measured recordings.

scripts/planted_effects.py plants many more and states the rates.
"""

import gzip
import hashlib
import json
import subprocess
import sys

import numpy as np
import pytest

from recordings import MEASURED
from tracing.planting import RECORDINGS, plant_effect, planted

SCRIPT = MEASURED / "plant_effect.py"
EXP4 = RECORDINGS[0]


@pytest.mark.parametrize("kind", ["quadratic", "bias_drift", "step of the reading"])
def test_a_planted_effect_is_found_and_nothing_else(kind):
    outcome = planted(EXP4, kind, seed=300)
    assert outcome.found, outcome.document["sets"]
    assert not outcome.false
    error = outcome.document["error"]
    assert error["after"]["heldout_rms_mg"] < error["before"]["heldout_rms_mg"] / 10


def test_a_recording_without_a_planted_effect_is_not_found_to_have_one():
    """The judge can fail: the same recording counts as a miss if nothing is added to it."""
    from dataclasses import replace

    outcome = planted(EXP4, "quadratic", seed=300)
    name = "cubic" if outcome.answer["kind"] == "quadratic" else "quadratic"
    assert not replace(outcome, answer={**outcome.answer, "kind": name}).found
    assert replace(outcome, answer={**outcome.answer, "kind": name}).false == {"quadratic"}


def test_the_script_seals_its_answer_and_changes_nothing_but_the_accelerations(tmp_path):
    made = tmp_path / "planted.csv.gz"
    given = [sys.executable, str(SCRIPT), str(MEASURED / f"{EXP4}.csv.gz"), str(made), "--seed", "a test"]
    ran = subprocess.run(given, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    seal = tmp_path / "planted.seal.json"
    assert hashlib.sha256(seal.read_bytes()).hexdigest() in ran.stdout
    answer = json.loads(seal.read_text())
    assert answer["kind"] not in ran.stdout
    low, high = plant_effect.TIMES_THE_LIMIT
    assert low <= answer["times_the_limit"] <= high
    before = plant_effect.Recording.read(MEASURED / f"{EXP4}.csv.gz")
    after = plant_effect.Recording.read(made)
    assert (after.head, after.names) == (before.head, before.names)
    added_mg = 1000 * (after.accel_g - before.accel_g)
    largest = np.abs(added_mg).max(axis=0)
    assert np.flatnonzero(largest > 0.01).tolist() == ["xyz".index(answer["axis"])]
    with gzip.open(made, "rt") as file:
        assert answer["kind"] not in file.read()
