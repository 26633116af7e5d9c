"""From simulated chip to trace, through files: what stands inside the dwells is found, and nothing else.

What a finding says is of the recorded samples: amplitudes lie behind the chip's filter. Recordings of real
parts are in test_trace_real_data.py, the command line in tests/faces/cli/test_trace_command.py.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.faces.cli.trace_commands import print_trace
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing.within.samples import WithinFinding, samples_of
from adis_gonio.tracing.within.second_pass import look_within
from tracing.dwell_samples import bartlett
from tracing.recorded import record

RATE_HZ = 819.2
FILTER = bartlett(2)


TONE = "tone:tone_x=2,tone_y=1,frequency=50"


def simulated(
    path: Path, *effects: str, seed: int = 1, filter_m: int = 2, dwell_s: float = 2.5, **settings: float
) -> Path:
    """Six positions there and back."""
    return record(path, seed, *effects, positions=6, dwell_s=dwell_s, filter_m=filter_m, **settings)


@pytest.fixture(scope="module")
def humming(tmp_path_factory) -> Session:
    """A session with a tone of 2 and 1 mg at 50 Hz."""
    return load_session(simulated(tmp_path_factory.mktemp("humming") / "tone.session", TONE))


def within(source: Path | Session) -> tuple[WithinFinding, ...]:
    session = source if isinstance(source, Session) else load_session(source)
    samples = samples_of(session, readings_of(session))
    assert samples is not None
    return look_within(samples)[0]


def held(finding: WithinFinding, name: str, truth: float, factor: float = 3.0) -> bool:
    value = finding.parameters[name]
    assert value.u is not None
    return abs(value.value - truth) <= factor * value.u


def test_without_effects_the_simulator_shows_nothing(tmp_path):
    """Bias instability, ringing after moves and fixture errors as by default; three seeds at 1 % each."""
    shown = {seed: within(simulated(tmp_path / f"{seed}.session", seed=seed)) for seed in range(3)}
    assert sum(bool(found) for found in shown.values()) <= 1, shown


def test_tone_through_the_chip(humming):
    (found,) = within(humming)
    gain = abs(FILTER @ np.exp(-2j * np.pi * 50 / RATE_HZ * np.arange(len(FILTER))))
    assert (found.kind, found.axes, len(found.positions)) == ("tone", ("x", "y"), 12)
    assert held(found, "frequency", 50.0)
    assert held(found, "tone_x", 2 * gain)
    assert held(found, "tone_y", 1 * gain)


@pytest.mark.parametrize("above_hz", [600.0, 1500.0])
def test_a_tone_above_half_the_rate_is_seen_as_its_alias_and_named_among_what_folds_there(
    tmp_path, above_hz
):
    effect = f"tone:tone_x=4,frequency={above_hz}"
    (found,) = within(simulated(tmp_path / "alias.session", effect))
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
    path = simulated(tmp_path / "s.session", "settling:settling_x=8,tau=0.8", dwell_s=4.0)
    (found,) = within(path)
    assert (found.kind, found.axes) == ("settling", ("x",))
    assert held(found, "tau", 0.8)
    # The dwell begins after the move: less than the whole amplitude is left.
    assert 0.5 < found.parameters["settling_x"].value < 8


def test_noise_change_through_the_chip(tmp_path):
    gain = float(np.sqrt((FILTER**2).sum()))
    effect = "noise_change:extra_x=4,extra_y=4,start=40"
    (found,) = within(simulated(tmp_path / "n.session", effect, dwell_s=4.0))
    assert (found.kind, found.effect) == ("noise_change", "noise_change")
    assert held(found, "extra_x", 4 * gain)
    # The chip's clock begins when it is switched on, the session's a little later.
    start = found.parameters["start"]
    assert abs(start.value - 40) < 2 * start.u < 6


def test_vibration_raises_the_scatter_and_moves_the_mean(tmp_path):
    still = {"filter_m": 0, "fixture_sigma_deg": 0, "bias_instability_mg": 0}
    path = simulated(tmp_path / "v.session", "vibration_rectification:vre_x=4000", **still)
    plain = simulated(tmp_path / "p.session", table_vibration_mg=20, **still)
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


def machine(seed: int) -> Session:
    """A turn on a machine that runs at four strengths: K2 of X turns its variance into a shift."""
    rng = np.random.default_rng([seed, 77])
    dwells = []
    for k, angle in enumerate(np.arange(24) * 15.0):
        psi, sd = 0.05 - np.deg2rad(angle), float(rng.choice([3.0, 10.0, 25.0, 50.0]))
        mean = np.array([1005 * np.cos(psi), 998 * np.sin(psi + 0.004)])
        mean = mean + np.array([2000 * (sd / 1000) ** 2, 0.0])
        time = k * 4.22 + 0.00122 * np.arange(1000)
        dwells.append(Dwell(k, time, mean + rng.normal(0, sd, (1000, 2)), angle_deg=float(angle)))
    return Session(tuple(dwells), sensor="generic", fixture_sigma_deg=0.005, accel_unit="mg")


@pytest.mark.parametrize("seed", range(2))
def test_a_mean_that_follows_the_vibration_is_named(seed: int) -> None:
    result = trace(machine(seed)).as_dict()
    assert [entry["effect"] for entry in result["found"]] == ["vibration_rectification"]
    (entry,) = result["found"]
    assert entry["axes"] == ["x"]
    value = entry["parameters"]["vre_x"]
    assert abs(value["value"] - 2000) < 3.5 * value["u"]
    assert result["error"]["after"]["heldout_rms_mg"] < result["error"]["before"]["heldout_rms_mg"]


def test_trace_counts_what_is_beyond_doubt_and_only_remarks_the_rest(humming, capsys):
    result = trace(humming)
    document = result.as_dict()
    assert [entry["kind"] for entry in document["within"]] == ["tone"]
    (tone,) = [entry for entry in document["found"] if entry["effect"] == "tone"]
    assert tone["explains"] == 0.0
    assert tone["p_value"] <= 1e-6
    print_trace([humming], result)
    text = " ".join(capsys.readouterr().out.split())
    assert "Inside the dwells: tone (x, y)." in text
    assert "A spectral line at" in text
    # The same samples, cut out of a continuous recording: nobody declared that the part was at rest.
    cut = trace(replace(humming, cut_by_stillness=True))
    assert [finding.kind for finding in cut.within] == ["tone"]
    assert "tone" not in [finding.effect for finding in cut.found]
