"""From simulated chip to trace, through files: what stands inside the dwells is found, and nothing else.

What a finding says is of the recorded samples: amplitudes lie behind the chip's filter.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.cli import main
from adis_gonio.dwells import WithinFinding, samples_of, search_within
from adis_gonio.estimation.readings import readings_of
from tracing.dwell_samples import bartlett

DATA = Path(os.environ.get("ADIS_GONIO_DATA", Path(__file__).parents[3] / "shared" / "data"))
RATE_HZ = 819.2
FILTER = bartlett(2)


def simulated(path: Path, *effects: str, seed: int = 1, options: tuple[str, ...] = ()) -> Path:
    """A turn there and back, dwells of 4 s, from the simulator's command line."""
    words = ["simulate", "--plan", "tumble", "--dwell", "4", "--seed", str(seed), "-o", str(path)]
    for effect in effects:
        words += ["--effect", effect]
    assert main([*words, *options]) == 0
    return path


def within(path: Path) -> tuple[WithinFinding, ...]:
    session = load_session(path)
    samples = samples_of(session, readings_of(session))
    assert samples is not None
    return search_within(samples)


def held(finding: WithinFinding, name: str, truth: float, factor: float = 3.0) -> bool:
    value = finding.parameters[name]
    assert value.u is not None
    return abs(value.value - truth) <= factor * value.u


def test_without_effects_the_simulator_shows_nothing(tmp_path):
    """Bias instability, ringing after moves and fixture errors as by default; three seeds at 1 % each."""
    shown = {seed: within(simulated(tmp_path / f"{seed}.csv", seed=seed)) for seed in range(3)}
    assert sum(bool(found) for found in shown.values()) <= 1, shown


def test_tone_through_the_chip(tmp_path):
    effect = "tone:tone_x=2,tone_y=1,frequency=50"
    for seed in range(2):
        (found,) = within(simulated(tmp_path / f"{seed}.csv", effect, seed=seed))
        gain = abs(FILTER @ np.exp(-2j * np.pi * 50 / RATE_HZ * np.arange(len(FILTER))))
        assert (found.kind, found.axes, len(found.positions)) == ("tone", ("x", "y"), 24)
        assert held(found, "frequency", 50.0)
        assert held(found, "tone_x", 2 * gain)
        assert held(found, "tone_y", 1 * gain)


@pytest.mark.parametrize("above_hz", [600.0, 1500.0])
def test_a_tone_above_half_the_rate_is_seen_as_its_alias_and_named_among_what_folds_there(
    tmp_path, above_hz
):
    effect = f"tone:tone_x=4,frequency={above_hz}"
    (found,) = within(simulated(tmp_path / "alias.csv", effect))
    seen_hz = abs(above_hz - RATE_HZ * round(above_hz / RATE_HZ))
    gain = abs(FILTER @ np.exp(-2j * np.pi * seen_hz / RATE_HZ * np.arange(len(FILTER))))
    assert (found.kind, found.axes) == ("tone", ("x",))
    assert held(found, "frequency", seen_hz)
    assert held(found, "tone_x", 4 * gain)
    u_hz = found.parameters["frequency"].u
    assert u_hz is not None
    assert min(abs(f - above_hz) for f in found.aliases_hz) < 4 * u_hz + 1e-4 * above_hz
    assert found.as_dict()["aliases_hz"] == list(found.aliases_hz)
    assert f"{above_hz:.4g}"[:3] in found.sentence


def test_settling_through_the_chip(tmp_path):
    for seed in range(2):
        path = simulated(tmp_path / f"{seed}.csv", "settling:settling_x=8,tau=0.8", seed=seed)
        (found,) = within(path)
        assert (found.kind, found.axes) == ("settling", ("x",))
        assert held(found, "tau", 0.8)
        # The dwell begins after the move: less than the whole amplitude is left.
        assert 0.5 < found.parameters["settling_x"].value < 8


def test_noise_change_through_the_chip(tmp_path):
    gain = float(np.sqrt((FILTER**2).sum()))
    for seed in range(2):
        effect = "noise_change:extra_x=4,extra_y=4,start=80"
        path = simulated(tmp_path / f"{seed}.csv", effect, seed=seed)
        (found,) = within(path)
        assert (found.kind, found.effect) == ("noise_change", "noise_change")
        assert held(found, "extra_x", 4 * gain)
        # The chip's clock begins when it is switched on, the session's a little later.
        assert found.parameters["start"].value == pytest.approx(80, abs=1.0)


def test_vibration_raises_the_scatter_and_moves_the_mean(tmp_path):
    path = simulated(
        tmp_path / "v.csv",
        "vibration_rectification:vre_x=4000",
        options=("--filter", "0", "--set", "fixture_sigma_deg=0", "--set", "bias_instability_mg=0"),
    )
    plain = simulated(
        tmp_path / "p.csv",
        options=(
            *("--filter", "0", "--set", "fixture_sigma_deg=0", "--set", "bias_instability_mg=0"),
            *("--set", "table_vibration_mg=20"),
        ),
    )
    session, other = load_session(path), load_session(plain)
    variance = np.array([d.accel[:, 0].var() for d in session.dwells]) * 0.4672**2
    assert variance.max() > 5 * variance.min()
    (found,) = within(path)
    assert (found.kind, found.effect) == ("noise_change", None)
    # Of the same seed but without the effect: what is left of the difference is proportional to variance.
    means = [np.array([d.accel[:, 0].mean() for d in s.dwells]) * 0.4672 for s in (session, other)]
    shift = means[0] - means[1]
    slope, _ = np.polyfit(variance, shift, 1)
    assert 1e6 * slope == pytest.approx(4000, rel=0.3)


@pytest.mark.parametrize("seed", range(3))
def test_a_mean_that_follows_the_vibration_is_named(tmp_path, seed: int) -> None:
    """A machine that runs at four strengths: K2 of X turns its variance into a shift, Y has none."""
    rng = np.random.default_rng([seed, 77])
    rows, time = [], 0.0
    for k, angle in enumerate(np.arange(24) * 15.0):
        psi, sd = 0.05 - np.deg2rad(angle), float(rng.choice([3.0, 10.0, 25.0, 50.0]))
        mean = np.array([1005 * np.cos(psi), 998 * np.sin(psi + 0.004)])
        mean = mean + np.array([2000 * (sd / 1000) ** 2, 0.0])
        for x, y in mean + rng.normal(0, sd, (1000, 2)):
            rows.append(f"{time:.5f},{k},{angle},{x:.3f},{y:.3f}")
            time += 0.00122
        time += 3.0
    head = ["# sensor: generic", "# fixture_sigma_deg: 0.005", "# accel_unit: mg"]
    head.append("time_s,position,angle_deg,ax,ay")
    path = tmp_path / "machine.csv"
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")
    result = trace(load_session(path)).as_dict()
    assert [entry["effect"] for entry in result["found"]] == ["vibration_rectification"]
    (entry,) = result["found"]
    assert entry["axes"] == ["x"]
    value = entry["parameters"]["vre_x"]
    assert abs(value["value"] - 2000) < 3.5 * value["u"]
    assert result["error"]["after"]["heldout_rms_mg"] < result["error"]["before"]["heldout_rms_mg"]


def test_trace_counts_what_is_beyond_doubt_and_only_remarks_the_rest(tmp_path, capsys):
    path = simulated(tmp_path / "t.csv", "tone:tone_x=2,tone_y=1,frequency=50")
    capsys.readouterr()
    assert main(["trace", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [entry["kind"] for entry in document["within"]] == ["tone"]
    (tone,) = [entry for entry in document["found"] if entry["effect"] == "tone"]
    assert tone["explains"] == 0.0
    assert tone["p_value"] <= 1e-6
    assert main(["trace", str(path)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "Inside the dwells: tone (x, y)." in text
    assert "A spectral line at" in text
    assert main(["report", str(path), "-o", str(tmp_path / "t.html")]) == 0
    page = (tmp_path / "t.html").read_text(encoding="utf-8")
    assert "Spectrum of x inside the dwells" in page
    # The same samples, cut out of a continuous recording: nobody declared that the part was at rest.
    cut = trace(replace(load_session(path), cut_by_stillness=True))
    assert [finding.kind for finding in cut.within] == ["tone"]
    assert "tone" not in [finding.effect for finding in cut.found]


@pytest.mark.parametrize("name", [*(f"mpu9150_{k}_recording" for k in range(5)), "xsens_mti_recording"])
def test_hand_held_recordings_claim_nothing_inside_the_dwells(name):
    path = DATA / f"{name}.csv.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there (docs/data.md says where to get it)")
    session = load_session(path)
    assert session.cut_by_stillness
    claimed = {finding.effect for finding in trace(session).found}
    assert claimed <= {"bias", "scale", "misalignment"}, claimed
