"""The command line as a shell user meets it: results, JSON, exit status, one line for each mistake."""

import io
import json
import re
import subprocess
import sys
from itertools import takewhile

import click
import numpy as np
import pytest

from adis_gonio import load_session, open_sensor
from adis_gonio.faces.cli import COMMANDS, app, main

SIM = "sim:?seed=1"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A four-position session, recorded once for all tests of this module."""
    path = tmp_path_factory.mktemp("session") / "four.session"
    assert (
        main(["calibrate", SIM, "--plan", "four-position", "--auto", "--dwell", "2", "-o", str(path)]) == 0
    )
    return path


def failed(capsys, *arguments: str) -> tuple[int, str]:
    """Status and message of a call that must fail with one line and nothing on standard output."""
    status = main([*arguments])
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if line.startswith("adis-gonio:")]
    assert len(lines) == 1, err
    assert "Traceback" not in err
    assert out == ""
    return status, lines[0]


def test_help_answers_without_numpy_scipy_or_matplotlib():
    code = (
        "import sys; sys.argv = ['adis-gonio', '--help']\n"
        "from adis_gonio.faces.cli import main\n"
        "main()\n"
        "heavy = {'numpy', 'scipy', 'matplotlib', 'rich'} & set(sys.modules)\n"
        "print('heavy:', sorted(heavy), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=600
    )
    assert all(name in done.stdout for name in COMMANDS)
    assert done.stderr.strip() == "heavy: []"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_explains_itself(capsys, name):
    assert main([name, "--help"]) == 0
    assert "Usage: adis-gonio " + name in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_lists_each_option_once_in_sections_of_80_columns(capsys, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "80")
    assert main([name, "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert not any("\\b" in line for line in lines)
    sections = [line for line in lines if re.fullmatch(r"[A-Z][\w ]+:", line)]
    lines = lines[lines.index(sections[0]) :]
    command = app.get_command(click.Context(app), name)
    options = [option for option in command.params if isinstance(option, click.Option)]
    for option in options:
        flags = [line for line in lines if re.match(rf"  (-\w, )?{option.opts[0]}(?![\w-])", line)]
        assert len(flags) == 1, option.opts
    if len(options) > 9:
        assert sections[0] == "Main options:"
        assert 2 <= len([line for line in lines[: lines.index("")] if line.startswith("  -")]) <= 3


def test_no_command_shows_the_help_and_is_wrong_usage(capsys):
    assert main([]) == 2
    assert "Bench commands:" in capsys.readouterr().err


def test_calibrate_shows_truth_and_result_side_by_side_and_they_agree(capsys, tmp_path):
    path = tmp_path / "s.session"
    assert (
        main(
            [
                "calibrate",
                "sim:?seed=7",
                "--plan",
                "four-position",
                "--auto",
                "--dwell",
                "3",
                "-o",
                str(path),
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "truth" in out
    rows = {line.split()[0]: line for line in out.splitlines() if line.strip()}
    for name in ("ΔK", "Δφ", "bias_x", "bias_y"):
        cells = [cell.replace("−", "-") for cell in rows[name].split()[1:] if cell not in ("mg", "°")]
        truth, value, u = map(float, cells[:3])
        assert abs(value - truth) < 4.5 * u + 1e-12, rows[name]
    # The session has the opposite positions: what two of them cannot see is no news, and no advice.
    assert "bias cannot be seen" not in out
    assert "measure 180" not in out


def test_calibrate_asks_about_a_fault_at_once_and_for_the_position_again_if_nobody_answers(
    capsys, tmp_path, monkeypatch
):
    path = tmp_path / "s.session"
    url = "sim:?seed=7&supply_v=4.6"
    call = ["calibrate", url, "--dwell", "0.5", "-o", str(path)]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))  # the first position, then away from the question
    assert main(call) == 1
    told = capsys.readouterr().err
    assert "with an error or alarm" in told
    assert "ask for the position again" in told
    assert "0° withdrawn" in told
    monkeypatch.setattr("sys.stdin", io.StringIO("\nk\n\nk\nn\n"))  # keep both, no extension
    assert main([*call, "--resume"]) == 0
    told = capsys.readouterr().err
    assert "1 of 2" in told
    assert len([note for note in load_session(path).notes if "error or alarm" in note]) == 2
    monkeypatch.setattr("sys.stdin", io.StringIO("n\n"))
    assert main([*call, "--resume"]) == 0
    told = capsys.readouterr().err
    assert "ask for the position again" not in told


def test_calibrate_json_is_one_document_with_the_truth(capsys, tmp_path):
    path = tmp_path / "s.session"
    status = main(["calibrate", SIM, "--auto", "--extend", "--dwell", "2", "--json", "-o", str(path)])
    captured = capsys.readouterr()
    document = json.loads(captured.out)
    assert status == 0
    assert document["complete"] is True
    assert document["parameters"]["delta_phi"]["unit"] == "deg"
    assert abs(document["parameters"]["bias_x"]["value"] - document["truth"]["bias_x"]) < 3
    assert "cannot see a bias" in captured.err  # what two positions cannot see is said before going on


def test_a_two_position_session_says_what_it_cannot_see(capsys, tmp_path):
    path = tmp_path / "two.session"
    assert main(["calibrate", SIM, "--auto", "--dwell", "2", "-o", str(path)]) == 0
    captured = capsys.readouterr()
    assert "2 positions cannot see a bias" in captured.err
    assert len(load_session(path).dwells) == 2
    assert main(["fit", str(path)]) == 0
    assert " ".join(capsys.readouterr().out.split()).count("a bias cannot be seen in two positions") == 1


@pytest.mark.parametrize("method", ["paper", "two-position", "four-position", "ml"])
def test_fit_gives_the_documents_of_the_format(capsys, recorded, method):
    assert main(["fit", str(recorded), "--method", method, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {
        "method", "parameters", "covariance", "chi2", "dof", "residual_rms_mg", "angle_error_deg",
        "warnings",
    } <= set(document)  # fmt: skip
    assert document["method"] == method
    for entry in document["parameters"].values():
        assert set(entry) == {"value", "u", "dof", "k", "U", "unit"}
    matrix = np.array(document["covariance"]["matrix"])
    names = document["covariance"]["names"]
    assert matrix.shape == (len(names), len(names))
    for k, name in enumerate(names):
        assert np.sqrt(matrix[k, k]) == pytest.approx(document["parameters"][name]["u"], rel=1e-6)


def test_fit_leads_with_one_answer_and_gives_the_others_a_line_each(capsys, recorded):
    assert main(["fit", str(recorded)]) == 0
    out = capsys.readouterr().out
    lines = out.splitlines()
    first = next(line for line in lines if line.startswith("Answer"))
    assert first == "Answer by method ml"
    head = lines.index(first) + 1
    assert lines[head].split() == ["quantity", "unit", "value", "u", "U", "(95", "%)", "k"]
    assert [line.split()[0] for line in lines[head + 1 : head + 4]] == ["ΔK", "Δφ", "angle"]
    scores = lines.index(next(line for line in lines if line.startswith("method")))
    assert [line.split()[0] for line in lines[scores + 1 : scores + 5]] == [
        "ml", "paper", "two-position", "four-position",
    ]  # fmt: skip
    assert sum(line.split()[:1] == ["Δφ"] for line in lines) == 2


def test_fit_all_shows_every_method_and_nothing_is_wider_than_80_columns(capsys, recorded, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("adis_gonio.faces.cli.show.Console.is_terminal", True)
    assert main(["fit", str(recorded), "--all"]) == 0
    out = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 80
    assert "…" not in out
    for method in ("paper", "two-position", "four-position", "ml"):
        assert f"{method}, ± U" in out
    lines = out.splitlines()
    heads = [k for k, line in enumerate(lines) if line.startswith("parameter ") and " unit " in line]
    assert len(heads) >= 2
    for k in heads:  # the units of a table are in one column
        at = lines[k].index("unit")
        units = [line[at:].split(" ")[0] for line in takewhile(str.strip, lines[k + 1 :])]
        assert units[:3] == ["", "°", "°"]
        assert "mg" in units


def test_a_long_statement_of_conformity_goes_on_below_its_own_words(capsys, recorded, monkeypatch):
    monkeypatch.setenv("COLUMNS", "76")
    monkeypatch.setattr("adis_gonio.faces.cli.show.Console.is_terminal", True)
    assert main(["fit", str(recorded), "--tolerance", "0.5deg"]) == 0
    out = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    stated = out[out.index("Conformity with") :].splitlines()
    assert max(map(len, stated)) <= 76
    folded = [line for line in stated if line.startswith("    ")]
    assert folded
    assert stated[stated.index(folded[0]) - 1].startswith("  with")


def test_fit_monte_carlo_stands_beside_the_linear_uncertainty(capsys, recorded):
    call = ["fit", str(recorded), "--method", "four-position", "--monte-carlo", "400"]
    assert main([*call, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    run = document["monte_carlo"]["parameters"]
    assert run.keys() == document["parameters"].keys()
    for name, entry in run.items():
        assert entry["linear_u"] == document["parameters"][name]["u"]
        assert entry["u"] == pytest.approx(entry["linear_u"], rel=0.15)
    assert main(call) == 0
    assert "Monte Carlo, 400 trials" in capsys.readouterr().out


def test_export_csv_is_read_back_with_the_same_fit(capsys, recorded, tmp_path):
    out = tmp_path / "x.csv.gz"
    assert main(["export", str(recorded), "--format", "csv", "-o", str(out)]) == 0
    fits = []
    for path in (recorded, out):
        assert main(["fit", str(path), "--json"]) == 0
        fits.append(json.loads(capsys.readouterr().out)["parameters"])
    assert fits[0].keys() == fits[1].keys()
    for name, entry in fits[0].items():
        assert fits[1][name]["value"] == pytest.approx(entry["value"], rel=1e-9, abs=1e-12)


def test_export_json_holds_coefficients_and_no_samples(capsys, recorded):
    assert main(["export", str(recorded), "--format", "json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["coefficients"]["parameters"]["delta_k"]["u"] > 0
    assert "dwells" not in document["session"]


def test_simulate_to_csv_holds_no_truth_and_can_be_fitted(capsys, tmp_path):
    out = tmp_path / "x.csv"
    arguments = ["--plan", "mmpm", "--dwell", "1", "--seed", "5", "--effect", "quadratic:k2_x=3"]
    assert main(["simulate", *arguments, "--set", "delta_k=0.02", "-o", str(out)]) == 0
    assert "quadratic" not in out.read_text()
    assert "0.02\n" not in out.read_text().replace("fixture_sigma_deg: 0.02\n", "")
    capsys.readouterr()
    assert main(["fit", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["parameters"]["delta_k"]["value"] == pytest.approx(
        0.02, abs=0.002
    )


def test_simulated_poses_calibrate_three_axes(capsys, tmp_path):
    out = tmp_path / "poses.session"
    assert (
        main(
            [
                "calibrate",
                "sim:?seed=2",
                "--plan",
                "poses",
                "--auto",
                "--dwell",
                "2",
                "--json",
                "-o",
                str(out),
            ]
        )
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    for name in ("bias_x", "bias_y", "bias_z", "scale_x", "scale_y", "scale_z"):
        entry = document["parameters"][name]
        assert abs(entry["value"] - document["truth"][name]) < 4.5 * entry["u"], name


def test_registers_lists_reads_and_writes_with_units(capsys):
    assert main(["registers"]) == 0
    assert "level with Z up, Z reads −1 g" in " ".join(capsys.readouterr().out.split())
    assert main(["registers", SIM, "XACCL_OFF=57.3mg", "zgyro_off=-100", "SMPL_PRD=0x09", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["registers"]}
    assert rows["XACCL_OFF"]["number"] == round(57.3 / 0.4672)
    assert rows["ZGYRO_OFF"]["number"] == -100
    assert rows["SMPL_PRD"]["number"] == 9


def test_listing_all_registers_leaves_status_alone(capsys):
    assert main(["registers", SIM, "--json"]) == 0
    names = [row["name"] for row in json.loads(capsys.readouterr().out)["registers"]]
    assert "STATUS" not in names
    assert "XACCL_OUT" in names


def test_registers_can_save_to_flash(capsys):
    assert main(["registers", SIM, "XACCL_OFF=5", "ENDURANCE", "--save", "--json"]) == 0
    told = capsys.readouterr()
    rows = {row["name"]: row for row in json.loads(told.out)["registers"]}
    assert rows["ENDURANCE"]["number"] == 1
    assert not told.err


def test_a_written_register_is_volatile_until_it_is_saved(capsys):
    assert main(["registers", SIM, "XACCL_OFF=5", "--json"]) == 0
    assert "--save" in capsys.readouterr().err


def test_stream_records_a_csv_that_holds_every_scan(capsys, tmp_path):
    out = tmp_path / "rest.csv.gz"
    assert main(["stream", SIM, "--seconds", "2", "-o", str(out)]) == 0
    captured = capsys.readouterr()
    assert "XACCL/mg" in captured.out
    scans = int(captured.err.split(" scans")[0].split()[-1])
    assert scans == pytest.approx(2 * 819.2, abs=2)
    session = load_session(out)
    assert session.sensor == "adis16354"
    with open_sensor(SIM) as sensor:
        level = sensor.read_scans(500).accel_mg.mean(axis=0)
    np.testing.assert_allclose(session.dwells[0].accel.mean(axis=0) * 0.4672, level, atol=1.0)


def test_with_poll_data_ready_is_left_alone_by_stream_and_calibrate(capsys, tmp_path):
    path, flags = tmp_path / "s.session", ("--auto", "--dwell", "0.5", "-o", str(tmp_path / "s.session"))
    assert main(["stream", SIM, "--seconds", "0.5", "--poll"]) == 0
    assert "samples/s, polling;" in capsys.readouterr().err
    assert main(["calibrate", SIM, "--poll", *flags]) == 0
    facts = load_session(path).facts
    assert facts["configuration"]["data_ready"] is False
    assert facts["scanning"]["how"].startswith("data-ready is switched off for this session; polling;")


def test_stream_says_once_and_in_the_file_that_rows_may_mix_updates(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "adis_gonio.device.sensor.scanning.ALIGNABLE", 0.0
    )  # as over a bridge that is too slow
    out = tmp_path / "slow.csv"
    assert main(["stream", f"{SIM}&stream=0", "--seconds", "0.5", "-o", str(out)]) == 0
    assert capsys.readouterr().err.count("two or more neighbouring updates") == 1
    assert "# note: scans were polled" in out.read_text()


def test_selftest_and_devices(capsys):
    assert main(["selftest", SIM]) == 0
    assert "passed" in capsys.readouterr().out
    assert main(["selftest", SIM, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["passed"] is True
    assert main(["devices", "--json"]) == 0
    assert any(row["url"].startswith("sim:") for row in json.loads(capsys.readouterr().out)["devices"])


# -- mistakes ---------------------------------------------------------------------------------------

HEADER = "# plane: xy\n# fixture_sigma_deg: 0.02\n# accel_unit: mg\n"


def csv_of(rows: list[str], header: str = HEADER, columns: str = "time_s,position,angle_deg,ax,ay") -> str:
    return header + columns + "\n" + "\n".join(rows) + "\n"


def rows_of(positions: list[tuple[int, float, float, float]], n: int = 50) -> list[str]:
    """Rows of dwells (position, angle, ax, ay) with a little noise from a fixed generator."""
    rng = np.random.default_rng(8)
    time = 0.0
    rows = []
    for position, angle, ax, ay in positions:
        for _ in range(n):
            time += 0.01
            noise = rng.normal(size=2)
            rows.append(f"{time:.2f},{position},{angle:g},{ax + noise[0]:.4f},{ay + noise[1]:.4f}")
    return rows


GOOD = rows_of([(0, 0, 990, 10), (1, 90, 12, -1001), (2, 180, -990, -9), (3, 270, -12, 1000)])
AT_45 = rows_of([(0, 0, 707.1, 707.1), (1, 90, 707.1, -707.1)])

BROKEN = {
    "missing column": (
        csv_of([row.rsplit(",", 1)[0] for row in GOOD], columns="time_s,position,angle_deg,ax"),
        "ay",
    ),
    "text in a number": (csv_of([*GOOD[:60], GOOD[60].rsplit(",", 1)[0] + ",abc", *GOOD[61:]]), "row 65"),
    "NaN": (csv_of([*GOOD[:60], GOOD[60].rsplit(",", 1)[0] + ",nan", *GOOD[61:]]), "row 65"),
    "shuffled positions": (csv_of([*GOOD[:60], GOOD[60].replace(",1,90,", ",0,0,"), *GOOD[61:]]), "row 65"),
    "one position only": (csv_of(GOOD[:50]), "one position only"),
    "all zero": (csv_of([",".join([*row.split(",")[:3], "0", "0"]) for row in GOOD]), "zero"),
    "stuck": (csv_of([",".join([*row.split(",")[:3], "990", "10"]) for row in GOOD]), "stuck"),
    "empty": ("", "empty"),
    "no rows": (csv_of([]), "row"),
    "another kind": ("\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR", ""),
    "unknown key value": (csv_of(GOOD, header="# plane: xz\n"), "plane"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_gives_one_line_that_names_it(capsys, tmp_path, what):
    text, says = BROKEN[what]
    path = tmp_path / "broken.csv"
    path.write_text(text, encoding="latin-1")
    status, message = failed(capsys, "fit", str(path), "--json")
    assert status in (1, 2)
    assert says in message
    assert "broken.csv" in message or "position" in message, message


def test_the_paper_method_at_45_degrees_says_singular_and_by_how_much(capsys, tmp_path):
    path = tmp_path / "at45.csv"
    path.write_text(csv_of(AT_45))
    status, message = failed(capsys, "fit", str(path), "--method", "paper", "--json")
    assert status == 1
    assert "singular" in message
    assert "45" in message
    assert "two-position" in message
    assert main(["fit", str(path), "--method", "two-position", "--json"]) == 0


def test_a_truncated_archive_gives_one_line_and_is_left_as_it_is(capsys, tmp_path, recorded):
    whole = recorded.read_bytes()
    for share in (0.02, 0.3, 0.9):
        path = tmp_path / f"cut{share}.session"
        path.write_bytes(whole[: int(share * len(whole))])
        status, message = failed(capsys, "fit", str(path), "--json")
        assert status == 1
        assert path.name in message
        assert path.read_bytes() == whole[: int(share * len(whole))]


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["fit", "nosuch.csv"], 1, "nosuch.csv"),
        (["fit", "."], 1, "."),
        (["calibrate", "foo:bar", "-o", "x.session"], 2, "foo"),
        (["calibrate", "sim:?sede=1", "-o", "x.session"], 2, "seed"),
        (["calibrate", SIM], 2, "-o"),
        (["calibrate", SIM, "--plan", "for-position", "-o", "x.session"], 2, "four-position"),
        (["calibrate", SIM, "--resume", "-o", "nosuch.session"], 1, "nosuch.session"),
        (["calibrate", "iio:ip:localhost", "--poll", "-o", "x.session"], 2, "--poll"),
        (["stream", "iio:ip:localhost", "--poll"], 2, "--poll"),
        (["calibrate", SIM, "--plan", "mmpm", "--auto", "--extend", "-o", "x.session"], 2, "two-position"),
        (["calibrate", SIM, "--dwell", "0", "--auto", "-o", "x.session"], 2, "dwell_s"),
        (["calibrate", SIM, "--dwell", "ten", "--auto", "-o", "x.session"], 2, "ten"),
        (["calibrate", SIM, "--auto", "-o", "/nosuchdir/x.session"], 1, "/nosuchdir"),
        (["calibrate", "sim:?variant=adis16350", "--auto", "-o", "x.session"], 1, "ADIS16350"),
        (["stream", SIM, "--seconds", "-1"], 2, "--seconds"),
        (["stream", SIM, "--registers", "XACC_OUT", "--seconds", "1"], 2, "XACCL_OUT"),
        (["stream", SIM, "--rate", "5000", "--seconds", "1"], 2, "819.2"),
        (["registers", SIM, "XACCL_OFF=5000"], 2, "XACCL_OFF"),
        (["registers", SIM, "XACCL_OFF=5V"], 2, "mg"),
        (["registers", SIM, "XACCL_OFF=abc"], 2, "abc"),
        (["registers", SIM, "STATUS=0"], 2, "read-only"),
        (["registers", SIM, "SENS_AVG=0x0302"], 2, "range"),
        (["registers", SIM, "--save"], 2, "--save"),
        (["simulate", "-o", "x.csv", "--effect", "quadratik"], 2, "quadratic"),
        (["simulate", "-o", "x.csv", "--set", "delta_k"], 2, "NAME=VALUE"),
        (["registers", SIM, "XACCL_OFF=1e400mg"], 2, "so large"),
        (["serve", SIM, "--listen", "a..b"], 1, "cannot listen on a..b"),
        (["stream", SIM, "--seconds", "0.1", "--gravity", "nan", "-o", "x.csv"], 2, "--gravity"),
        (["stream", SIM, "--seconds", "0.1", "--gravity", "0", "-o", "x.csv"], 2, "--gravity"),
        (["template", "-o", "-"], 2, "only export writes to standard output"),
        (["bringup", "--from", "x.rec", SIM], 2, "at most --sensor"),
        (["fit", "x.session", "--monte-carlo", "100", "--seed", "-1"], 2, "--seed"),
        (["fit", "x.session", "--monte-carlo", "99"], 2, "99 is not in the range x>=100"),
        (["nosuch"], 2, "nosuch"),
        (["fit", "--nosuch"], 2, "--nosuch"),
    ],
)
def test_a_mistake_gives_one_line_and_its_status(capsys, tmp_path, monkeypatch, arguments, status, says):
    monkeypatch.chdir(tmp_path)
    got, message = failed(capsys, *arguments)
    assert got == status
    assert says in message
    assert not (tmp_path / "x.csv").exists()


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(28, "No space left on device", "x.csv"), "x.csv: No space left on device"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (OSError("odd"), "odd"),
    ],
)
def test_an_error_of_the_system_is_one_line_with_its_file(capsys, monkeypatch, error, line):
    def broken():
        raise error

    monkeypatch.setattr("adis_gonio.faces.cli.device_commands.find_devices", broken)
    assert failed(capsys, "devices") == (1, f"adis-gonio: {line}")


def test_nothing_is_overwritten(capsys, recorded, tmp_path):
    before = recorded.read_bytes()
    assert failed(capsys, "calibrate", SIM, "--auto", "-o", str(recorded))[0] == 2
    assert failed(capsys, "simulate", "-o", str(recorded))[0] == 2
    assert recorded.read_bytes() == before
    out = tmp_path / "x.csv"
    out.write_text("precious")
    for arguments in (
        ["stream", SIM, "--seconds", "1", "-o"],
        ["export", str(recorded), "--format", "csv", "-o"],
    ):
        assert failed(capsys, *arguments, str(out))[0] == 2
    assert out.read_text() == "precious"


def test_a_complete_session_is_resumed_by_showing_its_result(capsys, recorded):
    before = recorded.read_bytes()
    assert main(["calibrate", SIM, "--resume", "-o", str(recorded)]) == 0
    captured = capsys.readouterr()
    assert "nothing is left" in captured.err
    assert "Δφ" in captured.out
    assert recorded.read_bytes() == before


def test_a_file_that_cannot_hold_a_session_names_the_method_that_is_missing(capsys, tmp_path):
    path = tmp_path / "two.csv"
    path.write_text(csv_of(GOOD[:100]))
    status, message = failed(capsys, "fit", str(path), "--method", "four-position", "--json")
    assert status == 1
    assert "180" in message
    status, message = failed(capsys, "fit", str(path), "--method", "nine", "--json")
    assert status == 2
    assert "mmpm" in message


def test_a_report_without_matplotlib_names_the_extra_before_any_work(
    capsys, monkeypatch, recorded, tmp_path
):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    page = tmp_path / "page.html"
    status, message = failed(capsys, "report", str(recorded), "-o", str(page))
    assert status == 1
    assert message.endswith("pip install '.[report]' in the folder of adis-gonio")
    assert not page.exists()
