"""`plan`: what it shows, and that its file goes through calibrate, simulate, template and resuming."""

import json

import pytest

from adis_gonio import fit, load_session
from adis_gonio.faces.cli import main
from adis_gonio.plan import read_plan
from adis_gonio.plan.optimal_plan import arrange_in_columns
from adis_gonio.plan.prediction import Bench, predict
from adis_gonio.record.archive import ArchiveView


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "best.json"
    words = ["--fixture", "0.02", "--positions", "6", "--grid", "15", "--beware", "bias_drift,backlash"]
    assert main(["plan", *words, "-o", str(path)]) == 0
    return path


def test_the_headline_stands_first_and_eighty_columns_are_enough(capsys):
    words = ["plan", "--fixture", "0.02", "--positions", "12", "--beware", "bias_drift,hysteresis"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("12 positions, 4 min: angle u 0.01")
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    order = [
        "best to tell apart bias_drift, hysteresis",
        "Predicted, by",
        "Gain",
        "Shows effects",
        "Cannot show",
    ]
    order += ["Cannot tell apart", "Positions, in this order"]
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert "supply_bias, supply_scale: not predicted" in text.replace("\n  ", " ")
    assert "temperature_c" not in text


def test_effects_that_a_plan_confounds_stand_side_by_side(capsys):
    assert main(["plan", "--fixture", "0.02", "--plan", "tumble", "--positions", "6"]) == 0
    text = capsys.readouterr().out
    told = text[text.index("Cannot tell apart") : text.index("Positions, in this order")]
    # Their separations are zero, so rounding decides the order of the others.
    (line,) = (line for line in told.splitlines() if line.startswith("  quadratic from "))
    assert {"cubic", "cross_quadratic"} <= set(line.removeprefix("  quadratic from ").split(", "))
    assert "every effect that it shows" not in told


def test_two_columns_of_39_letters_fill_a_line():
    assert [len(line) for line in arrange_in_columns(["x" * 39] * 4)] == [80, 80]


def test_a_given_plan_is_evaluated_and_nothing_searched(capsys):
    assert main(["plan", "--fixture", "0.02", "--plan", "tumble", "--positions", "6", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["positions"] == 12
    assert document["plan"]["name"] == "tumble"
    assert document["angle"]["u"] < document["angle_worst"]["u"] < 0.02
    assert set(document["parameters"]) >= {"delta_k", "delta_phi", "bias_x"}
    assert document["detectable"]["backlash"]["amplitude"] > 0
    assert any(set(pair["effects"]) == {"quadratic", "cross_quadratic"} for pair in document["confounded"])
    assert "gain" not in document


def test_the_file_is_calibrated_by_to_the_end_and_the_fit_states_what_was_predicted(made, tmp_path, capsys):
    session = tmp_path / "s.session"
    url = "sim:?seed=2&fixture_sigma_deg=0.02"
    assert main(["calibrate", url, "--plan", str(made), "--auto", "-o", str(session)]) == 0
    plan = read_plan(made)
    with ArchiveView(session) as view:
        assert view.plan() == plan
        assert not view.pending()
    loaded = load_session(session)
    assert [d.angle_deg for d in loaded.dwells] == [p.angle_deg for p in plan.positions]
    assert [d.approach for d in loaded.dwells] == [p.approach for p in plan.positions]
    result, reach = fit(loaded), predict(plan, Bench(0.02)).reach
    for name in ("delta_k", "delta_phi"):
        assert result[name].u == pytest.approx(reach.parameters[name].u, rel=0.35)
        assert abs(result[name].value - loaded.facts["truth"][name]) < 4 * reach.parameters[name].u
    capsys.readouterr()
    assert main(["calibrate", url, "--resume", "--auto", "-o", str(session)]) == 0
    assert "nothing is left to do" in capsys.readouterr().err


def test_simulate_and_template_take_the_file_too(made, tmp_path):
    angles = [position.angle_deg for position in read_plan(made).positions]
    out = tmp_path / "s.session"
    assert main(["simulate", "--plan", str(made), "--dwell", "0.5", "-o", str(out)]) == 0
    assert [dwell.angle_deg for dwell in load_session(out).dwells] == angles
    csv = tmp_path / "t.csv"
    assert main(["template", "--plan", str(made), "-o", str(csv)]) == 0
    rows = [line for line in csv.read_text("utf-8").splitlines() if line[:1].isdigit() or line[:1] == ","]
    assert [float(row.split(",")[2]) for row in rows] == angles


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "give one of --positions, --tolerance and --minutes"),
        (["--positions", "8", "--minutes", "3"], "give one of"),
        (
            ["--plan", "tumble", "--minutes", "3", "--beware", "cubic"],
            "--minutes, --beware: --plan eval",
        ),
        (["--plan", "tumbel"], "did you mean 'tumble'"),
        (["--plan", "none.json"], "none.json: cannot be read"),
        (["--positions", "8", "-o", "best.txt"], "name it .json"),
        (["--positions", "8", "--seed", "-1"], "-1 is not in the range x>=0"),
        (["--positions", "8", "--check", "1"], "--check: goes with --plan"),
        (["--positions", "8", "--sensor", "adis9"], "adis9"),
        (["--positions", "8", "--fixture", "free"], "fixture is inf"),
        (["--tolerance", "nan"], "tolerance is nan"),
        (["--positions", "8", "--risk", "2%"], "--risk: goes with --tolerance"),
        (["--positions", "4", "--noise", "1e300"], "noise_mg is 1e+300: take 0 to 10000 mg"),
        (["--positions", "4", "--start", "nan"], "start is nan°"),
        (["--positions", "4", "--start", "1e300"], "start is 1e+300°"),
    ],
)
def test_wrong_usage_is_one_line(words, told, capsys):
    status = main(["plan", "--fixture", "0.02", *words])
    lines = [x for x in capsys.readouterr().err.splitlines() if x.startswith("adis-gonio: ")]
    assert status != 0
    assert len(lines) == 1
    assert told in lines[0]


def test_a_file_that_is_there_is_kept(made, capsys):
    before = made.read_bytes()
    assert main(["plan", "--fixture", "0.02", "--positions", "4", "-o", str(made)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert made.read_bytes() == before
